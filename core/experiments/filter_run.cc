#include "core/experiments/filter_run.h"

#include <algorithm>
#include <memory>
#include <utility>

#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/jobs.h"
#include "core/filter/draw.h"
#include "core/meta/adapt.h"

namespace metaekf::experiments {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

absl::StatusOr<nssm::Bundle> AdaptForFilter(const nssm::Bundle& model, const data::Trajectory& recording, int64_t context_samples) {
  METAEKF_ASSIGN_OR_RETURN(const data::Trajectory context, data::FirstSamples(recording, context_samples));
  METAEKF_ASSIGN_OR_RETURN(const meta::AdaptationOptions options, meta::DefaultAdaptation(model));
  METAEKF_ASSIGN_OR_RETURN(meta::AdaptationResult result, meta::Adapt(model, context, options, nullptr));
  nssm::Bundle adapted = model;
  adapted.parameters = std::move(result.parameters);
  adapted.noise = std::move(result.noise);
  adapted.posterior = std::move(result.posterior);
  return adapted;
}

namespace {

/// A filter that the samples before `from` have brought to where FilterAfterContext begins.
absl::StatusOr<filter::Ekf> FilterBefore(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                                         const data::Trajectory& recording, int64_t from, filter::FilterOptions options, filter::FilterModel::Scratch* scratch) {
  const std::shared_ptr<const filter::FilterModel::Parameters> parameters = functions->Prepare(model);
  const data::Normaliser& units = model.normaliser;
  const bool case_one = model.model.spec().is_case_one();
  if (!case_one) {
    const Index states = units.states.scale.size();
    VectorXd first(states);
    MatrixXd F(states, states);
    functions->Transition(*parameters, units.states.Normalise(recording.states.col(from - 1)),
                          units.inputs.Normalise(recording.inputs.col(from - 1)), &first, &F, scratch);
    options.initial_mean = first.cwiseProduct(units.states.scale) + units.states.mean;
    const MatrixXd& W = model.noise.process_bias.loadings;
    options.initial_cov = options.process_cov ? *options.process_cov : MatrixXd(model.noise.process);
    if (!options.process_cov && W.cols() > 0) *options.initial_cov += W * W.transpose();
  }
  METAEKF_ASSIGN_OR_RETURN(filter::Ekf ekf, filter::Ekf::Create(model, functions, parameters, options));
  filter::Estimate estimate = ekf.MakeEstimate();
  for (Index t = case_one ? std::max<Index>(0, from - model.model.spec().warmup()) : from; t < from; ++t) {
    METAEKF_RETURN_IF_ERROR(ekf.Step(recording.inputs.col(t), recording.outputs.col(t), scratch, &estimate));
  }
  return ekf;
}

}  // namespace

absl::StatusOr<FilterRun> FilterAfterContext(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                                             const data::Trajectory& recording, int64_t from, filter::FilterOptions options) {
  const std::unique_ptr<filter::FilterModel::Scratch> scratch = functions->MakeScratch();
  METAEKF_ASSIGN_OR_RETURN(filter::Ekf ekf, FilterBefore(model, functions, recording, from, std::move(options), scratch.get()));
  filter::Estimate estimate = ekf.MakeEstimate();
  const Index n = estimate.mean.size(), count = recording.length() - from;
  FilterRun run{.means = MatrixXd(n, count), .deviations = MatrixXd(n, count), .nis = VectorXd(count), .projection = VectorXd(count)};
  const double begin = ThreadSeconds();
  for (Index t = 0; t < count; ++t) {
    METAEKF_RETURN_IF_ERROR(ekf.Step(recording.inputs.col(from + t), recording.outputs.col(from + t), scratch.get(), &estimate));
    run.means.col(t) = estimate.mean;
    run.deviations.col(t) = estimate.cov.diagonal().cwiseSqrt();
    run.nis[t] = estimate.nis;
    run.projection[t] = estimate.projection;
    run.health.push_back(estimate.health);
  }
  run.seconds_per_step = (ThreadSeconds() - begin) / static_cast<double>(count);
  return run;
}

absl::StatusOr<data::Trajectory> AsFilterBelieves(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                                                  data::Trajectory recording, int64_t from, base::Rng* rng) {
  const std::unique_ptr<filter::FilterModel::Scratch> scratch = functions->MakeScratch();
  METAEKF_ASSIGN_OR_RETURN(filter::Ekf ekf, FilterBefore(model, functions, recording, from, {}, scratch.get()));
  filter::Estimate estimate = ekf.MakeEstimate();
  METAEKF_RETURN_IF_ERROR(ekf.Step(recording.inputs.col(from), recording.outputs.col(from), scratch.get(), &estimate));
  const Index rest = recording.length() - from - 1;
  METAEKF_ASSIGN_OR_RETURN(const filter::Future future, filter::Draw(ekf, recording.inputs.rightCols(rest), rng, scratch.get()));
  if (model.model.spec().is_case_one()) recording.states = recording.outputs;
  recording.states.col(from) = future.now;
  recording.states.rightCols(rest) = future.truth;
  recording.outputs.rightCols(rest) = future.outputs;
  return recording;
}

double Coverage(const FilterRun& run, const MatrixXd& errors, double width) {
  return (errors.array().abs() <= width * run.deviations.array()).cast<double>().mean();
}

}  // namespace metaekf::experiments
