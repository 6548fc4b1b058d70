#include "core/filter/ekf.h"

#include <cmath>
#include <limits>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/base/with_count.h"
#include "core/filter/chi_squared.h"
#include "core/filter/constrain.h"
#include "core/filter/least_squares_start.h"
#include "core/filter/square_root.h"
#include "core/physics/projection.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

constexpr int32_t kMaxInitialSamples = 1000;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// A ← D⁻¹ A D⁻¹: a covariance from physical to normalised units.
MatrixXd Normalised(const MatrixXd& cov, const VectorXd& scale) {
  const VectorXd inverse = scale.cwiseInverse();
  return inverse.asDiagonal() * cov * inverse.asDiagonal();
}

/// In units of scales; latents have none.
nssm::GaussMarkov Normalised(nssm::GaussMarkov bias, const VectorXd& scale) {
  if (scale.size() > 0 && bias.loadings.size() > 0) bias.loadings = scale.cwiseInverse().asDiagonal() * bias.loadings;
  return bias;
}

/// A ← L with L Lᵀ = A, lower triangle; A is positive definite (checked when the filter was made).
void CholeskyInPlace(Ref<MatrixXd> a) {
  for (Index j = 0; j < a.cols(); ++j) {
    for (Index k = 0; k < j; ++k) a(j, j) -= a(j, k) * a(j, k);
    a(j, j) = std::sqrt(a(j, j));
    for (Index i = j + 1; i < a.rows(); ++i) {
      for (Index k = 0; k < j; ++k) a(i, j) -= a(i, k) * a(j, k);
      a(i, j) /= a(j, j);
    }
    a.col(j).head(j).setZero();
  }
}

/// A ← D R Rᵀ D with D = diag(scale), n × n; of a triangular R only the lower triangle is read.
/// @param root  R, at least n rows, of which the first n are taken.
void ScaledSquare(const MatrixXd& root, bool triangular, const VectorXd& scale, MatrixXd* a) {
  base::WithCount(scale.size(), [&](auto n) {
    for (Index j = 0; j < n; ++j) {
      double* const below = &(*a)(0, j);
      for (Index i = j; i < n; ++i) below[i] = 0;
      for (Index k = 0; k < (triangular ? j + 1 : root.cols()); ++k) {
        const double* const column = &root(0, k);
        const double factor = column[j];
        for (Index i = j; i < n; ++i) below[i] += factor * column[i];
      }
      for (Index i = j; i < n; ++i) (*a)(j, i) = below[i] *= scale[i] * scale[j];
    }
  });
}

absl::Status CheckSize(const std::string& name, const MatrixXd& matrix, Index n) {
  if (matrix.rows() == n && matrix.cols() == n) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(name, ": expected a ", n, " × ", n, " matrix, got ", matrix.rows(), " × ", matrix.cols()));
}

}  // namespace

/// R in normalised units. Errors: InvalidArgument if it is not n_y × n_y and positive definite.
absl::StatusOr<MatrixXd> NormalisedNoise(const MatrixXd& R, const VectorXd& scale) {
  METAEKF_RETURN_IF_ERROR(CheckSize("measurement noise covariance R", R, scale.size()));
  const MatrixXd normalised = Normalised(R, scale);
  const absl::StatusOr<MatrixXd> factor = SemidefiniteFactor(normalised);
  if (!factor.ok()) return base::Annotate(factor.status(), "measurement noise covariance R");
  if (factor->size() > 0 && factor->diagonal().minCoeff() <= 0) {
    return absl::InvalidArgumentError("measurement noise covariance R: must be positive definite");
  }
  return normalised;
}

absl::StatusOr<Ekf> Ekf::Create(const nssm::Bundle& bundle, std::shared_ptr<const FilterModel> model,
                                std::shared_ptr<const FilterModel::Parameters> parameters,
                                const FilterOptions& options) {
  const nssm::ModelSpec& spec = bundle.model.spec();
  Ekf ekf;
  const nssm::FilterNoise& noise = options.noise ? *options.noise : bundle.noise;
  const data::Normaliser& units = bundle.normaliser;
  ekf.joint_ = JointModel(std::move(model), std::move(parameters),
                          options.process_cov ? nssm::GaussMarkov() : Normalised(noise.process_bias, spec.is_case_one() ? VectorXd() : units.states.scale),
                          options.measurement_cov ? nssm::GaussMarkov() : Normalised(noise.measurement_bias, units.outputs.scale));
  ekf.case_one_ = spec.is_case_one();
  ekf.next_input_ = spec.transition.input_time == nssm::InputTime::kNext;
  ekf.input_size_ = spec.input_size;
  ekf.output_size_ = spec.output_size;
  ekf.model_size_ = static_cast<int32_t>(ekf.joint_.state_size());
  ekf.state_size_ = static_cast<int32_t>(ekf.joint_.size());
  if (options.initial_samples != 0 && (ekf.case_one_ || options.initial_samples < 0 || options.initial_samples > kMaxInitialSamples)) {
    return absl::InvalidArgumentError(
        absl::StrCat("initial samples: must be from 0 to ", kMaxInitialSamples, ", and 0 in Case I, got ", options.initial_samples));
  }
  ekf.window_size_ = static_cast<size_t>(ekf.case_one_ ? bundle.model.start_size()
                                                       : int64_t{options.initial_samples} * (spec.input_size + spec.output_size));
  ekf.normaliser_ = bundle.normaliser;
  const physics::Polyhedron* const set = ekf.case_one_ ? bundle.model.output_set() : bundle.model.state_set();
  if (set != nullptr) ekf.set_ = *set;
  if (set != nullptr && !ekf.case_one_) {
    ekf.normalised_set_ = WithFree(InUnits(*set, bundle.normaliser.states.mean, bundle.normaliser.states.scale), ekf.joint_.extra_size());
  }
  const Index n = ekf.model_size_, n_y = ekf.output_size_, joint = ekf.state_size_;
  const VectorXd state_scale = ekf.case_one_ ? VectorXd::Ones(n) : bundle.normaliser.states.scale;

  const MatrixXd Q = options.process_cov.value_or(noise.process);
  const MatrixXd R = options.measurement_cov.value_or(noise.measurement);
  const MatrixXd P = options.initial_cov.value_or(noise.initial);
  METAEKF_RETURN_IF_ERROR(CheckSize("process noise covariance Q", Q, n));
  METAEKF_RETURN_IF_ERROR(CheckSize("initial covariance", P, n));
  const auto factor = [](const std::string& name, const MatrixXd& cov) -> absl::StatusOr<MatrixXd> {
    absl::StatusOr<MatrixXd> result = SemidefiniteFactor(cov);
    if (!result.ok()) return base::Annotate(result.status(), name);
    return result;
  };
  const auto with_extra = [&](const MatrixXd& of_state, const VectorXd& of_extra) {
    MatrixXd whole = MatrixXd::Zero(joint, joint);
    whole.topLeftCorner(n, n) = of_state;
    whole.diagonal().tail(of_extra.size()) = of_extra;
    return whole;
  };
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd process_factor, factor("process noise covariance Q", Normalised(Q, state_scale)));
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd initial_factor, factor("initial covariance", Normalised(P, state_scale)));
  ekf.process_factor_ = with_extra(process_factor, ekf.joint_.ExtraNoise());
  ekf.initial_factor_ = with_extra(initial_factor, ekf.joint_.ExtraDeviations(noise.parameter_std));
  METAEKF_ASSIGN_OR_RETURN(ekf.measurement_cov_, NormalisedNoise(R, bundle.normaliser.outputs.scale));
  ekf.measurement_factor_ = ekf.measurement_cov_;
  CholeskyInPlace(ekf.measurement_factor_);

  ekf.initial_mean_ = VectorXd::Zero(joint);
  if (options.initial_mean) {
    if (ekf.case_one_) return absl::InvalidArgumentError("initial mean: in Case I the first window gives the latent");
    if (options.initial_mean->size() != n || !options.initial_mean->allFinite()) {
      return absl::InvalidArgumentError(absl::StrCat("initial mean: expected ", n, " finite numbers, got ",
                                                     options.initial_mean->size()));
    }
    ekf.initial_mean_.head(n) = bundle.normaliser.states.Normalise(*options.initial_mean);
  }
  if (!(options.gate.probability >= 0 && options.gate.probability < 1) || options.gate.recover_after < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("gate: a probability from 0 to below 1 and at least 1 sample are needed, got ",
                     base::FormatShort(options.gate.probability), " and ", options.gate.recover_after));
  }
  for (Index m = 1; options.gate.probability > 0 && m <= n_y; ++m) {
    ekf.gate_limits_.push_back(ChiSquaredQuantile(1 - options.gate.probability, static_cast<double>(m)));
  }
  ekf.recover_after_ = options.gate.recover_after;
  ekf.restart_after_divergence_ = options.restart_after_divergence;
  ekf.projection_ = options.projection;
  ekf.state_.mean = ekf.initial_mean_;
  ekf.state_.factor = ekf.initial_factor_;
  ekf.state_.last_input = VectorXd::Zero(ekf.input_size_);
  ekf.state_.nis = NisMonitor(n_y);
  ekf.state_.window.reserve(ekf.window_size_);
  ekf.u_.resize(ekf.input_size_);
  ekf.y_.resize(n_y);
  ekf.value_.resize(joint);
  ekf.latent_.resize(n);
  ekf.h_.resize(n_y);
  ekf.whitened_.resize(n_y);
  ekf.measured_.reserve(static_cast<size_t>(n_y));
  ekf.prior_factor_.resize(joint, joint);
  ekf.F_.resize(joint, joint);
  ekf.H_.resize(n_y, joint);
  ekf.H_rows_.resize(n_y, joint);
  ekf.time_work_.resize(joint, 2 * joint);
  ekf.update_work_.resize(joint + n_y, joint + n_y);
  ekf.output_factor_.resize(n_y, joint);
  return ekf;
}

Estimate Ekf::MakeEstimate() const {
  const Index n = estimate_size();
  return {.mean = VectorXd(n),
          .cov = MatrixXd(n, n),
          .innovation = VectorXd(output_size_),
          .innovation_cov = MatrixXd(output_size_, output_size_)};
}

absl::Status Ekf::Step(const Ref<const VectorXd>& input, const Ref<const VectorXd>& output,
                       FilterModel::Scratch* scratch, Estimate* estimate, const MatrixXd* measurement_cov) {
  METAEKF_RETURN_IF_ERROR(CheckSizes(input.size(), output.size()));
  NextSample sample{this, input.data(), output.data(), measurement_cov, estimate, absl::OkStatus()};
  StepTogether({&sample, 1}, scratch);
  return sample.status;
}

absl::Status Ekf::CheckSizes(Index inputs, Index outputs) const {
  if (inputs == input_size_ && outputs == output_size_) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat("a sample has ", input_size_, " inputs and ", output_size_, " outputs, got ", inputs, " and ", outputs));
}

void StepTogether(std::span<NextSample> samples, FilterModel::Scratch* scratch) {
  absl::InlinedVector<JointModel::Point, 8> points;
  for (NextSample& sample : samples) {
    sample.status = sample.filter->Begin(sample, scratch);
    if (sample.status.ok() && sample.filter->passes_time()) points.push_back(sample.filter->TransitionPoint());
  }
  JointModel::Transition(points, scratch);
  points.clear();
  for (NextSample& sample : samples) {
    if (!sample.status.ok()) continue;
    if (sample.filter->passes_time()) sample.filter->TimeUpdate();
    if (sample.filter->measures()) points.push_back(sample.filter->MeasurementPoint());
  }
  JointModel::Measurement(points, scratch);
  points.clear();
  for (NextSample& sample : samples) {
    if (!sample.status.ok()) continue;
    sample.filter->MeasurementUpdate(scratch, sample.estimate);
    if (sample.filter->describes_outputs()) points.push_back(sample.filter->MeasurementPoint());
  }
  JointModel::Measurement(points, scratch);
  for (NextSample& sample : samples) {
    if (sample.status.ok()) sample.filter->Finish(sample.estimate);
  }
}

absl::Status Ekf::Begin(const NextSample& sample, FilterModel::Scratch* scratch) {
  const Eigen::Map<const VectorXd> input(sample.input, input_size_), output(sample.output, output_size_);
  for (Index i = 0; i < input_size_; ++i) {
    if (!std::isfinite(input[i])) {
      return absl::InvalidArgumentError(absl::StrCat("input ", i + 1, " is ", base::FormatExact(input[i])));
    }
  }
  for (Index i = 0; i < output_size_; ++i) {
    if (std::isinf(output[i])) {
      return absl::InvalidArgumentError(absl::StrCat("output ", i + 1, " is ", base::FormatExact(output[i])));
    }
  }
  sample_cov_.reset();
  if (sample.measurement_cov != nullptr) {
    METAEKF_ASSIGN_OR_RETURN(sample_cov_, NormalisedNoise(*sample.measurement_cov, normaliser_.outputs.scale));
  }
  sample.estimate->reset = state_.diverged && restart_after_divergence_;
  if (sample.estimate->reset) Restart();
  u_ = (input - normaliser_.inputs.mean).cwiseQuotient(normaliser_.inputs.scale);
  y_ = (output - normaliser_.outputs.mean).cwiseQuotient(normaliser_.outputs.scale);
  if (trace_ != nullptr) *trace_ = {};
  passes_time_ = state_.started && !warming_up();
  if (warming_up()) {
    FillWindow(scratch);
    // The window's last sample is the first with a latent; its measurement has been used by the encoder.
    y_.setConstant(kNaN);
  }
  measured_.clear();
  for (Index i = 0; i < output_size_; ++i) {
    if (!std::isnan(y_[i])) measured_.push_back(i);
  }
  return absl::OkStatus();
}

void Ekf::TimeUpdate() {
  FactorTimeUpdate(F_, process_factor_, &time_work_, &state_.factor);
  state_.mean = value_;
  if (trace_ == nullptr) return;
  trace_->linked = true;
  trace_->prior = value_;
  trace_->F = F_;
}

void Ekf::MeasurementUpdate(FilterModel::Scratch* scratch, Estimate* estimate) {
  state_.started = true;
  ++state_.samples;
  state_.last_input = u_;
  if (std::cmp_less(measured_.size(), output_size_)) {
    estimate->innovation.setConstant(kNaN);
    estimate->innovation_cov.setConstant(kNaN);
  }
  estimate->nis = kNaN;
  estimate->gated = 0;
  estimate->measured = static_cast<int>(measured_.size());
  if (!measured_.empty()) Update(estimate);
  PutInside(scratch, estimate);
}

void Ekf::Finish(Estimate* estimate) {
  if (warming_up()) {
    estimate->mean.setConstant(kNaN);
    estimate->cov.setConstant(kNaN);
  } else {
    WriteEstimate(state_.mean, state_.factor, estimate);
  }
  if (trace_ != nullptr) {
    trace_->input = u_;
    trace_->warming_up = warming_up();
  }
  JudgeHealth(estimate);
}

void Ekf::Restart() {
  state_.mean = initial_mean_;
  state_.factor = initial_factor_;
  state_.window.clear();
  state_.nis = NisMonitor(output_size_);
  state_.gated_in_row = 0;
  state_.started = state_.diverged = false;
}

VectorXd Ekf::LastInput() const {
  return state_.last_input.cwiseProduct(normaliser_.inputs.scale) + normaliser_.inputs.mean;
}

MatrixXd Ekf::MeasurementNoise() const {
  return normaliser_.outputs.scale.asDiagonal() * measurement_cov_ * normaliser_.outputs.scale.asDiagonal();
}

absl::StatusOr<std::vector<Estimate>> Ekf::Forecast(const MatrixXd& inputs, FilterModel::Scratch* scratch) const {
  Ekf ahead = *this;
  const VectorXd nothing = VectorXd::Constant(output_size_, kNaN);
  std::vector<Estimate> estimates(static_cast<size_t>(inputs.cols()), MakeEstimate());
  for (Index t = 0; t < inputs.cols(); ++t) {
    METAEKF_RETURN_IF_ERROR(ahead.Step(inputs.col(t), nothing, scratch, &estimates[static_cast<size_t>(t)]));
  }
  return estimates;
}

void Ekf::FillWindow(FilterModel::Scratch* scratch) {
  // The encoder has no place for a value that was not measured: the window starts anew behind it.
  if (case_one_ && y_.hasNaN()) {
    state_.window.clear();
    return;
  }
  for (Index i = 0; i < input_size_; ++i) state_.window.push_back(u_[i]);
  for (Index i = 0; i < output_size_; ++i) state_.window.push_back(y_[i]);
  if (state_.window.size() == window_size_) BeginFromWindow(scratch);
}

void Ekf::BeginFromWindow(FilterModel::Scratch* scratch) {
  const Index size = static_cast<Index>(window_size_), channels = input_size_ + output_size_;
  if (case_one_) {
    joint_.Encode(Eigen::Map<const VectorXd>(state_.window.data(), size), &latent_, scratch);
    state_.mean.head(model_size_) = latent_;
    return;
  }
  const Eigen::Map<const MatrixXd> window(state_.window.data(), channels, size / channels);
  StateEstimate start = LeastSquaresStart(joint_,
                                          {.inputs = window.topRows(input_size_), .outputs = window.bottomRows(output_size_),
                                           .next_input = next_input_, .prior_mean = initial_mean_, .prior_factor = initial_factor_,
                                           .process_factor = process_factor_, .measurement_cov = measurement_cov_},
                                          scratch);
  state_.mean = std::move(start.mean);
  state_.factor = std::move(start.factor);
}

/// x⁻ to x⁺ by what was measured, from h and H there.
void Ekf::Update(Estimate* estimate) {
  prior_factor_ = state_.factor;
  estimate->nis = UpdateFactor(measured_);
  WriteInnovation(estimate);
  const size_t m = measured_.size();
  const bool outliers = !gate_limits_.empty() && !(estimate->nis <= gate_limits_[m - 1] * std::max(1.0, state_.nis.Ratio()));
  if (!outliers || !state_.mean.allFinite()) {
    state_.gated_in_row = 0;
    state_.nis.Add(estimate->nis, estimate->measured, whitened_.head(updated_ == output_size_ ? updated_ : 0));
    return MoveMean();
  }
  state_.factor = prior_factor_;
  LeaveOutliersOut(estimate);
}

double Ekf::UpdateFactor(const std::vector<Index>& rows) {
  const Index n = state_size_;
  updated_ = static_cast<Index>(rows.size());
  const auto work = update_work_.topLeftCorner(updated_ + n, updated_ + n);
  const bool usual = updated_ == output_size_ && !sample_cov_;
  return base::WithCount(updated_, [&](auto m) {
    const MatrixXd& R_or_factor = usual ? measurement_factor_ : R();
    for (Index i = 0; i < m; ++i) {
      const Index row = rows[static_cast<size_t>(i)];
      whitened_[i] = y_[row] - h_[row];
      for (Index j = 0; j < n; ++j) H_rows_(i, j) = H_(row, j);
      for (Index j = 0; j < m; ++j) update_work_(i, j) = R_or_factor(row, rows[static_cast<size_t>(j)]);
    }
    if (!usual) CholeskyInPlace(update_work_.topLeftCorner(m, m));
    FactorMeasurementUpdate(H_rows_.topRows(m), work, &state_.factor);
    double nis = 0;
    for (Index i = 0; i < m; ++i) {
      for (Index j = 0; j < i; ++j) whitened_[i] -= update_work_(i, j) * whitened_[j];
      whitened_[i] /= update_work_(i, i);
      nis += whitened_[i] * whitened_[i];
    }
    return nis;
  });
}

void Ekf::MoveMean() {
  base::WithCount(state_size_, [&](auto n) {
    for (Index j = 0; j < updated_; ++j) {
      const double* const gain = &update_work_(updated_, j);  // K S^½
      for (Index i = 0; i < n; ++i) state_.mean[i] += gain[i] * whitened_[j];
    }
  });
}

void Ekf::WriteInnovation(Estimate* estimate) const {
  const VectorXd& scale = normaliser_.outputs.scale;
  base::WithCount(updated_, [&](auto m) {
    for (Index i = 0; i < m; ++i) {
      const Index row = measured_[static_cast<size_t>(i)];
      estimate->innovation[row] = (y_[row] - h_[row]) * scale[row];
      for (Index j = 0; j <= i; ++j) {
        const Index col = measured_[static_cast<size_t>(j)];
        double sum = 0;
        for (Index k = 0; k <= j; ++k) sum += update_work_(i, k) * update_work_(j, k);
        estimate->innovation_cov(row, col) = estimate->innovation_cov(col, row) = sum * scale[row] * scale[col];
      }
    }
  });
}

void Ekf::LeaveOutliersOut(Estimate* estimate) {
  const VectorXd innovation = (y_ - h_)(measured_);
  const MatrixXd predicted = H_(measured_, Eigen::all) * prior_factor_;
  const MatrixXd predicted_cov = predicted * predicted.transpose(), R_measured = R()(measured_, measured_);
  if (state_.gated_in_row >= recover_after_) {
    state_.gated_in_row = 0;
    estimate->reset = true;
    state_.nis.Add(estimate->nis, estimate->measured);
    const double widening = WideningFor(innovation, predicted_cov, R_measured);
    if (trace_ != nullptr) trace_->widening = widening;
    state_.factor *= std::sqrt(widening);
    UpdateFactor(measured_);
    return MoveMean();
  }
  ++state_.gated_in_row;
  std::vector<double> limits = gate_limits_;
  for (double& limit : limits) limit *= std::max(1.0, state_.nis.Ratio());
  const std::vector<Index> outliers = Outliers(innovation, predicted_cov + R_measured, limits);
  estimate->gated = static_cast<int>(outliers.size());
  std::vector<Index> kept;
  for (size_t i = 0; i < measured_.size(); ++i) {
    if (!std::binary_search(outliers.begin(), outliers.end(), static_cast<Index>(i))) kept.push_back(measured_[i]);
  }
  if (kept.empty()) return;
  state_.nis.Add(UpdateFactor(kept), static_cast<int>(kept.size()));
  MoveMean();
}

void Ekf::Describe(const VectorXd& mean, const MatrixXd& factor, const VectorXd& input, FilterModel::Scratch* scratch,
                   Estimate* estimate) {
  if (case_one_) joint_.Measurement(mean, input, &h_, &H_, scratch);
  WriteEstimate(mean, factor, estimate);
}

/// In Case I from h and H at the mean.
void Ekf::WriteEstimate(const VectorXd& mean, const MatrixXd& factor, Estimate* estimate) {
  const data::ChannelScaling& scaling = case_one_ ? normaliser_.outputs : normaliser_.states;
  const VectorXd& of = case_one_ ? h_ : mean;
  for (Index i = 0; i < estimate_size(); ++i) estimate->mean[i] = of[i] * scaling.scale[i] + scaling.mean[i];
  if (set_ && projection_ != Projection::kNone && estimate->mean.allFinite() && !physics::Contains(*set_, estimate->mean)) {
    estimate->mean = physics::Inside(*set_, estimate->mean);  // rounding has put it outside
  }
  if (case_one_) output_factor_.noalias() = H_.lazyProduct(factor);
  ScaledSquare(case_one_ ? output_factor_ : factor, /*triangular=*/!case_one_, scaling.scale, &estimate->cov);
}

void Ekf::PutInside(FilterModel::Scratch* scratch, Estimate* estimate) {
  estimate->slack = estimate->projection = kNaN;
  if (!normalised_set_ || warming_up() || !state_.mean.allFinite() || !state_.factor.allFinite()) return;
  if (projection_ == Projection::kQuadraticProgram) {
    const ConstraintEffect effect = Constrain(*normalised_set_, &state_.mean, &state_.factor);
    estimate->slack = effect.slack;
    estimate->projection = effect.projection;
    return;
  }
  estimate->slack = Slack(*normalised_set_, state_.mean);
  estimate->projection = 0;
  if (projection_ == Projection::kNone || physics::Contains(*normalised_set_, state_.mean)) return;
  joint_.Reconstruct(state_.mean, u_, &value_, &F_, scratch);
  estimate->projection = (value_ - state_.mean).norm();
  state_.mean = value_;
  state_.factor = F_ * state_.factor;
  LowerTriangularise(state_.factor);
}

void Ekf::JudgeHealth(Estimate* estimate) {
  // Outputs may overflow where the latent state does not yet.
  const bool told = warming_up() || (estimate->mean.allFinite() && estimate->cov.allFinite());
  if (!state_.mean.allFinite() || !state_.factor.allFinite() || !told) state_.diverged = true;
  estimate->health = warming_up() ? Health::kWarmingUp : state_.diverged ? Health::kDiverged : state_.nis.Judge();
}

}  // namespace metaekf::filter
