#include "core/meta/fit_plan.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "core/base/status.h"
#include "core/data/split.h"

namespace metaekf::meta {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::GaussianPrior;
using nssm::LossData;
using nssm::RolloutLeastSquares;

namespace {

constexpr Index kScreeningSamples = 300;   // of the context, to choose among starts
constexpr int kScreeningSteps = 3;         // for c₀ of each
constexpr size_t kContenders = 3;          // starts that go on
constexpr int kContenderSteps = 7;
constexpr double kContenderTolerance = 1e-3;
constexpr double kWarmDamping = 1e-2;      // of a fit from parameters that have been learned
constexpr double kContinuedDamping = 1e-4; // of a fit that goes on from one to fewer samples of the system

VectorXd MeanOf(const RolloutLeastSquares& problem, const std::vector<double>& mean) {
  VectorXd unknowns = VectorXd::Zero(problem.unknowns());
  unknowns.head(problem.adapted_size()) = GatherAdapted(problem, mean);
  return unknowns;
}

/// ½ (x − m)ᵀ Λ (x − m) of the adapted part.
double Penalty(const Belief& belief, const VectorXd& x, Index adapted) {
  const VectorXd d = x.head(adapted) - belief.mean.head(adapted);
  return 0.5 * d.dot(belief.precision.topLeftCorner(adapted, adapted).selfadjointView<Eigen::Lower>() * d);
}

/// A point to fit from, and Φ there.
struct Candidate {
  double cost = 0;
  VectorXd unknowns;
  double damping = kWarmDamping;
};

/// A workspace for every thread, made when it is first asked for.
class Workspaces {
 public:
  Workspaces(const RolloutLeastSquares& problem, const nssm::LossShape& shape, const base::Executor& executor)
      : problem_(problem), shape_(shape), of_slots_(executor.concurrency()) {}

  RolloutLeastSquares::Workspace* Of(size_t slot) {
    if (!of_slots_[slot]) of_slots_[slot] = std::make_unique<RolloutLeastSquares::Workspace>(problem_, shape_);
    return of_slots_[slot].get();
  }

 private:
  const RolloutLeastSquares& problem_;
  nssm::LossShape shape_;
  std::vector<std::unique_ptr<RolloutLeastSquares::Workspace>> of_slots_;
};

bool Cheaper(const Candidate& a, const Candidate& b) { return a.cost < b.cost; }

}  // namespace

FitPlan::FitPlan(const nssm::Model& model, const nssm::LossSpec& loss, const nn::Mask& adapted)
    : dynamics(model, loss, adapted, model.spec().fits_start()) {
  if (model.spec().fits_start()) start.emplace(model, loss, nn::Mask(adapted.size(), false), true);
}

absl::Status FitPlan::CheckPrior(const GaussianPrior& prior) const {
  const auto check = [](const std::string& name, const MatrixXd& matrix, Index rows, Index cols) {
    if (matrix.rows() == rows && matrix.cols() == cols) return absl::OkStatus();
    return absl::InvalidArgumentError(absl::StrCat("prior.", name, " is ", matrix.rows(), " × ", matrix.cols(), ", the adapted parameters need ",
                                                   rows, " × ", cols));
  };
  const Index p = dynamics.adapted_size(), n = start ? start->carry_size() : 0;
  METAEKF_RETURN_IF_ERROR(check("dynamics", prior.dynamics, p, p));
  METAEKF_RETURN_IF_ERROR(check("start", prior.start, n, n));
  METAEKF_RETURN_IF_ERROR(check("noise_variance", prior.noise_variance, dynamics.channels(), 1));
  if (prior.loadings.size() > 0) METAEKF_RETURN_IF_ERROR(check("loadings", prior.loadings, p, prior.loadings.cols()));
  if (prior.examples.size() == 0) return absl::OkStatus();
  return check("examples", prior.examples, p, prior.examples.cols());
}

Belief FitPlan::BeliefOf(const GaussianPrior& prior, const std::vector<double>& mean) const {
  const Index p = dynamics.adapted_size(), n = prior.start.rows();
  Belief belief{.mean = MeanOf(dynamics, mean), .precision = MatrixXd::Zero(p + n, p + n), .noise_variance = prior.noise_variance};
  belief.precision.topLeftCorner(p, p) = prior.dynamics;
  belief.precision.bottomRightCorner(n, n) = prior.start;
  return belief;
}

namespace {

/// What may vary under a prior with loadings: z ~ N(0, I) and the start.
std::optional<Directions> DirectionsOf(const GaussianPrior& prior) {
  if (prior.loadings.size() == 0) return std::nullopt;
  const Index p = prior.loadings.rows(), k = prior.loadings.cols(), n = prior.start.rows();
  Directions directions{MatrixXd::Zero(p + n, k + n), MatrixXd::Identity(k + n, k + n)};
  directions.basis.topLeftCorner(p, k) = prior.loadings;
  directions.basis.bottomRightCorner(n, n).setIdentity();
  directions.precision.bottomRightCorner(n, n) = prior.start;
  return directions;
}

/// The mean and those examples that are the most probable, each with a start c₀ fitted to the first samples.
absl::StatusOr<std::vector<Candidate>> Screen(const FitPlan& plan, const GaussianPrior& prior, const std::vector<double>& mean,
                                              const Belief& belief, const std::optional<Directions>& directions,
                                              const Trajectory& normalised, base::Executor* executor) {
  METAEKF_ASSIGN_OR_RETURN(const Trajectory head,
                           data::FirstSamples(normalised, std::min(normalised.length(), kScreeningSamples)));
  const RolloutLeastSquares& screened = plan.start ? *plan.start : plan.dynamics;
  METAEKF_ASSIGN_OR_RETURN(const LossData<double> few, screened.Cut(plan.start ? head : normalised));
  const Index adapted = plan.dynamics.adapted_size();
  const VectorXd weights = prior.noise_variance.cwiseInverse();
  const Belief start_belief{.mean = VectorXd::Zero(prior.start.rows()), .precision = prior.start, .noise_variance = prior.noise_variance};
  Workspaces workspaces(screened, few.shape, *executor);
  std::vector<Candidate> candidates(1 + static_cast<size_t>(prior.examples.cols()));
  executor->ParallelFor(candidates.size(), [&](size_t i, size_t slot) {
    Candidate& candidate = candidates[i];
    candidate.unknowns = belief.mean;
    if (i > 0) candidate.unknowns.head(adapted) = prior.examples.col(static_cast<Index>(i) - 1);
    double penalty = Penalty(belief, candidate.unknowns, adapted);
    if (directions) {
      const VectorXd z = CoordinatesNear(belief, directions->basis, candidate.unknowns);
      candidate.unknowns = belief.mean + directions->basis * z;
      penalty = 0.5 * z.head(prior.loadings.cols()).squaredNorm();
    }
    std::vector<double> parameters = mean;
    ScatterAdapted(plan.dynamics, candidate.unknowns, &parameters);
    if (plan.start) {
      const MapFit fit = FitMap(screened, few, parameters, start_belief, start_belief.mean,
                                {.optimiser = {.max_iterations = kScreeningSteps, .initial_damping = kWarmDamping}}, workspaces.Of(slot));
      candidate.unknowns.tail(prior.start.rows()) = fit.unknowns;
      candidate.cost = fit.cost;
    } else {
      candidate.cost = screened.Cost(parameters.data(), VectorXd(), weights, few, workspaces.Of(slot));
    }
    candidate.cost += penalty;
  });
  const bool mean_simulates = std::isfinite(candidates[0].cost);
  std::erase_if(candidates, [](const Candidate& candidate) { return !std::isfinite(candidate.cost); });
  // The mean stays among them: it is rarely near, but the fit from there is the least likely to stall.
  std::stable_sort(candidates.begin() + (mean_simulates ? 1 : 0), candidates.end(), Cheaper);
  if (candidates.size() > kContenders) candidates.resize(kContenders);
  return candidates;
}

}  // namespace

absl::StatusOr<SystemFit> FitSystem(const FitPlan& plan, const GaussianPrior& prior, const std::vector<double>& mean,
                                    const Trajectory& normalised, const SystemFitOptions& options,
                                    const OnFitStep& on_step) {
  METAEKF_RETURN_IF_ERROR(plan.CheckPrior(prior));
  const Belief belief = plan.BeliefOf(prior, mean);
  const std::optional<Directions> directions = DirectionsOf(prior);
  METAEKF_ASSIGN_OR_RETURN(const LossData<double> data, plan.dynamics.Cut(normalised));
  std::vector<Candidate> candidates{{.unknowns = options.from, .damping = kContinuedDamping}};
  if (options.from.size() == 0) {
    METAEKF_ASSIGN_OR_RETURN(candidates, Screen(plan, prior, mean, belief, directions, normalised, options.executor));
  }
  if (candidates.empty()) {
    return absl::OutOfRangeError("the fit diverged: neither the meta-learned parameters nor any example simulate this system");
  }
  SystemFit result{.parameters = mean};
  FitProgress progress(on_step);
  const OnIteration tell = [&progress](int step, double cost, const VectorXd&) { return progress.Tell(step, cost); };
  Workspaces workspaces(plan.dynamics, data.shape, *options.executor);
  if (candidates.size() > 1) {
    options.executor->ParallelFor(candidates.size(), [&](size_t i, size_t slot) {
      if (progress.stopped()) return;
      const MapFit fit = FitMap(plan.dynamics, data, mean, belief, candidates[i].unknowns,
                                {.optimiser = {.max_iterations = std::min(kContenderSteps, options.steps),
                                               .tolerance = kContenderTolerance},
                                 .directions = directions},
                                workspaces.Of(slot), tell);
      candidates[i] = {fit.cost, fit.unknowns, fit.damping};
    });
    std::stable_sort(candidates.begin(), candidates.end(), Cheaper);
  }
  result.fit = FitMap(plan.dynamics, data, mean, belief, candidates[0].unknowns,
                      {.optimiser = {.max_iterations = progress.stopped() ? 0 : options.steps,
                                     .tolerance = options.tolerance,
                                     .initial_damping = candidates[0].damping},
                       .noise_samples = options.noise_samples,
                       .directions = directions},
                      workspaces.Of(0), tell);
  if (directions) {
    result.fit.unknowns.head(prior.loadings.rows()) =
        nssm::AlongLoadings(prior, belief.mean.head(prior.loadings.rows()), result.fit.coordinates.head(prior.loadings.cols()));
  }
  ScatterAdapted(plan.dynamics, result.fit.unknowns, &result.parameters);
  return result;
}

}  // namespace metaekf::meta
