#include "core/experiments/filter_run.h"

#include <algorithm>
#include <memory>
#include <utility>

#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/jobs.h"
#include "core/filter/believed_errors.h"
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

absl::StatusOr<std::vector<double>> CoverageByChance(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                                                     const data::Trajectory& recording, int64_t from, double width, int draws, const base::Rng& rng) {
  const std::unique_ptr<filter::FilterModel::Scratch> scratch = functions->MakeScratch();
  METAEKF_ASSIGN_OR_RETURN(filter::Ekf ekf, FilterBefore(model, functions, recording, from, {}, scratch.get()));
  filter::Estimate estimate = ekf.MakeEstimate();
  filter::StepTrace trace;
  ekf.set_trace(&trace);
  filter::BelievedErrors believed(draws, rng);
  const bool case_one = model.model.spec().is_case_one();
  const Index n = estimate.mean.size(), all = ekf.joint().size();
  VectorXd h(n), held = VectorXd::Zero(draws);
  // What is estimated, in terms of what is followed: x, or the outputs.
  MatrixXd H = MatrixXd::Identity(n, all);
  for (Index t = from; t < recording.length(); ++t) {
    METAEKF_RETURN_IF_ERROR(ekf.Step(recording.inputs.col(t), recording.outputs.col(t), scratch.get(), &estimate));
    believed.Follow(ekf, trace);
    if (case_one) ekf.joint().Measurement(ekf.state().mean, ekf.state().last_input, &h, &H, scratch.get());
    const VectorXd bounds = width * (H * ekf.state().factor).rowwise().norm();
    for (int draw = 0; draw < draws; ++draw) {
      held[draw] += ((H * believed.errors().col(draw)).array().abs() <= bounds.array()).cast<double>().mean();
    }
  }
  held /= static_cast<double>(recording.length() - from);
  return std::vector<double>(held.begin(), held.end());
}

double Coverage(const FilterRun& run, const MatrixXd& errors, double width) {
  return (errors.array().abs() <= width * run.deviations.array()).cast<double>().mean();
}

}  // namespace metaekf::experiments
