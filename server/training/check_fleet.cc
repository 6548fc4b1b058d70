#include "server/training/check_fleet.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/meta/inner_loop.h"
#include "core/nssm/loss.h"
#include "server/convert/channels.h"
#include "server/convert/spec.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

using Header = v1::CreateTrainingJobRequest::Header;
using nssm::ModelSpec;

constexpr const char* kSpec = "header.spec";
constexpr const char* kModel = "header.spec.model";

absl::Status FitSize(const std::string& signal, int32_t given, int32_t* size) {
  if (*size == ModelSpec::kFromData) *size = given;
  if (*size == given) return absl::OkStatus();
  return FieldViolation(absl::StrCat(kModel, ".", signal, "_size"),
                        absl::StrCat("is ", *size, ", the data has ", given, " ", signal, "s"));
}

/// Takes the sizes that the specification leaves open from the data.
absl::Status FitSizes(const v1::Channels& channels, ModelSpec* model) {
  METAEKF_RETURN_IF_ERROR(FitSize("input", channels.inputs_size(), &model->input_size));
  METAEKF_RETURN_IF_ERROR(FitSize("output", channels.outputs_size(), &model->output_size));
  if (model->is_case_one()) return absl::OkStatus();
  if (channels.states().empty()) {
    return FieldViolation("header.channels.states",
                          "the model is Case II (STATE_INPUT_OUTPUT), but the data has no state "
                          "columns (x1, x2, …)");
  }
  return FitSize("state", channels.states_size(), &model->state_size);
}

absl::Status CheckModel(const meta::TrainingSpec& spec) {
  METAEKF_RETURN_IF_ERROR(InField(
      kSpec, nssm::ReadModelSpec(base::JsonFields(nssm::ToJson(spec.model), "model")).status()));
  METAEKF_ASSIGN_OR_RETURN(const nssm::Model model, nssm::Model::Create(spec.model));
  METAEKF_RETURN_IF_ERROR(
      InField(absl::StrCat(kSpec, ".inner_loop.adapted_mask"),
              nn::ParseMask(spec.inner_loop.adapted_mask, model.layout()).status()));
  METAEKF_RETURN_IF_ERROR(
      InField(absl::StrCat(kSpec, ".adaptation.adapted_mask"),
              nn::ParseMask(spec.adaptation.adapted_mask, model.layout()).status()));
  METAEKF_RETURN_IF_ERROR(InField(absl::StrCat(kSpec, ".inner_loop"),
                                  meta::CheckTensorRates(spec.inner_loop, model.layout())));
  METAEKF_RETURN_IF_ERROR(InField(absl::StrCat(kSpec, ".adaptation"),
                                  meta::CheckTensorRates(spec.adaptation, model.layout())));
  const auto check_set = [&spec](const std::string& field, int32_t samples) {
    return base::Annotate(nssm::ShapeOfLoss(spec.model, spec.loss, samples).status(),
                          absl::StrCat(kSpec, ".", field));
  };
  METAEKF_RETURN_IF_ERROR(check_set("context_samples", spec.context_samples));
  return check_set("target_samples", spec.target_samples);
}

absl::Status CheckRecordings(const meta::TrainingSpec& spec,
                             const std::vector<SampleChecker::Recording>& recordings) {
  double period_s = spec.sample_period_s;
  const int64_t needed = std::max(spec.context_samples, spec.target_samples);
  for (const SampleChecker::Recording& recording : recordings) {
    if (period_s == 0) period_s = recording.sample_period_s;
    const double period = recording.sample_period_s;
    if (period != 0 && std::abs(period - period_s) > 1e-6 * period_s) {
      return FieldViolation(
          "samples.sample_period_s",
          absl::StrCat("trajectory '", recording.name, "' has ", base::FormatExact(period),
                       " s, the others or the specification ", base::FormatExact(period_s), " s"));
    }
    if (recording.samples < needed) {
      return absl::FailedPreconditionError(
          absl::StrCat("trajectory '", recording.name, "' has ", recording.samples,
                       " samples, context and target sets need ", needed,
                       "; give longer trajectories or smaller context_samples and target_samples"));
    }
  }
  if (period_s > 0) return absl::OkStatus();
  return FieldViolation(absl::StrCat(kSpec, ".sample_period_s"),
                        "is needed: the data does not say its sample period");
}

}  // namespace

absl::Status CheckTrainingHeader(const Header& header) {
  METAEKF_RETURN_IF_ERROR(ParseModelName("header.model", header.model()).status());
  METAEKF_RETURN_IF_ERROR(CheckNewChannels("header.channels", header.channels()));
  METAEKF_ASSIGN_OR_RETURN(meta::TrainingSpec spec, ToCore(kSpec, header.spec()));
  METAEKF_RETURN_IF_ERROR(FitSizes(header.channels(), &spec.model));
  return CheckModel(spec);
}

absl::Status CheckFleet(const Header& header,
                        const std::vector<SampleChecker::Recording>& recordings) {
  METAEKF_ASSIGN_OR_RETURN(const meta::TrainingSpec spec, ToCore(kSpec, header.spec()));
  if (recordings.empty()) return FieldViolation("samples", "there are none: send a fleet");
  if (spec.validation_share > 0 && recordings.size() < 2) {
    return FieldViolation(absl::StrCat(kSpec, ".validation_share"),
                          "holds systems out, but there is only one; set it to 0 or send more "
                          "trajectories");
  }
  return CheckRecordings(spec, recordings);
}

}  // namespace metaekf::server
