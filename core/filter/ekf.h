#pragma once

#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "absl/status/statusor.h"
#include "core/filter/filter_model.h"

namespace metaekf::filter {

enum class Health {
  kWarmingUp,     ///< Case I before the first window is full: no estimate yet
  kConsistent,    ///< innovations are as large as their covariance says
  kInconsistent,  ///< the NIS, averaged, is far from what it should be
  kDiverged,      ///< a value is not finite: do not use
};

/// What one sample taught. Physical units. Sizes: n_e estimated channels (Case II: n_x, Case I: n_y), n_y outputs.
struct Estimate {
  Eigen::VectorXd mean;            ///< Case II: x⁺; Case I: the latent filter's ŷ
  Eigen::MatrixXd cov;             ///< its covariance; Case I: H P⁺ Hᵀ, without R
  Eigen::VectorXd innovation;      ///< y − h(x⁻, u); NaN where not measured
  Eigen::MatrixXd innovation_cov;  ///< S = H P⁻ Hᵀ + R; NaN where not measured
  double nis = 0;                  ///< ỹᵀ S⁻¹ ỹ over what was measured; NaN where nothing was
  int measured = 0;                ///< components of y that were
  /// Of a model whose states lie in a set: what Constrain has found and done, in units of the states' scales; else NaN.
  double slack = std::numeric_limits<double>::quiet_NaN(), projection = std::numeric_limits<double>::quiet_NaN();
  Health health = Health::kWarmingUp;
};

/// Settings of a filter that override those of the model's file. Physical units (latents in Case I).
struct FilterOptions {
  std::optional<Eigen::MatrixXd> process_cov;      ///< Q, n × n, positive semidefinite
  std::optional<Eigen::MatrixXd> measurement_cov;  ///< R, n_y × n_y, positive definite
  std::optional<Eigen::VectorXd> initial_mean;     ///< Case II: x⁻ at the first sample; default the fleet's mean
  std::optional<Eigen::MatrixXd> initial_cov;      ///< n × n, positive semidefinite
};

/// What a filter knows between two samples: all that a checkpoint must hold. Normalised units.
struct FilterState {
  Eigen::VectorXd mean;            ///< x⁺ after the last sample; Case II before the first: x⁻
  Eigen::MatrixXd factor;          ///< L with P = L Lᵀ
  Eigen::VectorXd last_input;      ///< u of the last sample
  std::vector<double> window;      ///< Case I: the samples of the window so far
  int64_t samples = 0;             ///< applied so far
  double nis_ratio = 1;            ///< running mean of NIS per measured component
  bool diverged = false;
};

/// An extended Kalman filter on a neural state-space model, one sample at a time.
///
///   x⁻ = f(x⁺, u_{t−1})      P⁻ = F P⁺ Fᵀ + Q          from the second sample on
///   ỹ = y − h(x⁻, u_t)       S = H P⁻ Hᵀ + R
///   x⁺ = x⁻ + K ỹ            P⁺ = (I − K H) P⁻           K = P⁻ Hᵀ S⁻¹
///
/// in square-root form. Where the model's states lie in a set, the estimate is put inside (Constrain), and the mean that is
/// given out is inside to rounding in physical units. Components of y that are NaN are not measured; if all are, only time passes. In Case I the state
/// is the latent ψ; the first H fully measured samples in a row fill the encoder's window, the last of them gives the
/// first estimate.
/// A filter is used by one thread at a time; Step does not allocate, unless a constraint moves the estimate.
/// Source: paper.tex eqs. deep_cekf_all, jac_defs; the square-root form is ours.
class Ekf {
 public:
  /// @param model  shared with other filters. @param parameters  from model->Prepare(bundle.parameters).
  /// Errors: InvalidArgument naming the covariance or mean that has the wrong size or is not a covariance.
  static absl::StatusOr<Ekf> Create(const nssm::Bundle& bundle, std::shared_ptr<const FilterModel> model,
                                    std::shared_ptr<const FilterModel::Parameters> parameters,
                                    const FilterOptions& options);

  /// An estimate with its vectors and matrices sized, for Step to write into.
  Estimate MakeEstimate() const;

  /// Applies the sample (u, y) of one period after the last.
  /// @param input  n_u, finite. @param output  n_y; NaN: not measured; else finite.
  /// Errors: InvalidArgument naming the value that is infinite, NaN or missing; the filter is unchanged then.
  absl::Status Step(const Eigen::Ref<const Eigen::VectorXd>& input, const Eigen::Ref<const Eigen::VectorXd>& output,
                    FilterModel::Scratch* scratch, Estimate* estimate);

  const FilterState& state() const { return state_; }
  /// Goes on from a state of a filter of the same model and options.
  void Restore(FilterState state) { state_ = std::move(state); }

  /// u of the last sample, physical units; the inputs' means before the first.
  Eigen::VectorXd LastInput() const;

  int32_t estimate_size() const { return case_one_ ? output_size_ : state_size_; }
  int32_t input_size() const { return input_size_; }
  int32_t output_size() const { return output_size_; }
  /// Whether estimates come with slack and projection.
  bool constrained() const { return normalised_set_.has_value(); }

 private:
  Ekf() = default;

  void FillWindow(FilterModel::Scratch* scratch);  // Case I: adds (u_, y_), encodes when full
  void TimeUpdate(FilterModel::Scratch* scratch);
  void MeasurementUpdate(FilterModel::Scratch* scratch, Estimate* estimate);
  void WriteEstimate(FilterModel::Scratch* scratch, Estimate* estimate);
  void JudgeHealth(Estimate* estimate);

  std::shared_ptr<const FilterModel> model_;
  std::shared_ptr<const FilterModel::Parameters> parameters_;
  bool case_one_ = false;
  bool next_input_ = false;  // f takes the input of the sample it leads to
  int32_t input_size_ = 0, output_size_ = 0, state_size_ = 0;
  size_t window_size_ = 0;  // Case I: values in a full window
  data::Normaliser normaliser_;
  std::optional<physics::Polyhedron> set_;             // of what is estimated, in physical units
  std::optional<physics::Polyhedron> normalised_set_;  // of the state
  Eigen::MatrixXd process_factor_;    // Q^½, normalised
  Eigen::MatrixXd measurement_cov_;   // R, normalised
  Eigen::MatrixXd initial_factor_;

  FilterState state_;
  // Scratch of a step, sized once.
  Eigen::VectorXd u_, y_, value_, h_, innovation_;
  Eigen::MatrixXd F_, H_, H_rows_, time_work_, update_work_, product_;
};

}  // namespace metaekf::filter
