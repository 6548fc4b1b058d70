#include "core/meta/empirical_bayes.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/base/status.h"
#include "core/data/split.h"
#include "core/meta/fit_plan.h"
#include "core/meta/linear_start.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::GaussianPrior;
using nssm::LossData;
using nssm::RolloutLeastSquares;

constexpr double kFirstPrecision = 1e-6;  // of the first fit, which knows nothing: residuals count as they are
constexpr double kTolerance = 1e-5;
constexpr double kStalled = 6;            // times the median mean square of the residuals
constexpr int32_t kEncoderRounds = 3;
constexpr double kEncoderStd = 0.3;       // of the first encoder round
constexpr size_t kBatch = 8;              // systems between two calls of on_step
constexpr int kHorizonGrowth = 4;         // of the first fit's rollouts, from one stage to the next

MatrixXd Inverse(const MatrixXd& positive_definite) {
  return positive_definite.llt().solve(MatrixXd::Identity(positive_definite.rows(), positive_definite.cols()));
}

double Median(std::vector<double> values) {
  std::nth_element(values.begin(), values.begin() + static_cast<Index>(values.size() / 2), values.end());
  return values[values.size() / 2];
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
  std::vector<VectorXd> fits;
  std::vector<bool> accepted;
};

class Learner {
 public:
  Learner(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, const Systems& systems,
          base::Executor* executor, TrainingState* state, const OnTrainingStep& on_step)
      : spec_(spec),
        options_(spec.gaussian_prior),
        model_(model),
        plan_(model, spec.loss, mask),
        systems_(systems),
        executor_(*executor),
        state_(*state),
        on_step_(on_step),
        workspaces_(executor->concurrency()) {}

  absl::StatusOr<LearnedPrior> Run() {
    METAEKF_ASSIGN_OR_RETURN(dynamics_data_, CutAll(plan_.dynamics));
    if (state_.values.empty()) {
      state_.iteration = 0;
      METAEKF_RETURN_IF_ERROR(FirstFit());
    } else {
      METAEKF_RETURN_IF_ERROR(Restore());
    }
    for (; round_ <= options_.rounds; ++round_) {
      const int32_t steps = round_ == 0 ? options_.first_steps : options_.round_steps;
      METAEKF_RETURN_IF_ERROR(Round(plan_.dynamics, dynamics_data_, steps, &dynamics_));
      METAEKF_RETURN_IF_ERROR(Validate());
      Save(round_ + 1);
    }
    if (plan_.encoder) METAEKF_RETURN_IF_ERROR(LearnEncoder());
    return std::move(best_);
  }

 private:
  int32_t Iterations() const {
    const int32_t rounds = options_.rounds + 1 + (plan_.encoder ? kEncoderRounds : 0);
    return options_.restarts + rounds * static_cast<int32_t>(systems_.training.size());
  }

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
    if (!on_step_ || on_step_({state_, Iterations(), validated})) return absl::OkStatus();
    return absl::CancelledError("the training was cancelled");
  }

  // ---- the first fit ----

  std::vector<double> StartOf(int32_t restart) const {
    const uint64_t seed = spec_.seed + static_cast<uint64_t>(restart);
    absl::StatusOr<std::vector<double>> linear = LinearStart(model_, systems_.training[0], seed);
    return linear.ok() ? *std::move(linear) : model_.InitialParameters(seed);
  }

  /// One system from one start. Rollouts from measured or encoded starts grow to their full length.
  MapFit FitFrom(const std::vector<double>& parameters) const {
    VectorXd unknowns = VectorXd::Zero(plan_.dynamics.unknowns());
    unknowns.head(plan_.dynamics.adapted_size()) = GatherAdapted(plan_.dynamics, parameters);
    const Index n = unknowns.size();
    const Belief belief{.mean = VectorXd::Zero(n),
                        .precision = kFirstPrecision * MatrixXd::Identity(n, n),
                        .noise_variance = ChannelWeights().cwiseInverse()};
    const auto fit = [&](const RolloutLeastSquares& problem, const LossData<double>& data) {
      RolloutLeastSquares::Workspace workspace(problem, data.shape);
      return FitMap(problem, data, parameters, belief, unknowns,
                    {.optimiser = {.max_iterations = options_.first_steps, .tolerance = kTolerance}}, &workspace);
    };
    if (!spec_.loss.free_start) {
      nssm::LossSpec loss = spec_.loss;
      const int32_t full = dynamics_data_[0].shape.horizon;
      for (loss.horizon = 1; loss.horizon < full; loss.horizon *= kHorizonGrowth) {
        const FitPlan shorter(model_, loss, MaskOfPlan());
        const absl::StatusOr<LossData<double>> data = shorter.dynamics.Cut(systems_.training[0]);
        if (data.ok()) unknowns = fit(shorter.dynamics, *data).unknowns;
      }
    }
    return fit(plan_.dynamics, dynamics_data_[0]);
  }

  nn::Mask MaskOfPlan() const {
    nn::Mask mask(model_.layout().tensors().size(), false);
    for (size_t i = 0; i < mask.size(); ++i) {
      for (const auto& [offset, size] : plan_.dynamics.adapted()) {
        if (model_.layout().tensors()[i].offset == offset) mask[i] = true;
      }
    }
    return mask;
  }

  /// The loss's weights of the channels.
  VectorXd ChannelWeights() const {
    VectorXd weights = VectorXd::Constant(plan_.dynamics.channels(), spec_.loss.output_weight);
    weights.head(plan_.dynamics.channels() - model_.spec().output_size).setConstant(spec_.loss.state_weight);
    return weights;
  }

  absl::Status FirstFit() {
    std::vector<MapFit> fits(static_cast<size_t>(options_.restarts));
    executor_.ParallelFor(fits.size(), [&](size_t i, size_t) { fits[i] = FitFrom(StartOf(static_cast<int32_t>(i))); });
    const auto best = std::min_element(fits.begin(), fits.end(), [](const MapFit& a, const MapFit& b) {
      return !(b.cost < a.cost) && std::isfinite(a.cost);
    });
    if (!std::isfinite(best->cost)) {
      return absl::OutOfRangeError("no start of the first fit simulates its system; shorter rollouts or another seed may help");
    }
    const Index p = plan_.dynamics.adapted_size(), n = best->unknowns.size() - p;
    dynamics_.belief.mean = best->unknowns;
    dynamics_.belief.mean.tail(n).setZero();
    VectorXd precision = VectorXd::Constant(p + n, 1 / (options_.initial_std * options_.initial_std));
    precision.tail(n).setOnes();  // latents are of the order of one
    dynamics_.belief.precision = precision.asDiagonal();
    dynamics_.belief.noise_variance = best->channel_squares / static_cast<double>(Samples(dynamics_data_[0]));
    for (Index c = 0; c < dynamics_.belief.noise_variance.size(); ++c) {
      if (ChannelWeights()[c] == 0) dynamics_.belief.noise_variance[c] = std::numeric_limits<double>::infinity();
    }
    dynamics_.fits.assign(systems_.training.size(), best->unknowns);
    dynamics_.accepted.assign(systems_.training.size(), true);
    state_.best_validation_loss = state_.validation_loss = std::numeric_limits<double>::infinity();
    METAEKF_RETURN_IF_ERROR(Tell(fits.size()));
    Save(0);
    return absl::OkStatus();
  }

  static int64_t Samples(const LossData<double>& data) { return int64_t{data.shape.rollouts} * data.shape.horizon; }

  // ---- expectation and maximisation ----

  absl::Status Round(const RolloutLeastSquares& problem, const std::vector<LossData<double>>& data, int32_t steps,
                     Population* population) {
    const size_t count = data.size();
    const Belief& belief = population->belief;
    std::vector<MatrixXd> covariances(count);
    std::vector<double> mean_squares(count);
    std::vector<VectorXd> variances(count);
    const GaussianPrior helped = PriorOf(*population);
    for (size_t first = 0; first < count; first += kBatch) {
      const size_t batch = std::min(kBatch, count - first);
      executor_.ParallelFor(batch, [&](size_t i, size_t slot) {
        const size_t s = first + i;
        MapFit fit = FitMap(problem, data[s], ParametersOf(s, problem), belief, population->fits[s],
                            {.optimiser = {.max_iterations = steps, .tolerance = kTolerance}},
                            workspaces_[slot].For(problem, data[s].shape));
        if (!population->accepted[s] && &problem == &plan_.dynamics) {
          std::vector<double> mean = model_.InitialParameters(spec_.seed);
          ScatterAdapted(problem, belief.mean, &mean);
          absl::StatusOr<SystemFit> other = FitSystem(plan_, helped, mean, systems_.training[s],
                                                      {.steps = steps, .tolerance = kTolerance}, nullptr);
          if (other.ok() && other->dynamics.cost < fit.cost) fit = std::move(other->dynamics);
        }
        population->fits[s] = fit.unknowns;
        covariances[s] = Inverse(fit.information);
        const double samples = static_cast<double>(Samples(data[s]));
        const double determined =
            static_cast<double>(fit.unknowns.size()) - (covariances[s] * belief.precision).trace();
        const double channels = static_cast<double>(fit.channel_squares.size());
        variances[s] = fit.channel_squares / std::max(1.0, samples - determined / channels);
        mean_squares[s] = belief.noise_variance.cwiseInverse().dot(fit.channel_squares) / (samples * channels);
      });
      METAEKF_RETURN_IF_ERROR(Tell(batch));
    }
    Maximise(mean_squares, variances, covariances, problem.adapted_size(), population);
    state_.training_loss = Median(mean_squares) * belief.noise_variance.minCoeff();
    return absl::OkStatus();
  }

  static void Maximise(const std::vector<double>& mean_squares, const std::vector<VectorXd>& variances,
                       const std::vector<MatrixXd>& covariances, Index adapted, Population* population) {
    std::vector<double> finite;
    for (const double value : mean_squares) finite.push_back(std::isfinite(value) ? value : std::numeric_limits<double>::max());
    const double limit = kStalled * Median(finite);
    const Index size = population->belief.mean.size(), starts = size - adapted;
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
    Belief& belief = population->belief;
    belief.mean = mean;
    belief.precision = Inverse(covariance);
    for (Index c = 0; c < belief.noise_variance.size(); ++c) {
      if (!std::isfinite(belief.noise_variance[c])) continue;
      std::vector<double> of_channel;
      for (size_t s = 0; s < finite.size(); ++s) {
        if (population->accepted[s]) of_channel.push_back(variances[s][c]);
      }
      belief.noise_variance[c] = Median(of_channel);
    }
  }

  /// ω of system s as far as `problem` does not fit it.
  std::vector<double> ParametersOf(size_t s, const RolloutLeastSquares& problem) const {
    std::vector<double> parameters = model_.InitialParameters(spec_.seed);
    if (&problem != &plan_.dynamics) ScatterAdapted(plan_.dynamics, dynamics_.fits[s], &parameters);
    return parameters;
  }

  /// The dynamics' part of a prior.
  GaussianPrior PriorOf(const Population& population) const {
    const Index p = plan_.dynamics.adapted_size(), n = population.belief.mean.size() - p;
    GaussianPrior prior;
    if (&population != &dynamics_) return prior;
    prior.dynamics = population.belief.precision.topLeftCorner(p, p);
    prior.start = population.belief.precision.bottomRightCorner(n, n);
    prior.noise_variance = population.belief.noise_variance;
    if (plan_.encoder) {
      const Index e = plan_.encoder->adapted_size();
      prior.encoder = MatrixXd::Identity(e, e) / (kEncoderStd * kEncoderStd);
    }
    std::vector<Index> accepted;
    for (size_t s = 0; s < population.fits.size(); ++s) {
      if (population.accepted[s]) accepted.push_back(static_cast<Index>(s));
    }
    prior.examples.resize(p, static_cast<Index>(accepted.size()));
    for (Index i = 0; i < prior.examples.cols(); ++i) {
      prior.examples.col(i) = population.fits[static_cast<size_t>(accepted[static_cast<size_t>(i)])].head(p);
    }
    return prior;
  }

  // ---- validation ----

  /// Free-run error on what follows a context, geometric mean over the held-out systems; keeps the best prior.
  absl::Status Validate() {
    LearnedPrior current{.parameters = model_.InitialParameters(spec_.seed), .prior = PriorOf(dynamics_)};
    ScatterAdapted(plan_.dynamics, dynamics_.belief.mean, &current.parameters);
    if (systems_.validation.empty()) {
      best_ = std::move(current);
      return absl::OkStatus();
    }
    std::vector<double> losses(systems_.validation.size());
    const FitPlan dynamics_only(model_, spec_.loss, MaskOfPlan());
    GaussianPrior prior = current.prior;
    prior.encoder.resize(0, 0);
    executor_.ParallelFor(losses.size(), [&](size_t i, size_t) {
      losses[i] = std::log(TargetLoss(dynamics_only, prior, current.parameters, systems_.validation[i]));
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
  double TargetLoss(const FitPlan& plan, const GaussianPrior& prior, const std::vector<double>& mean,
                    const Trajectory& system) const {
    constexpr double kHopeless = 1;  // the variance of the normalised outputs
    const Index context = std::min<Index>(spec_.context_samples, system.length() / 2);
    const Index end = std::min<Index>(context + spec_.target_samples, system.length());
    const auto head = data::FirstSamples(system, context), both = data::FirstSamples(system, end);
    if (!head.ok() || !both.ok()) return kHopeless;
    const auto fit = FitSystem(plan, prior, mean, *head, {.steps = spec_.adaptation.steps}, nullptr);
    const auto data = plan.dynamics.Cut(spec_.loss.free_start ? *both : *data::SamplesFrom(*both, context));
    if (!fit.ok() || !data.ok()) return kHopeless;
    RolloutLeastSquares::Workspace workspace(plan.dynamics, data->shape);
    const VectorXd start = fit->dynamics.unknowns.tail(prior.start.rows());
    const MatrixXd predictions = plan.dynamics.Predictions(fit->parameters.data(), start, *data, &workspace);
    const Index n_y = model_.spec().output_size;
    const Eigen::Map<const MatrixXd> measured(data->outputs.data(), n_y, predictions.cols());
    const Index from = spec_.loss.free_start ? context - 1 : 0;
    const Index count = predictions.cols() - from;
    const double loss = (predictions.bottomRows(n_y) - measured).rightCols(count).squaredNorm() / static_cast<double>(count * n_y);
    return std::isfinite(loss) ? std::min(loss, kHopeless) : kHopeless;
  }

  // ---- the encoder ----

  absl::Status LearnEncoder() {
    const RolloutLeastSquares& problem = *plan_.encoder;
    METAEKF_ASSIGN_OR_RETURN(const std::vector<LossData<double>> data, CutAll(problem));
    const Index size = problem.unknowns();
    Population encoder;
    encoder.belief = {.mean = GatherAdapted(problem, model_.InitialParameters(spec_.seed)),
                      .precision = MatrixXd::Identity(size, size) / (kEncoderStd * kEncoderStd),
                      .noise_variance = dynamics_.belief.noise_variance};
    encoder.fits.assign(data.size(), encoder.belief.mean);
    encoder.accepted.assign(data.size(), true);
    for (int32_t round = 0; round < kEncoderRounds; ++round) {
      METAEKF_RETURN_IF_ERROR(Round(problem, data, round == 0 ? options_.first_steps : options_.round_steps, &encoder));
    }
    ScatterAdapted(problem, encoder.belief.mean, &best_.parameters);
    best_.prior.encoder = encoder.belief.precision;
    return absl::OkStatus();
  }

  // ---- checkpoints ----

  static std::vector<double> Flat(const MatrixXd& matrix) { return {matrix.data(), matrix.data() + matrix.size()}; }

  /// Checkpoints hold what a round begins with; one that was interrupted is begun again.
  void Save(int32_t next_round) {
    std::vector<double> fits, accepted;
    for (const VectorXd& fit : dynamics_.fits) fits.insert(fits.end(), fit.begin(), fit.end());
    for (const bool flag : dynamics_.accepted) accepted.push_back(flag ? 1 : 0);
    state_.values = {{"round", {static_cast<double>(next_round), static_cast<double>(state_.iteration)}},
                     {"mean", Flat(dynamics_.belief.mean)},
                     {"precision", Flat(dynamics_.belief.precision)},
                     {"noise_precision", Flat(dynamics_.belief.noise_variance.cwiseInverse())},
                     {"fits", fits},
                     {"accepted", accepted}};
    if (best_.parameters.empty()) return;
    state_.values["best_parameters"] = best_.parameters;
    state_.values["best_dynamics"] = Flat(best_.prior.dynamics);
    state_.values["best_start"] = Flat(best_.prior.start);
    state_.values["best_noise_variance"] = Flat(best_.prior.noise_variance);
    state_.values["best_examples"] = Flat(best_.prior.examples);
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
    const MatrixXd round = matrix("round", 2, 1);
    dynamics_.belief = {.mean = matrix("mean", size, 1),
                        .precision = matrix("precision", size, size),
                        .noise_variance = matrix("noise_precision", channels, 1).cwiseInverse()};
    const MatrixXd fits = matrix("fits", size, systems), accepted = matrix("accepted", systems, 1);
    for (Index s = 0; s < systems; ++s) {
      dynamics_.fits.push_back(fits.col(s));
      dynamics_.accepted.push_back(accepted(s, 0) != 0);
    }
    round_ = static_cast<int32_t>(round(0, 0));
    state_.iteration = static_cast<int32_t>(round(1, 0));
    if (round_ > 0) {
      best_.parameters = state_.values["best_parameters"];
      best_.prior.dynamics = matrix("best_dynamics", p, p);
      best_.prior.start = matrix("best_start", n, n);
      best_.prior.noise_variance = matrix("best_noise_variance", channels, 1);
      best_.prior.examples = matrix("best_examples", p, -1);
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
  base::Executor& executor_;
  TrainingState& state_;
  const OnTrainingStep& on_step_;
  std::vector<SlotWorkspace> workspaces_;
  std::vector<LossData<double>> dynamics_data_;
  Population dynamics_;
  int32_t round_ = 0;
  LearnedPrior best_;
};

}  // namespace

absl::StatusOr<LearnedPrior> LearnGaussianPrior(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                                const Systems& systems, base::Executor* executor, TrainingState* state,
                                                const OnTrainingStep& on_step) {
  return Learner(spec, model, mask, systems, executor, state, on_step).Run();
}

}  // namespace metaekf::meta
