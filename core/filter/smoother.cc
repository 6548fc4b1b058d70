#include "core/filter/smoother.h"

#include <Eigen/Cholesky>
#include <Eigen/QR>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/filter/constrain.h"
#include "core/filter/square_root.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

struct Posterior {
  StepTrace trace;
  VectorXd mean;
  MatrixXd factor;
  bool usable() const { return !trace.warming_up && mean.allFinite() && factor.allFinite(); }
};

/// Cᵀ = (P⁻)⁻¹ F P⁺; of a singular P⁻ the pseudoinverse: what is known exactly needs no correction.
MatrixXd TransposedGain(const MatrixXd& prior_cov, const MatrixXd& cross) {
  const Eigen::LLT<MatrixXd> cholesky(prior_cov);
  if (cholesky.info() == Eigen::Success && cholesky.rcond() > 1e-13) return cholesky.solve(cross);
  return prior_cov.completeOrthogonalDecomposition().solve(cross);
}

/// The state at one sample from that at the next: `later` is smoothed already, `now` becomes so.
void StepBack(const StepTrace& link, const MatrixXd& process_factor, const Posterior& later, Posterior* now) {
  const Index n = now->mean.size();
  const MatrixXd moved = link.F * now->factor;  // F L⁺
  MatrixXd noise(n, 2 * n);                     // the factor of P⁻ − F P⁺ Fᵀ
  noise << std::sqrt(link.widening - 1) * moved, std::sqrt(link.widening) * process_factor;
  const MatrixXd prior_cov = moved * moved.transpose() + noise * noise.transpose();
  const MatrixXd C = TransposedGain(prior_cov, moved * now->factor.transpose()).transpose();
  MatrixXd work(n, 4 * n);
  work << now->factor - C * moved, C * later.factor, C * noise;
  LowerTriangularise(work);
  now->mean += C * (later.mean - link.prior);
  now->factor = work.leftCols(n);
}

}  // namespace

absl::StatusOr<std::vector<Estimate>> Smooth(Ekf filter, const data::Trajectory& trajectory, FilterModel::Scratch* scratch) {
  const Index steps = trajectory.length();
  std::vector<Estimate> estimates(static_cast<size_t>(steps), filter.MakeEstimate());
  std::vector<Posterior> posteriors(static_cast<size_t>(steps));
  for (Index t = 0; t < steps; ++t) {
    Posterior& posterior = posteriors[static_cast<size_t>(t)];
    filter.set_trace(&posterior.trace);
    METAEKF_RETURN_IF_ERROR(base::Annotate(filter.Step(trajectory.inputs.col(t), trajectory.outputs.col(t), scratch,
                                                       &estimates[static_cast<size_t>(t)]),
                                           absl::StrCat("sample ", t + 1)));
    posterior.mean = filter.state().mean;
    posterior.factor = filter.state().factor;
  }
  filter.set_trace(nullptr);
  for (size_t t = posteriors.size() - 1; t-- > 0;) {
    Posterior& now = posteriors[t];
    const Posterior& later = posteriors[t + 1];
    if (!now.usable() || !later.usable() || !later.trace.linked) continue;
    StepBack(later.trace, filter.process_factor(), later, &now);
    const physics::Polyhedron* const set = filter.normalised_set();
    if (set != nullptr && filter.projects() && now.usable()) {
      const ConstraintEffect effect = Constrain(*set, &now.mean, &now.factor);
      estimates[t].slack = effect.slack;
      estimates[t].projection = effect.projection;
    }
    filter.Describe(now.mean, now.factor, now.trace.input, scratch, &estimates[t]);
  }
  return estimates;
}

int64_t SmoothingBytesPerSample(const Ekf& filter) {
  constexpr int64_t kAllocations = 9, kPerAllocation = 16;
  const int64_t n = filter.process_factor().rows(), n_u = filter.input_size(), n_y = filter.output_size();
  const int64_t width = filter.estimate_size();
  const int64_t values = 2 * n * n + 2 * n + n_u + width * (width + 1) + n_y * (n_y + 1);
  return static_cast<int64_t>(sizeof(Posterior) + sizeof(Estimate) + sizeof(double) * values) + kAllocations * kPerAllocation;
}

}  // namespace metaekf::filter
