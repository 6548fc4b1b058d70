#include "core/nssm/bundle.h"

#include "absl/strings/str_join.h"
#include "core/base/status.h"

namespace metaekf::nssm {
namespace {

absl::Status CheckSignal(const std::string& signal, Eigen::Index given, int32_t needed,
                         const std::vector<std::string>& names) {
  if (given == needed) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat("the model needs ", needed, " ", signal, needed == 1 ? "" : "s", " (",
                                                 absl::StrJoin(names, ", "), "), the data has ", given));
}

}  // namespace

absl::Status CheckChannels(const Bundle& bundle, const data::Trajectory& trajectory, bool need_states) {
  const ModelSpec& spec = bundle.model.spec();
  METAEKF_RETURN_IF_ERROR(CheckSignal("input", trajectory.inputs.rows(), spec.input_size, bundle.names.inputs));
  METAEKF_RETURN_IF_ERROR(CheckSignal("output", trajectory.outputs.rows(), spec.output_size, bundle.names.outputs));
  if (need_states) {
    METAEKF_RETURN_IF_ERROR(CheckSignal("state", trajectory.states.rows(), spec.state_size, bundle.names.states));
  }
  return absl::OkStatus();
}

void RoundToPrecision(Precision precision, std::vector<double>* values) {
  if (precision == Precision::kFloat64) return;
  for (double& value : *values) value = static_cast<double>(static_cast<float>(value));
}

}  // namespace metaekf::nssm
