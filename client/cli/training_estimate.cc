#include "client/cli/training_estimate.h"

#include <nlohmann/json.hpp>
#include <sys/resource.h>

#include <algorithm>
#include <thread>
#include <vector>

#include "absl/time/clock.h"
#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/meta/train.h"
#include "core/nssm/model.h"

namespace metaekf::cli {
namespace {

constexpr int32_t kProbeSteps = 3;  // of each phase; the first warms up
constexpr double kMib = 1 << 20;

/// Calls of on_step until `steps` were done, as times since the start.
absl::StatusOr<std::vector<double>> Probe(const meta::TrainingSpec& spec, const data::Dataset& fleet, int32_t steps) {
  const auto executor = base::MakeThreadExecutor(std::max(1U, std::thread::hardware_concurrency()));
  const absl::Time start = absl::Now();
  std::vector<double> times;
  const absl::Status status =
      meta::Train(spec, fleet, nullptr, executor.get(), [&](const meta::TrainingProgress&) {
        times.push_back(absl::ToDoubleSeconds(absl::Now() - start));
        return static_cast<int32_t>(times.size()) < steps;
      }).status();
  if (!status.ok() && !absl::IsCancelled(status)) return status;
  return times;
}

/// MiB of the covariances that a round keeps, one of every system.
absl::StatusOr<double> CovariancesMib(nssm::ModelSpec model, const data::Dataset& fleet) {
  model.input_size = static_cast<int32_t>(fleet.input_names.size());
  model.output_size = static_cast<int32_t>(fleet.output_names.size());
  if (!model.is_case_one()) model.state_size = static_cast<int32_t>(fleet.state_names.size());
  METAEKF_ASSIGN_OR_RETURN(const nssm::Model made, nssm::Model::Create(model));
  const double unknowns = static_cast<double>(made.layout().size() + model.latent_size);
  return static_cast<double>(fleet.trajectories.size()) * unknowns * unknowns * sizeof(double) / kMib;
}

/// Outer steps of each phase, timed.
absl::StatusOr<double> GradientSeconds(meta::TrainingSpec spec, const data::Dataset& fleet) {
  const int32_t warmup = std::min(spec.warmup_iterations, kProbeSteps), others = spec.restarts - 1;
  const int32_t all = spec.iterations, screening = spec.screening_iterations;
  const int32_t warmups_each = std::min(spec.warmup_iterations, all), warmups_screening = std::min(spec.warmup_iterations, screening);
  const int32_t warmups = warmups_each + others * warmups_screening;
  const int32_t mains = all - warmups_each + others * (screening - warmups_screening);
  spec.warmup_iterations = warmup;
  spec.horizon_growth_iterations = 0;  // counted as long as at the end
  spec.restarts = 1;
  const int32_t probes = warmup + std::min(mains, kProbeSteps);
  spec.iterations = probes + 1;
  spec.validation_period = probes + 1;
  METAEKF_ASSIGN_OR_RETURN(const std::vector<double> times, Probe(spec, fleet, probes));
  const auto last = [&times](int32_t step) {
    const size_t i = static_cast<size_t>(step - 1);
    return i == 0 ? times[0] : times[i] - times[i - 1];
  };
  return times[0] + (warmup > 0 ? warmups * last(warmup) : 0) + (mains > 0 ? mains * last(probes) : 0);
}

/// One start of the first fit, a few steps long, timed; every other fit is counted in such steps.
absl::StatusOr<double> GaussianPriorSeconds(meta::TrainingSpec spec, data::Dataset fleet) {
  constexpr double kContenders = 30;  // steps of the starts that a fit chooses from
  const meta::GaussianPriorSpec prior = spec.gaussian_prior;
  const double systems = static_cast<double>(fleet.trajectories.size());
  const double steps = prior.restarts * prior.first_steps + systems * (kContenders + prior.first_steps) +
                       prior.rounds * systems * (kContenders + 2 * prior.round_steps);
  fleet.trajectories.resize(std::min<size_t>(fleet.trajectories.size(), 2));
  spec.gaussian_prior.restarts = 1;
  spec.gaussian_prior.first_steps = kProbeSteps;
  spec.gaussian_prior.meta_iterations = 0;  // timed by itself
  spec.inner_loop.learned_rates = spec.inner_loop.curvature_rates = false;
  spec.validation_share = 0;
  METAEKF_ASSIGN_OR_RETURN(const std::vector<double> times, Probe(spec, fleet, 1));
  return times[0] / (kProbeSteps + 1) * steps / std::max(1U, std::thread::hardware_concurrency());
}

}  // namespace

absl::StatusOr<TrainingEstimate> EstimateTraining(const nlohmann::json& specification, const data::Dataset& fleet) {
  METAEKF_ASSIGN_OR_RETURN(const meta::TrainingSpec spec, meta::ReadTrainingSpec(specification));
  const bool by_fits = spec.algorithm == meta::Algorithm::kGaussianPrior;
  TrainingEstimate estimate;
  METAEKF_ASSIGN_OR_RETURN(estimate.duration_s, by_fits ? GaussianPriorSeconds(spec, fleet) : GradientSeconds(spec, fleet));
  if (by_fits && spec.gaussian_prior.meta_iterations > 0) {
    meta::TrainingSpec meta = spec;
    meta.algorithm = spec.gaussian_prior.meta_algorithm;
    meta.iterations = spec.gaussian_prior.meta_iterations;
    METAEKF_ASSIGN_OR_RETURN(const double seconds, GradientSeconds(meta, fleet));
    estimate.duration_s += seconds;
  }
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  estimate.memory_mib = static_cast<double>(usage.ru_maxrss) * 1024 / kMib;
  if (by_fits) {
    METAEKF_ASSIGN_OR_RETURN(const double covariances, CovariancesMib(spec.model, fleet));
    estimate.memory_mib += covariances;
  }
  return estimate;
}

}  // namespace metaekf::cli
