#include "core/filter/ekf.h"

#include <cmath>
#include <limits>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/filter/constrain.h"
#include "core/filter/square_root.h"
#include "core/physics/projection.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// The NIS of one component is χ² with one degree of freedom: mean 1, variance 2. A running mean with weight 1/100 has
// standard deviation √(2/199) ≈ 0.1; outside [0.5, 2] it is five of them or more away from 1.
constexpr double kNisWeight = 0.01;
constexpr double kNisLow = 0.5, kNisHigh = 2;

/// A ← D⁻¹ A D⁻¹: a covariance from physical to normalised units.
MatrixXd Normalised(const MatrixXd& cov, const VectorXd& scale) {
  const VectorXd inverse = scale.cwiseInverse();
  return inverse.asDiagonal() * cov * inverse.asDiagonal();
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

absl::Status CheckSize(const std::string& name, const MatrixXd& matrix, Index n) {
  if (matrix.rows() == n && matrix.cols() == n) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(name, ": expected a ", n, " × ", n, " matrix, got ", matrix.rows(), " × ", matrix.cols()));
}

}  // namespace

absl::StatusOr<Ekf> Ekf::Create(const nssm::Bundle& bundle, std::shared_ptr<const FilterModel> model,
                                std::shared_ptr<const FilterModel::Parameters> parameters,
                                const FilterOptions& options) {
  const nssm::ModelSpec& spec = bundle.model.spec();
  Ekf ekf;
  ekf.model_ = std::move(model);
  ekf.parameters_ = std::move(parameters);
  ekf.case_one_ = spec.is_case_one();
  ekf.next_input_ = spec.transition.input_time == nssm::InputTime::kNext;
  ekf.input_size_ = spec.input_size;
  ekf.output_size_ = spec.output_size;
  ekf.state_size_ = ekf.model_->state_size();
  ekf.window_size_ = ekf.case_one_ ? static_cast<size_t>(bundle.model.start_size()) : 0;
  ekf.normaliser_ = bundle.normaliser;
  const physics::Polyhedron* const set = ekf.case_one_ ? bundle.model.output_set() : bundle.model.state_set();
  if (set != nullptr) ekf.set_ = *set;
  if (set != nullptr && !ekf.case_one_) {
    ekf.normalised_set_ = InUnits(*set, bundle.normaliser.states.mean, bundle.normaliser.states.scale);
  }
  const Index n = ekf.state_size_, n_y = ekf.output_size_;
  const VectorXd state_scale = ekf.case_one_ ? VectorXd::Ones(n) : bundle.normaliser.states.scale;

  const MatrixXd Q = options.process_cov.value_or(bundle.noise.process);
  const MatrixXd R = options.measurement_cov.value_or(bundle.noise.measurement);
  const MatrixXd P = options.initial_cov.value_or(bundle.noise.initial);
  METAEKF_RETURN_IF_ERROR(CheckSize("process noise covariance Q", Q, n));
  METAEKF_RETURN_IF_ERROR(CheckSize("measurement noise covariance R", R, n_y));
  METAEKF_RETURN_IF_ERROR(CheckSize("initial covariance", P, n));
  const auto factor = [](const std::string& name, const MatrixXd& cov) -> absl::StatusOr<MatrixXd> {
    absl::StatusOr<MatrixXd> result = SemidefiniteFactor(cov);
    if (!result.ok()) return base::Annotate(result.status(), name);
    return result;
  };
  METAEKF_ASSIGN_OR_RETURN(ekf.process_factor_, factor("process noise covariance Q", Normalised(Q, state_scale)));
  METAEKF_ASSIGN_OR_RETURN(ekf.initial_factor_, factor("initial covariance", Normalised(P, state_scale)));
  ekf.measurement_cov_ = Normalised(R, bundle.normaliser.outputs.scale);
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd R_factor, factor("measurement noise covariance R", ekf.measurement_cov_));
  if (R_factor.size() > 0 && R_factor.diagonal().minCoeff() <= 0) {
    return absl::InvalidArgumentError("measurement noise covariance R: must be positive definite");
  }

  ekf.state_.mean = VectorXd::Zero(n);
  if (options.initial_mean) {
    if (ekf.case_one_) return absl::InvalidArgumentError("initial mean: in Case I the first window gives the latent");
    if (options.initial_mean->size() != n || !options.initial_mean->allFinite()) {
      return absl::InvalidArgumentError(absl::StrCat("initial mean: expected ", n, " finite numbers, got ",
                                                     options.initial_mean->size()));
    }
    ekf.state_.mean = bundle.normaliser.states.Normalise(*options.initial_mean);
  }
  ekf.state_.factor = ekf.initial_factor_;
  ekf.state_.last_input = VectorXd::Zero(ekf.input_size_);
  ekf.state_.window.reserve(ekf.window_size_);
  ekf.u_.resize(ekf.input_size_);
  ekf.y_.resize(n_y);
  ekf.value_.resize(n);
  ekf.h_.resize(n_y);
  ekf.innovation_.resize(n_y);
  ekf.F_.resize(n, n);
  ekf.H_.resize(n_y, n);
  ekf.H_rows_.resize(n_y, n);
  ekf.time_work_.resize(n, 2 * n);
  ekf.update_work_.resize(n + n_y, n + n_y);
  ekf.product_.resize(std::max(n, n_y), n);
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
                       FilterModel::Scratch* scratch, Estimate* estimate) {
  if (input.size() != input_size_ || output.size() != output_size_) {
    return absl::InvalidArgumentError(absl::StrCat("a sample has ", input_size_, " inputs and ", output_size_,
                                                   " outputs, got ", input.size(), " and ", output.size()));
  }
  for (Index i = 0; i < input_size_; ++i) {
    if (!std::isfinite(input[i])) {
      return absl::InvalidArgumentError(absl::StrCat("input ", i + 1, " is ", base::FormatExact(input[i])));
    }
  }
  const bool filling = case_one_ && state_.window.size() < window_size_;
  for (Index i = 0; i < output_size_; ++i) {
    if (std::isinf(output[i])) {
      return absl::InvalidArgumentError(absl::StrCat("output ", i + 1, " is ", base::FormatExact(output[i])));
    }
  }
  u_ = (input - normaliser_.inputs.mean).cwiseQuotient(normaliser_.inputs.scale);
  y_ = (output - normaliser_.outputs.mean).cwiseQuotient(normaliser_.outputs.scale);
  if (filling) {
    FillWindow(scratch);
    // The window's last sample is the first with a latent; its measurement has been used by the encoder.
    y_.setConstant(kNaN);
  } else if (state_.samples > 0) {
    TimeUpdate(scratch);
  }
  ++state_.samples;
  state_.last_input = u_;
  MeasurementUpdate(scratch, estimate);
  estimate->slack = estimate->projection = kNaN;
  if (normalised_set_ && state_.mean.allFinite() && state_.factor.allFinite()) {
    const ConstraintEffect effect = Constrain(*normalised_set_, &state_.mean, &state_.factor);
    estimate->slack = effect.slack;
    estimate->projection = effect.projection;
  }
  WriteEstimate(scratch, estimate);
  JudgeHealth(estimate);
  return absl::OkStatus();
}

VectorXd Ekf::LastInput() const {
  return state_.last_input.cwiseProduct(normaliser_.inputs.scale) + normaliser_.inputs.mean;
}

void Ekf::FillWindow(FilterModel::Scratch* scratch) {
  // The encoder has no place for a value that was not measured: the window starts anew behind it.
  if (y_.hasNaN()) {
    state_.window.clear();
    return;
  }
  for (Index i = 0; i < input_size_; ++i) state_.window.push_back(u_[i]);
  for (Index i = 0; i < output_size_; ++i) state_.window.push_back(y_[i]);
  if (state_.window.size() < window_size_) return;
  model_->Encode(*parameters_, Eigen::Map<const VectorXd>(state_.window.data(), static_cast<Index>(window_size_)),
                 &state_.mean, scratch);
}

void Ekf::TimeUpdate(FilterModel::Scratch* scratch) {
  model_->Transition(*parameters_, state_.mean, next_input_ ? u_ : state_.last_input, &value_, &F_, scratch);
  FactorTimeUpdate(F_, process_factor_, &time_work_, &state_.factor);
  state_.mean = value_;
}

void Ekf::MeasurementUpdate(FilterModel::Scratch* scratch, Estimate* estimate) {
  estimate->innovation.setConstant(kNaN);
  estimate->innovation_cov.setConstant(kNaN);
  estimate->nis = kNaN;
  estimate->measured = 0;
  const auto measured_row = [this](Index i) { return !std::isnan(y_[i]); };
  for (Index i = 0; i < output_size_; ++i) estimate->measured += measured_row(i) ? 1 : 0;
  if (estimate->measured == 0) return;

  model_->Measurement(*parameters_, state_.mean, u_, &h_, &H_, scratch);
  const Index m = estimate->measured, n = state_size_;
  auto work = update_work_.topLeftCorner(m + n, m + n);
  Index row = 0;
  for (Index i = 0; i < output_size_; ++i) {
    if (!measured_row(i)) continue;
    H_rows_.row(row) = H_.row(i);
    innovation_[row] = y_[i] - h_[i];
    Index col = 0;
    for (Index j = 0; j < output_size_; ++j) {
      if (measured_row(j)) work(row, col++) = measurement_cov_(i, j);
    }
    ++row;
  }
  CholeskyInPlace(work.topLeftCorner(m, m));
  FactorMeasurementUpdate(H_rows_.topRows(m), work, &state_.factor);

  // K ỹ = (K S^½)(S^−½ ỹ), and the NIS is the squared length of S^−½ ỹ.
  auto whitened = innovation_.head(m);
  estimate->nis = 0;
  Index at = 0;
  for (Index i = 0; i < output_size_; ++i) {
    if (measured_row(i)) estimate->innovation[i] = whitened[at++] * normaliser_.outputs.scale[i];
  }
  for (Index i = 0; i < m; ++i) {
    for (Index j = 0; j < i; ++j) whitened[i] -= work(i, j) * whitened[j];
    whitened[i] /= work(i, i);
    estimate->nis += whitened[i] * whitened[i];
  }
  for (Index j = 0; j < m; ++j) state_.mean += work.col(j).tail(n) * whitened[j];
  // S back in physical units, at the rows and columns that were measured.
  Index s_row = 0;
  for (Index i = 0; i < output_size_; ++i) {
    if (!measured_row(i)) continue;
    Index s_col = 0;
    for (Index j = 0; j < output_size_; ++j) {
      if (!measured_row(j)) continue;
      double sum = 0;
      for (Index k = 0; k <= std::min(s_row, s_col); ++k) sum += work(s_row, k) * work(s_col, k);
      estimate->innovation_cov(i, j) = sum * normaliser_.outputs.scale[i] * normaliser_.outputs.scale[j];
      ++s_col;
    }
    ++s_row;
  }
}

void Ekf::WriteEstimate(FilterModel::Scratch* scratch, Estimate* estimate) {
  if (case_one_ && state_.window.size() < window_size_) {
    estimate->mean.setConstant(kNaN);
    estimate->cov.setConstant(kNaN);
    return;
  }
  const data::ChannelScaling& scaling = case_one_ ? normaliser_.outputs : normaliser_.states;
  auto root = product_.topRows(estimate_size());
  if (case_one_) {
    model_->Measurement(*parameters_, state_.mean, u_, &h_, &H_, scratch);
    estimate->mean = h_.cwiseProduct(scaling.scale) + scaling.mean;
    root.noalias() = H_.lazyProduct(state_.factor);
  } else {
    estimate->mean = state_.mean.cwiseProduct(scaling.scale) + scaling.mean;
    root = state_.factor;
  }
  if (set_ && estimate->mean.allFinite() && !physics::Contains(*set_, estimate->mean)) {
    estimate->mean = physics::Inside(*set_, estimate->mean);  // rounding has put it outside
  }
  for (Index i = 0; i < root.rows(); ++i) root.row(i) *= scaling.scale[i];
  estimate->cov.noalias() = root.lazyProduct(root.transpose());
}

void Ekf::JudgeHealth(Estimate* estimate) {
  if (case_one_ && state_.window.size() < window_size_) {
    estimate->health = Health::kWarmingUp;
    return;
  }
  if (!state_.mean.allFinite() || !state_.factor.allFinite()) state_.diverged = true;
  if (estimate->measured > 0) {
    state_.nis_ratio += kNisWeight * (estimate->nis / estimate->measured - state_.nis_ratio);
  }
  estimate->health = state_.diverged                                                  ? Health::kDiverged
                     : state_.nis_ratio < kNisLow || !(state_.nis_ratio <= kNisHigh) ? Health::kInconsistent
                                                                                      : Health::kConsistent;
}

}  // namespace metaekf::filter
