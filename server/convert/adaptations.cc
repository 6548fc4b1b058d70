#include "server/convert/adaptations.h"

#include <cmath>
#include <optional>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/meta/inner_loop.h"
#include "server/convert/json.h"
#include "server/convert/spec.h"
#include "server/convert/time.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

using meta::AdaptationMethod;

constexpr uint32_t kMaxSteps = 100'000;

/// Nothing: the method that the model was trained for.
absl::StatusOr<std::optional<AdaptationMethod>> ToCore(v1::Adaptation::Method method) {
  switch (method) {
    case v1::Adaptation::METHOD_UNSPECIFIED:
      return std::nullopt;
    case v1::Adaptation::GRADIENT_DESCENT:
      return AdaptationMethod::kGradientDescent;
    case v1::Adaptation::ADAM:
      return AdaptationMethod::kAdam;
    case v1::Adaptation::FROM_SCRATCH:
      return AdaptationMethod::kFromScratch;
    case v1::Adaptation::LEVENBERG_MARQUARDT:
      return AdaptationMethod::kLevenbergMarquardt;
    default:
      return FieldViolation("options.method",
                            absl::StrCat(static_cast<int>(method), " is no method known here"));
  }
}

v1::Adaptation::Method ToMessage(AdaptationMethod method) {
  switch (method) {
    case AdaptationMethod::kGradientDescent:
      return v1::Adaptation::GRADIENT_DESCENT;
    case AdaptationMethod::kAdam:
      return v1::Adaptation::ADAM;
    case AdaptationMethod::kFromScratch:
      return v1::Adaptation::FROM_SCRATCH;
    case AdaptationMethod::kLevenbergMarquardt:
      return v1::Adaptation::LEVENBERG_MARQUARDT;
  }
  return v1::Adaptation::METHOD_UNSPECIFIED;
}

v1::HeldOutErrors::Rmse ToMessage(const meta::TailErrors& errors) {
  v1::HeldOutErrors::Rmse rmse;
  rmse.mutable_one_step()->Add(errors.one_step.begin(), errors.one_step.end());
  rmse.mutable_simulate()->Add(errors.simulate.begin(), errors.simulate.end());
  return rmse;
}

/// Rates of the request instead of the learned ones, which it may also decline.
absl::Status TakeTensorRates(const v1::InnerLoopSpec& request, const std::string& field,
                             const nssm::Bundle& bundle, meta::InnerLoopSpec* inner_loop) {
  if (request.has_learned_rates() && !request.learned_rates()) inner_loop->tensor_rates.clear();
  for (const auto& [name, rate] : request.tensor_rates()) {
    if (!std::isfinite(rate) || rate <= 0) {
      return FieldViolation(absl::StrCat(field, ".tensor_rates.", name),
                            absl::StrCat("is ", base::FormatExact(rate), ", must be positive"));
    }
    inner_loop->tensor_rates[name] = rate;
  }
  return InField(field, meta::CheckTensorRates(*inner_loop, bundle.model.layout()));
}

}  // namespace

absl::StatusOr<meta::AdaptationOptions> ResolveOptions(const v1::AdaptRequest::Options& request,
                                                       const nssm::Bundle& bundle) {
  METAEKF_ASSIGN_OR_RETURN(const std::optional<AdaptationMethod> method, ToCore(request.method()));
  METAEKF_ASSIGN_OR_RETURN(meta::AdaptationOptions options,
                           meta::DefaultAdaptation(bundle, method));
  options.seed = request.seed();
  const std::string field = "options.inner_loop";
  const v1::InnerLoopSpec& inner_loop = request.inner_loop();
  if (inner_loop.optimiser() != v1::InnerLoopSpec::OPTIMISER_UNSPECIFIED) {
    return FieldViolation(absl::StrCat(field, ".optimiser"), "say it as options.method");
  }
  if (inner_loop.has_steps()) {
    if (inner_loop.steps() > kMaxSteps) {
      return FieldViolation(absl::StrCat(field, ".steps"),
                            absl::StrCat("is ", inner_loop.steps(), ", at most ", kMaxSteps));
    }
    options.inner_loop.steps = static_cast<int32_t>(inner_loop.steps());
  }
  if (inner_loop.has_learning_rate()) {
    const double rate = inner_loop.learning_rate();
    if (!std::isfinite(rate) || rate <= 0) {
      return FieldViolation(absl::StrCat(field, ".learning_rate"),
                            absl::StrCat("is ", base::FormatExact(rate), ", must be positive"));
    }
    options.inner_loop.learning_rate = rate;
    options.inner_loop.tensor_rates.clear();  // one rate is asked for
  }
  if (!inner_loop.adapted_mask().empty()) {
    options.inner_loop.adapted_mask = inner_loop.adapted_mask();
    METAEKF_RETURN_IF_ERROR(
        InField(absl::StrCat(field, ".adapted_mask"),
                nn::ParseMask(options.inner_loop.adapted_mask, bundle.model.layout()).status()));
  }
  METAEKF_RETURN_IF_ERROR(TakeTensorRates(inner_loop, field, bundle, &options.inner_loop));
  return options;
}

std::string AdaptationReceipt(const meta::AdaptationOptions& options,
                              const meta::AdaptationResult& result, double duration_s) {
  v1::Adaptation message;
  message.set_method(ToMessage(options.method));
  message.mutable_inner_loop()->set_steps(static_cast<uint32_t>(result.steps));
  message.mutable_inner_loop()->set_learning_rate(options.inner_loop.learning_rate);
  message.mutable_inner_loop()->set_adapted_mask(options.inner_loop.adapted_mask);
  message.mutable_inner_loop()->mutable_tensor_rates()->insert(
      options.inner_loop.tensor_rates.begin(), options.inner_loop.tensor_rates.end());
  message.set_seed(options.seed);
  message.set_context_samples(static_cast<uint32_t>(result.context_samples));
  message.set_context_loss_before(result.context_loss_before);
  message.set_context_loss_after(result.context_loss_after);
  if (result.tail_samples > 0) {
    v1::HeldOutErrors& held_out = *message.mutable_held_out();
    held_out.set_samples(static_cast<uint32_t>(result.tail_samples));
    *held_out.mutable_before() = ToMessage(result.before);
    *held_out.mutable_after() = ToMessage(result.after);
    *held_out.mutable_arx() = ToMessage(result.arx);
    held_out.set_better_than_unadapted(meta::BetterInFreeRun(result.after, result.before));
    held_out.set_better_than_arx(meta::BetterInFreeRun(result.after, result.arx));
  }
  message.set_duration_s(duration_s);
  return MessageToJson(message);
}

v1::Adaptation ToMessage(const store::Adaptation& adaptation) {
  v1::Adaptation message;
  // Written by this server; what cannot be read is left out.
  JsonToMessage(adaptation.receipt_json, &message).IgnoreError();
  message.set_name(AdaptationName(adaptation.id));
  message.set_model_version(VersionName(adaptation.model, adaptation.version));
  *message.mutable_create_time() = ToTimestamp(adaptation.create_time);
  return message;
}

}  // namespace metaekf::server
