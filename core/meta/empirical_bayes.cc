#include "core/meta/empirical_bayes.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/base/status.h"
#include "core/data/split.h"
#include "core/linalg/decompositions.h"
#include "core/meta/covariance_structure.h"
#include "core/meta/fit_plan.h"
#include "core/meta/scratch_fit.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::GaussianPrior;
using nssm::LossData;
using nssm::RolloutLeastSquares;

constexpr double kTolerance = 1e-5;
constexpr double kWarmDamping = 1e-2;     // of a fit that goes on from the last round's
constexpr double kStalled = 6;            // times the median mean square of the residuals
constexpr size_t kBatch = 8;              // systems between two calls of on_step
constexpr Index kGuessStride = 5;         // samples between windows of the regression for the start
constexpr double kGuessRidge = 1e-8;
constexpr double kOwnDoubt = 1e-3;        // of the mean variance of systems' own parameters

double Median(std::vector<double> values) {
  std::nth_element(values.begin(), values.begin() + static_cast<Index>(values.size() / 2), values.end());
  return values[values.size() / 2];
}

/// A⁻¹ of a matrix that is positive definite but for rounding, as the information of data without noise is: with the least
/// ridge along its diagonal that lets it be factored. Nothing if none does.
std::optional<MatrixXd> InverseOf(const MatrixXd& a) {
  constexpr double kFirstRidge = 1e-16, kLastRidge = 1e-8;
  for (double ridge = 0; ridge <= kLastRidge; ridge = std::max(kFirstRidge, 10 * ridge)) {
    MatrixXd regular = a;
    regular.diagonal() *= 1 + ridge;
    const linalg::Cholesky factor(std::move(regular));
    if (factor.ok()) return factor.Inverse();
  }
  return std::nullopt;
}

/// A workspace that is made again only for sets of another shape.
class SlotWorkspace {
 public:
  RolloutLeastSquares::Workspace* For(const RolloutLeastSquares& problem, const nssm::LossShape& shape) {
    if (!workspace_ || problem_ != &problem || !(shape_ == shape)) {
      workspace_.emplace(problem, shape);
      problem_ = &problem;
      shape_ = shape;
    }
    return &*workspace_;
  }

 private:
  std::optional<RolloutLeastSquares::Workspace> workspace_;
  const RolloutLeastSquares* problem_ = nullptr;
  nssm::LossShape shape_;
};

/// Fits of all systems of a fleet under one belief, and the next belief.
struct Population {
  Belief belief;
  MatrixXd loadings;  // of kManifold
  std::vector<VectorXd> fits;
  std::vector<bool> accepted;
};

bool FitsBeginTogether(const GaussianPriorSpec& options) {
  return options.meta_iterations > 0 && options.meta_algorithm == Algorithm::kMixedEffects;
}

class Learner {
 public:
  Learner(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, const Systems& systems,
          const LearnedStart& shared, base::Executor* executor, TrainingState* state, const OnTrainingStep& on_step)
      : spec_(spec),
        options_(spec.gaussian_prior),
        model_(model),
        plan_(model, spec.loss, mask),
        systems_(systems),
        shared_(shared),
        executor_(*executor),
        state_(*state),
        on_step_(on_step),
        workspaces_(executor->concurrency()) {}

  absl::StatusOr<LearnedPrior> Run() {
    METAEKF_RETURN_IF_ERROR(CheckStructure(options_, plan_.dynamics.adapted_size()));
    METAEKF_ASSIGN_OR_RETURN(data_, CutAll(plan_.dynamics));
    if (state_.values.empty()) {
      state_.iteration = options_.meta_iterations;
      METAEKF_RETURN_IF_ERROR(shared_.parameters.empty() ? FirstFit() : BeginFromShared());
    } else {
      METAEKF_RETURN_IF_ERROR(Restore());
    }
    for (; round_ <= options_.rounds; ++round_) {
      const int32_t steps = round_ == 0 ? options_.first_steps : options_.round_steps;
      METAEKF_RETURN_IF_ERROR(Round(steps));
      METAEKF_RETURN_IF_ERROR(Validate());
      Save(round_ + 1);
    }
    if (plan_.start) LearnStartGuess();
    return std::move(best_);
  }

 private:
  absl::StatusOr<std::vector<LossData<double>>> CutAll(const RolloutLeastSquares& problem) const {
    std::vector<LossData<double>> all;
    for (const Trajectory& system : systems_.training) {
      METAEKF_ASSIGN_OR_RETURN(LossData<double> data, problem.Cut(system));
      all.push_back(std::move(data));
    }
    return all;
  }

  /// Tells of `done` more fits.
  absl::Status Tell(size_t done, bool validated = false) {
    state_.iteration += static_cast<int32_t>(done);
    if (!on_step_ || on_step_({state_, PriorIterations(options_, systems_.training.size()), validated})) return absl::OkStatus();
    return absl::CancelledError("the training was cancelled");
  }

  // ---- the first fit ----

  absl::Status FirstFit() {
    METAEKF_ASSIGN_OR_RETURN(
        const SystemFit first,
        FitFromScratch(plan_, model_, spec_.loss, systems_.training[0],
                       {.seed = spec_.seed, .restarts = options_.restarts, .steps = options_.first_steps, .executor = &executor_}, nullptr));
    start_ = first.parameters;
    Believe(first.fit.unknowns, first.fit.noise_variance);
    METAEKF_RETURN_IF_ERROR(Tell(static_cast<size_t>(options_.restarts)));
    Save(0);
    return absl::OkStatus();
  }

  /// ω₀ is there, and the noise is what a fit of one system from there leaves.
  absl::Status BeginFromShared() {
    start_ = shared_.parameters;
    Believe(GatherAdapted(plan_.dynamics, start_), VectorXd::Ones(plan_.dynamics.channels()));
    const MapFit fit = FitMap(plan_.dynamics, data_[0], start_, population_.belief, population_.belief.mean,
                              {.optimiser = {.max_iterations = options_.first_steps, .tolerance = kTolerance}, .noise_samples = 1},
                              workspaces_[0].For(plan_.dynamics, data_[0].shape));
    if (!fit.unknowns.allFinite() || !fit.noise_variance.allFinite()) {
      return absl::OutOfRangeError("the training diverged: no fit of the first system from what MAML has learned");
    }
    population_.belief.noise_variance = fit.noise_variance;
    if (shared_.own.size() > 0) METAEKF_RETURN_IF_ERROR(BelieveOwn());
    ++state_.iteration;
    Save(0);  // whoever is told may keep this state, by which the training knows that MAML is done
    return Tell(0);
  }

  /// The systems' own parameters are their first fits, as if they had been found without doubt but for kOwnDoubt.
  absl::Status BelieveOwn() {
    const Index p = plan_.dynamics.adapted_size(), size = population_.belief.mean.size();
    const size_t count = data_.size();
    for (size_t s = 0; s < count; ++s) population_.fits[s].head(p) = shared_.own.col(static_cast<Index>(s));
    const double spread = (shared_.own.colwise() - shared_.own.rowwise().mean()).squaredNorm() / static_cast<double>(shared_.own.size());
    MatrixXd doubt = MatrixXd::Identity(size, size);
    doubt.topLeftCorner(p, p) *= kOwnDoubt * spread;
    const std::vector<double> ones(count, 1.0);
    return Maximise(ones, std::vector<VectorXd>(count, population_.belief.noise_variance), std::vector<MatrixXd>(count, doubt), &population_);
  }

  /// Before the first round: N(θ, initial_std²), and every fit begins at θ.
  void Believe(const VectorXd& unknowns, const VectorXd& noise_variance) {
    const Index p = plan_.dynamics.adapted_size(), n = unknowns.size() - p;
    Belief& belief = population_.belief;
    belief.mean = unknowns;
    belief.mean.tail(n).setZero();
    VectorXd precision = VectorXd::Constant(p + n, 1 / (options_.initial_std * options_.initial_std));
    precision.tail(n).setOnes();  // latents are of the order of one
    belief.precision = precision.asDiagonal();
    belief.noise_variance = noise_variance;
    population_.fits.assign(systems_.training.size(), unknowns);
    population_.accepted.assign(systems_.training.size(), true);
    state_.best_validation_loss = state_.validation_loss = std::numeric_limits<double>::infinity();
  }

  static int64_t Samples(const LossData<double>& data) { return int64_t{data.shape.rollouts} * data.shape.horizon; }

  // ---- expectation and maximisation ----

  absl::Status Round(int32_t steps) {
    const size_t count = data_.size();
    const Belief& belief = population_.belief;
    std::vector<MatrixXd> covariances(count);
    std::vector<double> mean_squares(count);
    std::vector<VectorXd> variances(count);
    LearnedPrior current = Current();
    current.prior.loadings.resize(0, 0);  // what a system has off the manifold is what D is learned from
    for (size_t first = 0; first < count; first += kBatch) {
      const size_t batch = std::min(kBatch, count - first);
      if (round_ == 0) current.prior.examples = Examples(first);
      executor_.ParallelFor(batch, [&](size_t i, size_t slot) {
        const size_t s = first + i;
        // With other fits among its starts a system can join the basin that most are in, where the prior is narrower. Mixed effects
        // have been found together: they are in one.
        absl::StatusOr<SystemFit> found = absl::NotFoundError("");
        if (!FitsBeginTogether(options_)) {
          found = FitSystem(plan_, current.prior, current.parameters, systems_.training[s],
                            {.steps = steps, .tolerance = kTolerance, .noise_samples = std::numeric_limits<double>::infinity()}, nullptr);
        }
        MapFit own = FitMap(plan_.dynamics, data_[s], current.parameters, belief, population_.fits[s],
                            {.optimiser = {.max_iterations = steps, .tolerance = kTolerance, .initial_damping = kWarmDamping}},
                            workspaces_[slot].For(plan_.dynamics, data_[s].shape));
        const MapFit& fit = found.ok() && !(own.cost <= found->fit.cost) ? found->fit : own;
        population_.fits[s] = fit.unknowns;
        const std::optional<MatrixXd> covariance = InverseOf(fit.information);
        mean_squares[s] = std::numeric_limits<double>::infinity();
        if (!covariance) return;  // a fit that failed: it is not accepted
        covariances[s] = *covariance;
        const double samples = static_cast<double>(Samples(data_[s]));
        const double determined =
            static_cast<double>(fit.unknowns.size()) - (covariances[s] * belief.precision).trace();
        const double channels = static_cast<double>(fit.channel_squares.size());
        variances[s] = fit.channel_squares / std::max(1.0, samples - determined / channels);
        mean_squares[s] = belief.noise_variance.cwiseInverse().dot(fit.channel_squares) / (samples * channels);
      });
      METAEKF_RETURN_IF_ERROR(Tell(batch));
    }
    state_.training_loss = Median(mean_squares) * belief.noise_variance.minCoeff();
    METAEKF_RETURN_IF_ERROR(Maximise(mean_squares, variances, covariances, &population_));
    return absl::OkStatus();
  }

  absl::Status Maximise(const std::vector<double>& mean_squares, const std::vector<VectorXd>& variances,
                        const std::vector<MatrixXd>& covariances, Population* population) const {
    std::vector<double> finite;
    for (const double value : mean_squares) finite.push_back(std::isfinite(value) ? value : std::numeric_limits<double>::max());
    const double limit = kStalled * Median(finite);
    if (!std::isfinite(limit)) {
      return absl::OutOfRangeError("the training diverged: half of the systems or more have no fit; another seed may help");
    }
    const Index adapted = plan_.dynamics.adapted_size(), size = population->belief.mean.size(), starts = size - adapted;
    double count = 0;
    VectorXd mean = VectorXd::Zero(size);
    for (size_t s = 0; s < finite.size(); ++s) {
      population->accepted[s] = finite[s] <= limit;
      if (!population->accepted[s]) continue;
      mean += population->fits[s];
      ++count;
    }
    mean /= count;
    mean.tail(starts).setZero();  // where a recording begins says nothing about the next
    MatrixXd covariance = MatrixXd::Zero(size, size);
    for (size_t s = 0; s < finite.size(); ++s) {
      if (!population->accepted[s]) continue;
      const VectorXd deviation = population->fits[s] - mean;
      covariance += (deviation * deviation.transpose() + covariances[s]) / count;
    }
    covariance.topRightCorner(adapted, starts).setZero();
    covariance.bottomLeftCorner(starts, adapted).setZero();
    const StructuredCovariance structured =
        FitStructure(options_, plan_.dynamics.adapted(), covariance.topLeftCorner(adapted, adapted));
    covariance.topLeftCorner(adapted, adapted) = structured.covariance;
    if (options_.covariance == PriorCovariance::kManifold) {
      if (structured.loadings.cols() == 0) {
        return absl::OutOfRangeError("gaussian_prior.covariance: the systems have no direction in common to differ along, so there "
                                     "is no MANIFOLD; FULL or BLOCK suits them");
      }
      population->loadings = structured.loadings;
    }
    Belief& belief = population->belief;
    belief.mean = mean;
    const std::optional<MatrixXd> precision = InverseOf(covariance);
    if (!precision) return absl::OutOfRangeError("the training diverged: the fits of the fleet have no covariance");
    belief.precision = *precision;
    for (Index c = 0; c < belief.noise_variance.size(); ++c) {
      if (!std::isfinite(belief.noise_variance[c])) continue;
      std::vector<double> of_channel;
      for (size_t s = 0; s < finite.size(); ++s) {
        if (population->accepted[s]) of_channel.push_back(variances[s][c]);
      }
      belief.noise_variance[c] = Median(of_channel);
    }
    return absl::OkStatus();
  }

  /// What the population says of a new system.
  LearnedPrior Current() const {
    const Index p = plan_.dynamics.adapted_size(), n = population_.belief.mean.size() - p;
    LearnedPrior current{.parameters = start_};
    ScatterAdapted(plan_.dynamics, population_.belief.mean, &current.parameters);
    GaussianPrior& prior = current.prior;
    prior.dynamics = population_.belief.precision.topLeftCorner(p, p);
    prior.start = population_.belief.precision.bottomRightCorner(n, n);
    prior.noise_variance = population_.belief.noise_variance;
    prior.examples = Examples(population_.fits.size());
    prior.loadings = population_.loadings;
    return current;
  }

  /// The accepted fits among the first `count` systems.
  MatrixXd Examples(size_t count) const {
    const Index p = plan_.dynamics.adapted_size();
    MatrixXd examples(p, static_cast<Index>(std::count(population_.accepted.begin(), population_.accepted.begin() + static_cast<Index>(count), true)));
    Index column = 0;
    for (size_t s = 0; s < count; ++s) {
      if (population_.accepted[s]) examples.col(column++) = population_.fits[s].head(p);
    }
    return examples;
  }

  // ---- validation ----

  /// Free-run error on what follows a context, geometric mean over the held-out systems; keeps the best prior.
  absl::Status Validate() {
    LearnedPrior current = Current();
    if (systems_.validation.empty()) {
      best_ = std::move(current);
      return absl::OkStatus();
    }
    std::vector<double> losses(systems_.validation.size());
    executor_.ParallelFor(losses.size(), [&](size_t i, size_t) {
      losses[i] = std::log(TargetLoss(current, systems_.validation[i]));
    });
    double sum = 0;
    for (const double loss : losses) sum += loss;
    state_.validation_loss = std::exp(sum / static_cast<double>(losses.size()));
    if (state_.validation_loss < state_.best_validation_loss || best_.parameters.empty()) {
      state_.best_validation_loss = state_.validation_loss;
      best_ = std::move(current);
    }
    return Tell(0, true);
  }

  /// Mean square error of the outputs after a context that the system was fitted to.
  double TargetLoss(const LearnedPrior& learned, const Trajectory& system) const {
    constexpr double kHopeless = 1;  // the variance of the normalised outputs
    const Index context = std::min<Index>(spec_.context_samples, system.length() / 2);
    const Index end = std::min<Index>(context + spec_.target_samples, system.length());
    const auto head = data::FirstSamples(system, context), both = data::FirstSamples(system, end);
    if (!head.ok() || !both.ok()) return kHopeless;
    const auto fit = FitSystem(plan_, learned.prior, learned.parameters, *head, {.steps = spec_.adaptation.steps}, nullptr);
    const auto data = plan_.dynamics.Cut(spec_.model.fits_start() ? *both : *data::SamplesFrom(*both, context));
    if (!fit.ok() || !data.ok()) return kHopeless;
    RolloutLeastSquares::Workspace workspace(plan_.dynamics, data->shape);
    const VectorXd start = fit->fit.unknowns.tail(learned.prior.start.rows());
    const MatrixXd predictions = plan_.dynamics.Predictions(fit->parameters.data(), start, *data, &workspace);
    const Index n_y = model_.spec().output_size;
    const Eigen::Map<const MatrixXd> measured(data->outputs.data(), n_y, predictions.cols());
    const Index from = spec_.model.fits_start() ? context - 1 : 0;
    const Index count = predictions.cols() - from;
    const double loss = (predictions.bottomRows(n_y) - measured).rightCols(count).squaredNorm() / static_cast<double>(count * n_y);
    return std::isfinite(loss) ? std::min(loss, kHopeless) : kHopeless;
  }

  // ---- where StartFit begins ----

  /// Linear regression of the fits' latents on the windows that begin with them.
  void LearnStartGuess() {
    const nssm::ModelSpec& model = spec_.model;
    const Index window = model.window, rows = model.input_size + model.output_size, size = window * rows + 1;
    MatrixXd gram = MatrixXd::Zero(size, size), products = MatrixXd::Zero(size, model.latent_size);
    VectorXd regressor = VectorXd::Ones(size);
    for (size_t s = 0; s < data_.size(); ++s) {
      if (!population_.accepted[s]) continue;
      const Trajectory& system = systems_.training[s];
      std::vector<double> parameters = best_.parameters;
      ScatterAdapted(plan_.dynamics, population_.fits[s], &parameters);
      const MatrixXd latents = plan_.dynamics.Carries(parameters.data(), population_.fits[s].tail(model.latent_size), data_[s],
                                                      workspaces_[0].For(plan_.dynamics, data_[s].shape));
      for (Index t = 0; t + window <= system.length(); t += kGuessStride) {
        for (Index k = 0; k < window; ++k) {
          regressor.segment(k * rows, model.input_size) = system.inputs.col(t + k);
          regressor.segment(k * rows + model.input_size, model.output_size) = system.outputs.col(t + k);
        }
        gram.selfadjointView<Eigen::Lower>().rankUpdate(regressor);
        products += regressor * latents.col(t).transpose();
      }
    }
    gram.diagonal().array() += kGuessRidge * gram.diagonal().mean();
    best_.prior.start_guess = linalg::Cholesky(gram).Solve(products).transpose();
  }

  // ---- checkpoints ----

  static std::vector<double> Flat(const MatrixXd& matrix) { return {matrix.data(), matrix.data() + matrix.size()}; }

  /// Checkpoints hold what a round begins with; one that was interrupted is begun again.
  void Save(int32_t next_round) {
    std::vector<double> fits, accepted;
    for (const VectorXd& fit : population_.fits) fits.insert(fits.end(), fit.begin(), fit.end());
    for (const bool flag : population_.accepted) accepted.push_back(flag ? 1 : 0);
    // The inverse of a loss that may be infinite still.
    state_.values = {{kPriorHasBegun, {static_cast<double>(next_round), static_cast<double>(state_.iteration), 1 / state_.best_validation_loss}},
                     {"mean", Flat(population_.belief.mean)},
                     {"precision", Flat(population_.belief.precision)},
                     {"noise_precision", Flat(population_.belief.noise_variance.cwiseInverse())},
                     {"fits", fits},
                     {"accepted", accepted},
                     {"start", start_}};
    if (best_.parameters.empty()) return;
    state_.values["best_parameters"] = best_.parameters;
    state_.values["best_dynamics"] = Flat(best_.prior.dynamics);
    state_.values["best_start"] = Flat(best_.prior.start);
    state_.values["best_noise_variance"] = Flat(best_.prior.noise_variance);
    state_.values["best_examples"] = Flat(best_.prior.examples);
    if (best_.prior.loadings.size() > 0) state_.values["best_loadings"] = Flat(best_.prior.loadings);
  }

  absl::Status Restore() {
    const Index p = plan_.dynamics.adapted_size(), size = plan_.dynamics.unknowns(), n = size - p;
    const Index systems = static_cast<Index>(systems_.training.size()), channels = plan_.dynamics.channels();
    absl::Status status = absl::OkStatus();
    const auto matrix = [&](const std::string& name, Index rows, Index cols) -> MatrixXd {
      const std::vector<double>& values = state_.values[name];
      if (cols < 0) cols = rows > 0 ? static_cast<Index>(values.size()) / rows : 0;
      if (static_cast<Index>(values.size()) != rows * cols) {
        status = absl::InvalidArgumentError(absl::StrCat("the checkpoint's \"", name, "\" is not the model's"));
        return MatrixXd::Zero(rows, cols);
      }
      return Eigen::Map<const MatrixXd>(values.data(), rows, cols);
    };
    const MatrixXd round = matrix(kPriorHasBegun, 3, 1);
    population_.belief = {.mean = matrix("mean", size, 1),
                        .precision = matrix("precision", size, size),
                        .noise_variance = matrix("noise_precision", channels, 1).cwiseInverse()};
    const MatrixXd fits = matrix("fits", size, systems), accepted = matrix("accepted", systems, 1);
    for (Index s = 0; s < systems; ++s) {
      population_.fits.push_back(fits.col(s));
      population_.accepted.push_back(accepted(s, 0) != 0);
    }
    start_ = Flat(matrix("start", static_cast<Index>(model_.layout().size()), 1));
    round_ = static_cast<int32_t>(round(0, 0));
    state_.iteration = static_cast<int32_t>(round(1, 0));
    state_.best_validation_loss = 1 / round(2, 0);
    if (round_ > 0) {
      best_.parameters = state_.values["best_parameters"];
      best_.prior.dynamics = matrix("best_dynamics", p, p);
      best_.prior.start = matrix("best_start", n, n);
      best_.prior.noise_variance = matrix("best_noise_variance", channels, 1);
      best_.prior.examples = matrix("best_examples", p, -1);
      best_.prior.loadings = matrix("best_loadings", p, -1);
      if (static_cast<int64_t>(best_.parameters.size()) != model_.layout().size()) {
        return absl::InvalidArgumentError("the checkpoint's \"best_parameters\" is not the model's");
      }
    }
    return status;
  }

  const TrainingSpec& spec_;
  const GaussianPriorSpec& options_;
  const nssm::Model& model_;
  const FitPlan plan_;
  const Systems& systems_;
  const LearnedStart& shared_;
  base::Executor& executor_;
  TrainingState& state_;
  const OnTrainingStep& on_step_;
  std::vector<SlotWorkspace> workspaces_;
  std::vector<LossData<double>> data_;
  Population population_;
  std::vector<double> start_;  // ω of the first fit: what does not adapt stays as it found it
  int32_t round_ = 0;
  LearnedPrior best_;
};

}  // namespace

absl::StatusOr<LearnedPrior> LearnGaussianPrior(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                                const Systems& systems, const LearnedStart& shared, base::Executor* executor,
                                                TrainingState* state, const OnTrainingStep& on_step) {
  return Learner(spec, model, mask, systems, shared, executor, state, on_step).Run();
}

int32_t PriorIterations(const GaussianPriorSpec& spec, size_t systems) {
  const int32_t starts = spec.meta_iterations > 0 ? 1 : spec.restarts;
  return spec.meta_iterations + starts + (spec.rounds + 1) * static_cast<int32_t>(systems);
}

}  // namespace metaekf::meta
