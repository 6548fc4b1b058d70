#include "core/filter/calibrate.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <numbers>
#include <utility>

#include "core/base/status.h"
#include "core/filter/ekf.h"
#include "core/filter/unknown_directions.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kFar = 3;               // standard deviations
constexpr double kProbe = 0.4;           // of ln d², to see a slope and a curvature
constexpr double kWorthwhile = 1e-3;     // of the likelihood, per sample and entry
constexpr int kRounds = 6;               // of a fleet; of a model that follows its system two or three do
constexpr int kOwnRounds = 2;            // of a system's own noise, which does not go far from the fleet's
constexpr double kLargestMove = 2;       // of ln d²
constexpr double kLeastShare = 0.2;      // of a move
constexpr double kLargest = 30;          // |ln d²|: 10¹³
constexpr double kLargestCorrelation = 1 - 1e-9;
constexpr double kSearchWork = 16000;    // samples of a run and one entry; a search over n entries takes some n^1.5 times as long
constexpr Index kFewestSamples = 50;
constexpr size_t kFewestRuns = 4;        // of a fleet: with fewer, halves say nothing
constexpr double kHeld = 0.95, kWidth = 1.959964;  // of bounds, and how many deviations wide they are
constexpr double kFailed = -std::numeric_limits<double>::infinity();
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// Where a scale acts: D_q, D_r, then of each bias its size and its time constant, then the deviation of the parameters.
struct Layout {
  Index process = 0;      ///< entries of D_q: n, or 1 for all
  Index measurement = 0;  ///< entries of D_r
  bool process_bias = false, measurement_bias = false, parameters = false;
  Index biases() const { return process + measurement; }  ///< where theirs begin
  Index size() const { return biases() + 2 * (process_bias + measurement_bias) + parameters; }
};

/// All of Q, and all of R.
std::array<VectorXd, 2> Together(const Layout& layout) {
  std::array<VectorXd, 2> together = {VectorXd::Zero(layout.size()), VectorXd::Zero(layout.size())};
  together[0].head(layout.process).setOnes();
  together[1].segment(layout.process, layout.measurement).setOnes();
  return together;
}

nssm::GaussMarkov Scaled(nssm::GaussMarkov bias, double log_variance, double log_time) {
  bias.loadings *= std::exp(0.5 * log_variance);
  bias.correlation = std::min(kLargestCorrelation, std::pow(bias.correlation, std::exp(-log_time)));
  return bias;
}

nssm::FilterNoise Scaled(const nssm::FilterNoise& noise, const VectorXd& log_scales, const Layout& layout) {
  const Index n = noise.process.rows();
  const VectorXd d = (0.5 * log_scales).array().exp();
  const VectorXd d_q = layout.process == n ? VectorXd(d.head(n)) : VectorXd::Constant(n, d[0]);
  const VectorXd d_r = d.segment(layout.process, layout.measurement);
  nssm::FilterNoise scaled = noise;
  scaled.process = d_q.asDiagonal() * noise.process * d_q.asDiagonal();
  scaled.measurement = d_r.asDiagonal() * noise.measurement * d_r.asDiagonal();
  Index at = layout.biases();
  for (const auto& [there, bias] : {std::pair{layout.process_bias, &scaled.process_bias}, {layout.measurement_bias, &scaled.measurement_bias}}) {
    if (!there) continue;
    *bias = Scaled(*bias, log_scales[at], log_scales[at + 1]);
    at += 2;
  }
  if (layout.parameters) scaled.parameter_std *= d[at];
  return scaled;
}

/// Huber's ρ of a square of unit mean: what lies far outside counts in proportion to its distance, not to the square.
double Tempered(double square) {
  const double size = std::sqrt(square);
  return size <= kFar ? square : kFar * (2 * size - kFar);
}

double LogDensity(double error, double variance) {
  return -0.5 * (Tempered(error * error / variance) + std::log(2 * std::numbers::pi * variance));
}

/// ln N(ỹ; 0, S) of what was measured, in units of the outputs' scales.
double LogLikelihood(const Estimate& estimate, const VectorXd& scale) {
  std::vector<Index> rows;
  for (Index i = 0; i < scale.size(); ++i) {
    if (!std::isnan(estimate.innovation[i])) rows.push_back(i);
  }
  const MatrixXd S = scale.cwiseInverse().asDiagonal() * estimate.innovation_cov * scale.cwiseInverse().asDiagonal();
  const Eigen::LLT<MatrixXd> cholesky(MatrixXd(S(rows, rows)));
  const double log_determinant = 2 * MatrixXd(cholesky.matrixL()).diagonal().array().log().sum();
  const double m = static_cast<double>(rows.size());
  return -0.5 * (m * Tempered(estimate.nis / m) + log_determinant + m * std::log(2 * std::numbers::pi));
}

/// A recording, the filter's parameters for it, and where it stands before the first sample that counts, whatever Q and R.
struct Prepared {
  const data::Trajectory* trajectory = nullptr;
  std::shared_ptr<const FilterModel::Parameters> parameters;
  FilterState start;
  Index begin = 0, end = 0;  ///< of the samples that count
};

absl::StatusOr<Ekf> MakeFilter(const nssm::Bundle& bundle, const nssm::FilterNoise& noise,
                               const std::shared_ptr<const FilterModel>& model, const Prepared& run) {
  return Ekf::Create(bundle, model, run.parameters,
                     {.noise = noise, .gate = {.probability = 0}, .restart_after_divergence = false});
}

/// Case I: when the first window is full. Case II: at the first state, which was recorded; where a filter that had to guess would
/// begin, and how long it would take to find the state, is not Q's business.
/// Errors: those of Ekf; a recording in which no window is full begins at its end.
absl::Status Begin(const nssm::Bundle& bundle, const std::shared_ptr<const FilterModel>& model, Prepared* run) {
  METAEKF_ASSIGN_OR_RETURN(Ekf ekf, MakeFilter(bundle, bundle.noise, model, *run));
  if (!bundle.model.spec().is_case_one()) {
    run->start = ekf.state();
    const Index n = model->state_size();
    run->start.mean.head(n) = bundle.normaliser.states.Normalise(run->trajectory->states.col(0));
    run->start.factor.topLeftCorner(n, n).setZero();
    run->start.last_input = bundle.normaliser.inputs.Normalise(run->trajectory->inputs.col(0));
    run->start.started = true;
    run->begin = 1;
    return absl::OkStatus();
  }
  const auto scratch = model->MakeScratch();
  Estimate estimate = ekf.MakeEstimate();
  estimate.health = Health::kWarmingUp;
  for (; estimate.health == Health::kWarmingUp && run->begin < run->trajectory->length(); ++run->begin) {
    METAEKF_RETURN_IF_ERROR(ekf.Step(run->trajectory->inputs.col(run->begin), run->trajectory->outputs.col(run->begin),
                                     scratch.get(), &estimate));
  }
  run->start = ekf.state();
  return absl::OkStatus();
}

/// How well a filter explains a recording.
struct Score {
  double likelihood = kFailed;  ///< per sample; kFailed where the filter does not stay finite
  VectorXd squares;             ///< mean of errors squared in their ratio to their variances: of states in Case II, then of innovations
};

/// @param ratios  or null: receives errors in their ratio to their deviations, of states in Case II, else of innovations.
Score ScoreOf(const nssm::Bundle& bundle, const nssm::FilterNoise& noise, const std::shared_ptr<const FilterModel>& model,
              const Prepared& run, std::vector<double>* ratios = nullptr) {
  absl::StatusOr<Ekf> ekf = MakeFilter(bundle, noise, model, run);
  if (!ekf.ok()) return {};
  ekf->Restore(run.start);
  const auto scratch = model->MakeScratch();
  Estimate estimate = ekf->MakeEstimate();
  const Index states = bundle.model.spec().is_case_one() ? 0 : estimate.mean.size(), outputs = estimate.innovation.size();
  double sum = 0;
  int64_t samples = 0;
  VectorXd squares = VectorXd::Zero(states + outputs), counts = squares;
  for (Index t = run.begin; t < run.end; ++t) {
    if (!ekf->Step(run.trajectory->inputs.col(t), run.trajectory->outputs.col(t), scratch.get(), &estimate).ok()) return {};
    if (estimate.measured == 0) continue;
    sum += LogLikelihood(estimate, bundle.normaliser.outputs.scale);
    for (Index i = 0; i < states; ++i) {
      const double scale = bundle.normaliser.states.scale[i], error = run.trajectory->states(i, t) - estimate.mean[i];
      sum += LogDensity(error / scale, estimate.cov(i, i) / (scale * scale));
      squares[i] += Tempered(error * error / estimate.cov(i, i));
      counts[i] += 1;
      if (ratios != nullptr) ratios->push_back(std::fabs(error) / std::sqrt(estimate.cov(i, i)));
    }
    for (Index i = 0; i < outputs; ++i) {
      if (std::isnan(estimate.innovation[i])) continue;
      squares[states + i] += Tempered(estimate.innovation[i] * estimate.innovation[i] / estimate.innovation_cov(i, i));
      counts[states + i] += 1;
      if (ratios != nullptr && states == 0) ratios->push_back(std::fabs(estimate.innovation[i]) / std::sqrt(estimate.innovation_cov(i, i)));
    }
    ++samples;
  }
  const double mean = sum / static_cast<double>(samples);
  if (!std::isfinite(mean)) return {};
  return {mean, (counts.array() > 0).select(squares.cwiseQuotient(counts), 1)};
}

/// Where along a direction the parabola through three values has its top, or how far towards the greater one is dared.
double TopOfParabola(const std::function<double(const VectorXd&)>& objective, const VectorXd& at, double value, const VectorXd& direction) {
  const double up = objective(at + kProbe * direction), down = objective(at - kProbe * direction);
  if (!(std::max(up, down) > kFailed)) return 0;
  const double slope = (up - down) / (2 * kProbe), curvature = (up - 2 * value + down) / (kProbe * kProbe);
  if (std::isfinite(slope) && curvature < 0) return std::clamp(-slope / curvature, -kLargestMove, kLargestMove);
  const double better = std::max(up, down);
  return better > value ? (up > down ? kLargestMove : -kLargestMove) : 0;
}

/// Where every run's filter begins. Errors: those of Begin.
absl::StatusOr<std::vector<Prepared>> PrepareAll(const nssm::Bundle& bundle, const std::shared_ptr<const FilterModel>& model,
                                                 const std::vector<CalibrationRun>& runs) {
  std::vector<Prepared> prepared;
  for (const CalibrationRun& run : runs) {
    prepared.push_back({&run.trajectory, model->Prepare(run.parameters, run.directions), {}});
    METAEKF_RETURN_IF_ERROR(Begin(bundle, model, &prepared.back()));
    prepared.back().end = run.trajectory.length();
  }
  return prepared;
}

/// The samples of each run that a search over every entry looks at.
Index SearchSamples(const Layout& layout) {
  return std::max(kFewestSamples, static_cast<Index>(kSearchWork / std::pow(static_cast<double>(layout.size()), 1.5)));
}

std::vector<Prepared> FirstOf(std::vector<Prepared> runs, Index samples) {
  for (Prepared& run : runs) run.end = std::min(run.end, run.begin + samples);
  return runs;
}

/// Mean over runs.
Score ScoreOfAll(const nssm::Bundle& bundle, const nssm::FilterNoise& noise, const std::shared_ptr<const FilterModel>& model,
                 const std::vector<Prepared>& runs, base::Executor* executor) {
  std::vector<Score> scores(runs.size());
  executor->ParallelFor(runs.size(), [&](size_t i, size_t) { scores[i] = ScoreOf(bundle, noise, model, runs[i]); });
  Score total = scores[0];
  for (size_t i = 1; i < scores.size(); ++i) {
    total.likelihood += scores[i].likelihood;
    if (total.likelihood > kFailed) total.squares += scores[i].squares;
  }
  const double count = static_cast<double>(scores.size());
  total.squares /= count;
  total.likelihood /= count;
  return total;
}

/// δ̂ of Calibrate, from every system's v.
double ExcessOfNewSystems(const std::vector<double>& known, const std::vector<double>& fresh) {
  if (known.empty() || fresh.size() < 2) return 0;
  std::vector<double> all = known;
  all.insert(all.end(), fresh.begin(), fresh.end());
  const auto mean = [](const std::vector<double>& v) { return Eigen::Map<const VectorXd>(v.data(), static_cast<Index>(v.size())).mean(); };
  const auto squares = [&](const std::vector<double>& v) {
    return (Eigen::Map<const VectorXd>(v.data(), static_cast<Index>(v.size())).array() - mean(v)).square().sum();
  };
  const double difference = mean(fresh) - mean(all);
  const double n = static_cast<double>(all.size()), n_fresh = static_cast<double>(fresh.size());
  // Within each kind; the difference of a part's mean from that of the whole.
  const double variance = (squares(known) + squares(fresh)) / std::max(1.0, n - 2) * (1 / n_fresh - 1 / n);
  if (difference <= 0 || variance >= difference * difference) return 0;  // a model follows no new system better than those that it knows
  return (1 - variance / (difference * difference)) * difference;
}

/// ln d², with which filters explain the runs best: steps 1 to 4 of Calibrate.
VectorXd MostLikelyScales(const nssm::Bundle& bundle, const std::shared_ptr<const FilterModel>& model, const Layout& layout,
                          const std::vector<Prepared>& runs, double log_std, base::Executor* executor) {
  const bool fleet = std::isinf(log_std);
  const auto score = [&](const std::vector<Prepared>& of, const VectorXd& log_scales) {
    if (log_scales.lpNorm<Eigen::Infinity>() > kLargest) return Score();
    Score found = ScoreOfAll(bundle, Scaled(bundle.noise, log_scales, layout), model, of, executor);
    found.likelihood -= 0.5 * (log_scales / log_std).squaredNorm();
    return found;
  };
  VectorXd best = VectorXd::Zero(layout.size());
  // Where every entry has an error of its own, all of them at once towards what makes that as large as expected: not the
  // most likely yet, but near it, in few evaluations whatever their number.
  const auto match_errors = [&](const std::vector<Prepared>& of) {
    Score found = score(of, best);
    const bool moves = found.squares.size() == layout.biases();
    for (double share = 1; moves && found.likelihood > kFailed && share >= kLeastShare;) {
      VectorXd move = VectorXd::Zero(layout.size());
      move.head(layout.biases()) = found.squares.array().log().max(-kLargestMove).min(kLargestMove);
      const Score trial = score(of, best + share * move);
      if (trial.likelihood > found.likelihood + kWorthwhile * static_cast<double>(layout.size())) {
        best += share * move;
        found = trial;
      } else {
        share /= 2;
      }
    }
  };
  // A filter that has lost track tells nothing of where it would keep it: first in great steps to where all do.
  for (double at = score(runs, best).likelihood, before = kFailed; fleet && at > before + kWorthwhile;) {
    before = at;
    for (const VectorXd& together : Together(layout)) {
      for (const double step : {kLargestMove, -kLargestMove}) {
        const double trial = score(runs, best + step * together).likelihood;
        if (!(trial > at + kWorthwhile)) continue;
        best += step * together;
        at = trial;
        break;
      }
    }
  }
  match_errors(runs);
  const std::vector<Prepared> beginnings = FirstOf(runs, SearchSamples(layout));
  const auto objective = [&](const VectorXd& log_scales) { return score(beginnings, log_scales).likelihood; };
  double value = objective(best);
  const auto improve = [&](const VectorXd& move) {
    for (double share = 1; share >= kLeastShare; share /= 2) {
      const double trial = objective(best + share * move);
      if (!(trial > value + kWorthwhile)) continue;
      best += share * move;
      value = trial;
      return;
    }
  };
  double before = kFailed;
  for (int round = 0; round < (fleet ? kRounds : kOwnRounds) && value > before + kWorthwhile * static_cast<double>(layout.size()); ++round) {
    before = value;
    // What Q and R can trade with each other is seen along these two; then every entry goes where its own parabola has its top.
    for (const VectorXd& together : Together(layout)) improve(TopOfParabola(objective, best, value, together) * together);
    if (layout.process == 1 && layout.measurement == 1) continue;
    VectorXd move(layout.size());
    for (Index i = 0; i < move.size(); ++i) move[i] = TopOfParabola(objective, best, value, VectorXd::Unit(move.size(), i));
    improve(move);
  }
  // Beginnings do not know of errors that take long to grow.
  if (beginnings.front().end < runs.front().end) match_errors(runs);
  return best;
}

/// Runs, by their indices, and noise that does not come from them.
struct Judged {
  std::vector<size_t> runs;
  nssm::FilterNoise noise;
};

/// w of Calibrate, its steps 5 and 6.
double Widening(const nssm::Bundle& bundle, const std::vector<Judged>& parts, const std::shared_ptr<const FilterModel>& model,
                const std::vector<CalibrationRun>& runs, const std::vector<Prepared>& prepared, base::Executor* executor) {
  double widening = 0, systems = 0;
  std::vector<double> known, fresh;
  for (const Judged& part : parts) {
    std::vector<Score> scores(part.runs.size());
    std::vector<std::vector<double>> ratios(part.runs.size());
    executor->ParallelFor(part.runs.size(), [&](size_t i, size_t) { scores[i] = ScoreOf(bundle, part.noise, model, prepared[part.runs[i]], &ratios[i]); });
    std::vector<double> all, sizes;
    std::vector<bool> trained_on;
    for (size_t i = 0; i < part.runs.size(); ++i) {
      const double size = scores[i].likelihood > kFailed ? std::log(scores[i].squares.mean()) : kNaN;
      if (!std::isfinite(size)) continue;  // where a filter would have to be begun anew no width helps
      sizes.push_back(size);
      trained_on.push_back(runs[part.runs[i]].trained_on);
      all.insert(all.end(), ratios[i].begin(), ratios[i].end());
    }
    const double of_part = LogWidening(std::move(all));
    widening += static_cast<double>(sizes.size()) * of_part;
    systems += static_cast<double>(sizes.size());
    for (size_t i = 0; i < sizes.size(); ++i) (trained_on[i] ? known : fresh).push_back(sizes[i] - of_part);
  }
  if (systems == 0) return 0;
  widening /= systems;
  // Innovations are as large as likelihood has made their covariance: that more of them are small is no reason to take it back.
  if (bundle.model.spec().is_case_one()) widening = std::max(widening, 0.0);
  return widening + ExcessOfNewSystems(known, fresh);
}

}  // namespace

CalibrationRun RunOf(const nssm::Bundle& adapted, data::Trajectory trajectory) {
  return {adapted.parameters, UnknownDirections(adapted), std::move(trajectory)};
}

double LogWidening(std::vector<double> ratios) {
  if (ratios.empty()) return 0;
  const auto within = ratios.begin() + static_cast<ptrdiff_t>(kHeld * static_cast<double>(ratios.size() - 1));
  std::nth_element(ratios.begin(), within, ratios.end());
  const double widening = 2 * std::log(*within / kWidth);
  return std::isfinite(widening) ? std::clamp(widening, -kLargestMove, kLargestMove) : 0;
}

nssm::FilterNoise Widened(nssm::FilterNoise noise, double log_widening) {
  noise.process *= std::exp(log_widening);
  noise.measurement *= std::exp(log_widening);
  noise.process_bias = Scaled(std::move(noise.process_bias), log_widening, 0);
  noise.measurement_bias = Scaled(std::move(noise.measurement_bias), log_widening, 0);
  noise.parameter_std *= std::exp(0.5 * log_widening);
  return noise;
}

Explanation Explain(const nssm::Bundle& bundle, const std::vector<CalibrationRun>& runs, base::Executor* executor) {
  const std::shared_ptr<const FilterModel> model = FilterModel::Create(bundle);
  const absl::StatusOr<std::vector<Prepared>> prepared = PrepareAll(bundle, model, runs);
  if (!prepared.ok()) return {kFailed, {}};
  std::vector<Score> scores(runs.size());
  std::vector<std::vector<double>> ratios(runs.size());
  executor->ParallelFor(runs.size(), [&](size_t i, size_t) { scores[i] = ScoreOf(bundle, bundle.noise, model, (*prepared)[i], &ratios[i]); });
  Explanation explanation;
  for (size_t i = 0; i < runs.size(); ++i) {
    explanation.likelihood += scores[i].likelihood / static_cast<double>(runs.size());
    if (scores[i].likelihood > kFailed) explanation.ratios.insert(explanation.ratios.end(), ratios[i].begin(), ratios[i].end());
  }
  return explanation;
}

nssm::FilterNoise Calibrate(const nssm::Bundle& bundle, const std::vector<CalibrationRun>& runs, double log_std, base::Executor* executor) {
  if (log_std == 0) return bundle.noise;
  const std::shared_ptr<const FilterModel> model = FilterModel::Create(bundle);
  const absl::StatusOr<std::vector<Prepared>> prepared = PrepareAll(bundle, model, runs);
  if (!prepared.ok()) return bundle.noise;
  const bool fleet = std::isinf(log_std);
  const Layout layout{.process = bundle.model.spec().is_case_one() ? 1 : bundle.noise.process.rows(),
                      .measurement = bundle.noise.measurement.rows(),
                      .process_bias = bundle.noise.process_bias.loadings.cols() > 0,
                      .measurement_bias = bundle.noise.measurement_bias.loadings.cols() > 0,
                      .parameters = fleet && std::any_of(runs.begin(), runs.end(), [](const CalibrationRun& run) { return run.directions.cols() > 0; })};
  std::array<std::vector<size_t>, 2> halves;
  std::vector<size_t> rest;
  for (size_t i = 0; i < runs.size(); ++i) {
    (runs[i].width_only ? rest : halves[halves[0].size() > halves[1].size() ? 1 : 0]).push_back(i);
  }
  const auto most_likely = [&](const std::vector<size_t>& indices) {
    std::vector<Prepared> picked;
    for (const size_t i : indices) picked.push_back((*prepared)[i]);
    return MostLikelyScales(bundle, model, layout, picked, log_std, executor);
  };
  if (!fleet || halves[0].size() + halves[1].size() < kFewestRuns) {
    halves[0].insert(halves[0].end(), halves[1].begin(), halves[1].end());
    return Scaled(bundle.noise, most_likely(halves[0]), layout);
  }
  const std::array<VectorXd, 2> scales = {most_likely(halves[0]), most_likely(halves[1])};
  const nssm::FilterNoise noise = Scaled(bundle.noise, 0.5 * (scales[0] + scales[1]), layout);
  const std::vector<Judged> parts = {{halves[0], Scaled(bundle.noise, scales[1], layout)}, {halves[1], Scaled(bundle.noise, scales[0], layout)}, {rest, noise}};
  return Widened(noise, Widening(bundle, parts, model, runs, *prepared, executor));
}

}  // namespace metaekf::filter
