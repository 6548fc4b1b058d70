#include "core/experiments/classical.h"

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/meta/arx.h"
#include "core/meta/output_error.h"
#include "core/meta/polynomial_narx.h"

namespace metaekf::experiments {
namespace {

/// A fitted model that predicts as ArxModel does.
template <typename Model>
SystemModel Wrapped(Model model, int64_t warmup) {
  const auto predict = [model = std::move(model), warmup](const data::Trajectory& recording, nssm::PredictionMode mode) {
    return absl::StatusOr<Eigen::MatrixXd>(model.Predict(recording, mode == nssm::PredictionMode::kSimulate, warmup));
  };
  return {.warmup = warmup, .predict = predict};
}

}  // namespace

ClassicalModel Arx(int order) {
  return {absl::StrCat("ARX(", order, ")"), [order](const data::Trajectory& context) -> absl::StatusOr<SystemModel> {
            METAEKF_ASSIGN_OR_RETURN(meta::ArxModel model, meta::ArxModel::Fit(context, order));
            return Wrapped(std::move(model), order);
          }};
}

ClassicalModel OutputError(int order) {
  return {absl::StrCat("OE(", order, ")"), [order](const data::Trajectory& context) -> absl::StatusOr<SystemModel> {
            METAEKF_ASSIGN_OR_RETURN(meta::OutputErrorModel model, meta::OutputErrorModel::Fit(context, order));
            return Wrapped(std::move(model), order);
          }};
}

ClassicalModel PolynomialNarx(int order, int degree) {
  return {absl::StrCat("NARX(", order, "), degree ", degree),
          [order, degree](const data::Trajectory& context) -> absl::StatusOr<SystemModel> {
            METAEKF_ASSIGN_OR_RETURN(meta::PolynomialNarxModel model,
                                     meta::PolynomialNarxModel::Fit(context, order, degree));
            return Wrapped(std::move(model), order);
          }};
}

}  // namespace metaekf::experiments
