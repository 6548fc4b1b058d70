#include "core/meta/scratch_fit.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/base/status.h"
#include "core/data/split.h"
#include "core/meta/linear_start.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::LossData;
using nssm::RolloutLeastSquares;

constexpr double kPrecision = 1e-6;  // knows nothing
constexpr double kTolerance = 1e-5;
constexpr int kHorizonGrowth = 4;    // from one stage to the next
constexpr int64_t kTailShare = 5;    // one in so many samples is held out
constexpr double kOverfit = 2;       // times the least squared error on the tail, that of a minimum which has learned noise
constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// Looks at a fit on its way. @param parameters  ω, whose adapted part is in the unknowns.
using Inspect = std::function<void(const std::vector<double>& parameters, const VectorXd& unknowns)>;

/// The fits of one system, from any start.
class ScratchFits {
 public:
  ScratchFits(const FitPlan& plan, const nssm::Model& model, const nssm::LossSpec& loss, const FromScratchOptions& options)
      : plan_(plan), model_(model), loss_(loss), options_(options) {
    const Index n = plan.dynamics.unknowns(), outputs = model.spec().output_size;
    weights_ = VectorXd::Constant(plan.dynamics.channels(), loss.output_weight);
    weights_.head(weights_.size() - outputs).setConstant(loss.state_weight);
    belief_ = {.mean = VectorXd::Zero(n), .precision = kPrecision * MatrixXd::Identity(n, n), .noise_variance = weights_.cwiseInverse()};
  }

  /// Of the channels, as the loss has them.
  const VectorXd& weights() const { return weights_; }

  /// From one start, rollouts growing to their full length.
  /// @param data  the recording, cut. @param inspect  sees the fit at full length alone.
  SystemFit Fit(size_t restart, const Trajectory& recording, const LossData<double>& data, const Inspect& inspect,
                FitProgress* progress) const {
    const uint64_t seed = options_.seed + restart;
    const absl::StatusOr<std::vector<double>> linear = LinearStart(model_, recording, seed);
    SystemFit result{.parameters = linear.ok() ? *linear : model_.InitialParameters(seed)};
    result.fit.unknowns = VectorXd::Zero(plan_.dynamics.unknowns());
    result.fit.unknowns.head(plan_.dynamics.adapted_size()) = GatherAdapted(plan_.dynamics, result.parameters);
    if (!plan_.start) {
      nssm::LossSpec shorter = loss_;
      for (shorter.horizon = 1; shorter.horizon < data.shape.horizon && !result.fit.stopped; shorter.horizon *= kHorizonGrowth) {
        const RolloutLeastSquares problem(model_, shorter, plan_.dynamics.mask(), false);
        const absl::StatusOr<LossData<double>> rollouts = problem.Cut(recording);
        if (rollouts.ok()) Continue(problem, *rollouts, options_.steps, nullptr, progress, &result);
      }
    }
    Continue(plan_.dynamics, data, result.fit.stopped ? 0 : options_.steps, inspect, progress, &result);
    ScatterAdapted(plan_.dynamics, result.fit.unknowns, &result.parameters);
    return result;
  }

  /// Goes on from the unknowns of a fit.
  void Continue(const RolloutLeastSquares& problem, const LossData<double>& data, int steps, const Inspect& inspect,
                FitProgress* progress, SystemFit* fit) const {
    RolloutLeastSquares::Workspace workspace(problem, data.shape);
    const VectorXd from = fit->fit.unknowns;
    if (inspect) inspect(fit->parameters, from);
    fit->fit = FitMap(problem, data, fit->parameters, belief_, from, {.optimiser = {.max_iterations = steps, .tolerance = kTolerance}},
                      &workspace, [&](int step, double cost, const VectorXd& unknowns) {
                        if (inspect) inspect(fit->parameters, unknowns);
                        return progress->Tell(step, cost);
                      });
  }

 private:
  const FitPlan& plan_;
  const nssm::Model& model_;
  const nssm::LossSpec& loss_;
  const FromScratchOptions& options_;
  VectorXd weights_;
  Belief belief_;
};

/// A recording without its last samples, and those.
struct HeldOut {
  Trajectory head;
  LossData<double> head_data;
  LossData<double> tail_data;  // where the start is fitted, the whole recording: the tail is simulated from there
};

/// Nothing if the recording is too short to hold anything out.
std::optional<HeldOut> HoldOut(const FitPlan& plan, const nssm::Model& model, const Trajectory& recording) {
  const int64_t samples = std::max<int64_t>(recording.length() / kTailShare, model.spec().warmup() + 1);
  const absl::StatusOr<Trajectory> head = data::FirstSamples(recording, recording.length() - samples);
  const absl::StatusOr<Trajectory> tail = data::SamplesFrom(recording, recording.length() - samples);
  if (!head.ok() || !tail.ok()) return std::nullopt;
  absl::StatusOr<LossData<double>> head_data = plan.dynamics.Cut(*head);
  absl::StatusOr<LossData<double>> tail_data = plan.dynamics.Cut(plan.start ? recording : *tail);
  if (!head_data.ok() || !tail_data.ok()) return std::nullopt;
  return HeldOut{*head, *std::move(head_data), *std::move(tail_data)};
}

/// ½ Σ w r² over the samples held out. One thread's.
class TailCost {
 public:
  TailCost(const FitPlan& plan, const HeldOut& held_out, const VectorXd& weights)
      : plan_(plan), held_out_(held_out), weights_(weights), head_(plan.dynamics, held_out.head_data.shape), tail_(plan.dynamics, held_out.tail_data.shape) {}

  double operator()(const std::vector<double>& parameters, const VectorXd& unknowns) {
    std::vector<double> all = parameters;
    ScatterAdapted(plan_.dynamics, unknowns, &all);
    const VectorXd start = unknowns.tail(unknowns.size() - plan_.dynamics.adapted_size());
    const double cost = plan_.dynamics.Cost(all.data(), start, weights_, held_out_.tail_data, &tail_);
    return plan_.start ? cost - plan_.dynamics.Cost(all.data(), start, weights_, held_out_.head_data, &head_) : cost;
  }

 private:
  const FitPlan& plan_;
  const HeldOut& held_out_;
  const VectorXd& weights_;
  RolloutLeastSquares::Workspace head_, tail_;
};

/// What has come of one start.
struct Start {
  SystemFit fit;
  double cost = kInfinity;       // that starts are compared by
  VectorXd unknowns;             // of that cost, where something is held out
  double last_cost = kInfinity;  // on the tail, where the fit ended
};

}  // namespace

absl::StatusOr<SystemFit> FitFromScratch(const FitPlan& plan, const nssm::Model& model, const nssm::LossSpec& loss,
                                         const Trajectory& normalised, const FromScratchOptions& options,
                                         const OnFitStep& on_step) {
  METAEKF_ASSIGN_OR_RETURN(const LossData<double> whole, plan.dynamics.Cut(normalised));
  const ScratchFits fits(plan, model, loss, options);
  const std::optional<HeldOut> held_out = options.stop_early ? HoldOut(plan, model, normalised) : std::nullopt;
  std::vector<Start> starts(static_cast<size_t>(options.restarts));
  FitProgress progress(on_step);
  options.executor->ParallelFor(starts.size(), [&](size_t i, size_t) {
    if (progress.stopped()) return;
    Start& start = starts[i];
    if (!held_out) {
      start.fit = fits.Fit(i, normalised, whole, nullptr, &progress);
      start.cost = start.fit.fit.cost;
      return;
    }
    TailCost cost(plan, *held_out, fits.weights());
    const Inspect inspect = [&](const std::vector<double>& parameters, const VectorXd& unknowns) {
      start.last_cost = cost(parameters, unknowns);
      if (!(start.last_cost < start.cost)) return;
      start.cost = start.last_cost;
      start.unknowns = unknowns;
    };
    start.fit = fits.Fit(i, held_out->head, held_out->head_data, inspect, &progress);
  });
  const auto best = std::min_element(starts.begin(), starts.end(), [](const Start& a, const Start& b) {
    return std::isfinite(a.cost) && (!std::isfinite(b.cost) || a.cost < b.cost);
  });
  if (best == starts.end() || !std::isfinite(best->cost)) {
    return absl::OutOfRangeError("no start of the fit simulates the system; shorter rollouts or another seed may help");
  }
  if (held_out) {
    const bool to_minimum = best->last_cost <= kOverfit * best->cost && !progress.stopped();
    best->fit.fit.unknowns = best->unknowns;
    fits.Continue(plan.dynamics, whole, to_minimum ? options.steps : 0, nullptr, &progress, &best->fit);
    ScatterAdapted(plan.dynamics, best->fit.fit.unknowns, &best->fit.parameters);
  }
  SystemFit result = std::move(best->fit);
  const double samples = static_cast<double>(whole.shape.rollouts) * whole.shape.horizon;
  for (Index c = 0; c < fits.weights().size(); ++c) {
    if (fits.weights()[c] > 0) result.fit.noise_variance[c] = result.fit.channel_squares[c] / samples;
  }
  return result;
}

}  // namespace metaekf::meta
