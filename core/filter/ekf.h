#pragma once

#include <limits>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "absl/status/statusor.h"
#include "core/filter/filter_model.h"
#include "core/filter/gate.h"
#include "core/filter/health.h"
#include "core/filter/joint_model.h"

namespace metaekf::filter {

/// What one sample taught. Physical units. Sizes: n_e estimated channels (Case II: n_x, Case I: n_y), n_y outputs.
struct Estimate {
  Eigen::VectorXd mean;            ///< Case II: x⁺; Case I: the latent filter's ŷ
  Eigen::MatrixXd cov;             ///< its covariance; Case I: H P⁺ Hᵀ, without R
  Eigen::VectorXd innovation;      ///< y − h(x⁻, u); NaN where not measured
  Eigen::MatrixXd innovation_cov;  ///< S = H P⁻ Hᵀ + R; NaN where not measured
  double nis = 0;                  ///< ỹᵀ S⁻¹ ỹ over what was measured, outliers too; NaN where nothing was
  int measured = 0;                ///< components of y that were
  int gated = 0;                   ///< of them: left out as outliers
  bool reset = false;              ///< the covariance was widened to believe y, or the filter begun anew after it diverged
  /// Of a model whose states lie in a set: what Constrain has found and done, in units of the states' scales; else NaN.
  double slack = std::numeric_limits<double>::quiet_NaN(), projection = std::numeric_limits<double>::quiet_NaN();
  Health health = Health::kWarmingUp;
};

/// How an estimate is put inside the set that the states lie in.
enum class Projection {
  kQuadraticProgram,  ///< the most probable point of the set, and the error about it (Constrain)
  kAutoencoder,       ///< x⁺ ← 𝓟x𝓓x𝓔(x⁺, u), P⁺ ← J P⁺ Jᵀ with J its Jacobian, where x⁺ is outside (eq. ae_based_proj)
  kNone,              ///< it may stay outside
};

/// Settings of a filter that override those of the model's file. Physical units (latents in Case I).
struct FilterOptions {
  std::optional<nssm::FilterNoise> noise;          ///< all of it; what is given below takes precedence
  std::optional<Eigen::MatrixXd> process_cov;      ///< Q, n × n, positive semidefinite; no error of f lasts then
  std::optional<Eigen::MatrixXd> measurement_cov;  ///< R, n_y × n_y, positive definite; no error of h lasts then
  std::optional<Eigen::VectorXd> initial_mean;     ///< Case II: x⁻ at the first sample; default the fleet's mean
  std::optional<Eigen::MatrixXd> initial_cov;      ///< n × n, positive semidefinite
  /// Case II: the state is first found by least squares from so many samples (LeastSquaresStart); they give no estimates but the
  /// last. 0: the filter begins at once from the initial mean and covariance, which are the prior of that fit else.
  int32_t initial_samples = 0;
  GateOptions gate;
  Projection projection = Projection::kQuadraticProgram;
  bool restart_after_divergence = true;  ///< begin anew, from the initial condition, with the sample after one that diverged
};

/// What a filter knows between two samples: all that a checkpoint must hold. Normalised units.
struct FilterState {
  Eigen::VectorXd mean;            ///< x⁺ after the last sample; Case II before the first: x⁻. With what is beside it (JointModel)
  Eigen::MatrixXd factor;          ///< L with P = L Lᵀ
  Eigen::VectorXd last_input;      ///< u of the last sample
  std::vector<double> window;      ///< Case I, and with initial_samples: the samples so far that the state is to be found from
  int64_t samples = 0;             ///< applied so far
  NisMonitor nis;
  int64_t gated_in_row = 0;        ///< samples until the last that lost components
  bool started = false;            ///< a sample has been applied since the filter was begun (anew)
  bool diverged = false;
};

/// What a step has done, as the smoother needs it. Normalised units.
struct StepTrace {
  bool linked = false;           ///< x⁻ came from the state before by f; else the filter began (anew)
  Eigen::VectorXd prior;         ///< x⁻, where linked
  Eigen::MatrixXd F;             ///< of f, where linked
  double widening = 1;           ///< P⁻ = λ (F P⁺ Fᵀ + Q), see WideningFor
  Eigen::VectorXd input;         ///< u of the sample
  bool warming_up = false;       ///< Case I: there is no state yet
};

/// The next sample of one of several filters, and what it teaches.
template <class Filter>
struct NextSampleOf {
  Filter* filter = nullptr;
  const double* input = nullptr;                     ///< n_u
  const double* output = nullptr;                    ///< n_y
  const Eigen::MatrixXd* measurement_cov = nullptr;  ///< or null: the filter's
  Estimate* estimate = nullptr;
  absl::Status status;  ///< of the step
};

class Ekf;
using NextSample = NextSampleOf<Ekf>;

/// Ekf::Step of filters on one FilterModel, which reads weights that they share once. What a filter does is to the bit what it does alone.
void StepTogether(std::span<NextSample> samples, FilterModel::Scratch* scratch);

/// An extended Kalman filter on a neural state-space model, one sample at a time.
///
///   x⁻ = f(x⁺, u_{t−1})      P⁻ = F P⁺ Fᵀ + Q          from the second sample on
///   ỹ = y − h(x⁻, u_t)       S = H P⁻ Hᵀ + R
///   x⁺ = x⁻ + K ỹ            P⁺ = (I − K H) P⁻           K = P⁻ Hᵀ S⁻¹
///
/// in square-root form. Where the model's states lie in a set, the estimate is put inside (Projection), and the mean that is
/// given out is inside to rounding in physical units. Components of y that are NaN are not measured; if all are, only time
/// passes. In Case I the state is the latent ψ; the first H fully measured samples in a row fill the encoder's window, the
/// last of them gives the first estimate.
///
/// What is not known of the parameters, and errors of f and h that last (FilterNoise), join the state (JointModel): few context samples
/// mean wider bounds, what is measured tells of the parameters, too, and an error that lasts is not taken for so many independent
/// ones. Estimates are of x alone.
///
/// Components of y beyond the gate are left out (Outliers). A filter that is overconfident anyway, by NisMonitor, opens its gate
/// in the same measure, and after GateOptions::recover_after samples with outliers in a row it is widened until it believes
/// them: no measurement is locked out for good.
/// A filter is used by one thread at a time; Step does not allocate, unless a constraint moves the estimate.
/// Source: paper.tex eqs. deep_cekf_all, jac_defs; the square-root form is ours.
class Ekf {
 public:
  /// @param model  shared with other filters. @param parameters  from model->Prepare.
  /// Errors: InvalidArgument naming the covariance or mean that has the wrong size or is not a covariance.
  static absl::StatusOr<Ekf> Create(const nssm::Bundle& bundle, std::shared_ptr<const FilterModel> model,
                                    std::shared_ptr<const FilterModel::Parameters> parameters,
                                    const FilterOptions& options);

  /// An estimate with its vectors and matrices sized, for Step to write into.
  Estimate MakeEstimate() const;

  /// Applies the sample (u, y) of one period after the last.
  /// @param input  n_u, finite. @param output  n_y; NaN: not measured; else finite.
  /// @param measurement_cov  R of this sample, positive definite; by default that of the filter.
  /// Errors: InvalidArgument naming the value that is infinite, NaN or missing, or R; the filter is unchanged then.
  absl::Status Step(const Eigen::Ref<const Eigen::VectorXd>& input, const Eigen::Ref<const Eigen::VectorXd>& output,
                    FilterModel::Scratch* scratch, Estimate* estimate, const Eigen::MatrixXd* measurement_cov = nullptr);

  /// Steps from now on write what they do into `trace`, until another is set; null: no more. It must outlive those steps.
  void set_trace(StepTrace* trace) { trace_ = trace; }

  /// Mean and covariance of what is estimated, in physical units, for a state N(mean, factor factorᵀ) in normalised units.
  void Describe(const Eigen::VectorXd& mean, const Eigen::MatrixXd& factor, const Eigen::VectorXd& input,
                FilterModel::Scratch* scratch, Estimate* estimate);

  const FilterState& state() const { return state_; }
  /// Goes on from a state of a filter of the same model and options.
  void Restore(FilterState state) { state_ = std::move(state); }

  /// u of the last sample, physical units; the inputs' means before the first.
  Eigen::VectorXd LastInput() const;
  /// R of samples that bring none, physical units.
  Eigen::MatrixXd MeasurementNoise() const;

  /// Estimates of the samples to come, from their inputs, with nothing measured. The filter stays as it is.
  /// @param inputs  n_u × horizon, finite. @return one estimate per column. Errors as those of Step.
  absl::StatusOr<std::vector<Estimate>> Forecast(const Eigen::MatrixXd& inputs, FilterModel::Scratch* scratch) const;

  /// Errors: InvalidArgument if a sample's sizes are not n_u and n_y.
  absl::Status CheckSizes(Eigen::Index inputs, Eigen::Index outputs) const;
  int32_t estimate_size() const { return case_one_ ? output_size_ : model_size_; }
  const JointModel& joint() const { return joint_; }
  const Eigen::MatrixXd& process_factor() const { return process_factor_; }
  bool projects() const { return projection_ != Projection::kNone; }
  /// The set of the state in normalised units; null without one.
  const physics::Polyhedron* normalised_set() const { return normalised_set_ ? &*normalised_set_ : nullptr; }
  int32_t input_size() const { return input_size_; }
  int32_t output_size() const { return output_size_; }
  /// Whether estimates come with slack and projection.
  bool constrained() const { return normalised_set_.has_value(); }

 private:
  friend void StepTogether(std::span<NextSample> samples, FilterModel::Scratch* scratch);
  Ekf() = default;

  // The parts of a step, between which a function of the model is evaluated.
  absl::Status Begin(const NextSample& sample, FilterModel::Scratch* scratch);
  bool passes_time() const { return passes_time_; }
  JointModel::Point TransitionPoint() { return {&joint_, &state_.mean, next_input_ ? &u_ : &state_.last_input, &value_, &F_}; }
  void TimeUpdate();
  bool measures() const { return !measured_.empty(); }
  JointModel::Point MeasurementPoint() { return {&joint_, &state_.mean, &u_, &h_, &H_}; }
  void MeasurementUpdate(FilterModel::Scratch* scratch, Estimate* estimate);
  bool describes_outputs() const { return case_one_ && !warming_up(); }
  void Finish(Estimate* estimate);

  void FillWindow(FilterModel::Scratch* scratch);  // adds (u_, y_), begins when full
  void BeginFromWindow(FilterModel::Scratch* scratch);
  void Update(Estimate* estimate);
  void WriteEstimate(const Eigen::VectorXd& mean, const Eigen::MatrixXd& factor, Estimate* estimate);
  // L⁻ to L⁺ by some components of y; leaves S^½ and K S^½ in update_work_ and S^−½ ỹ in whitened_. Returns their NIS.
  double UpdateFactor(const std::vector<Eigen::Index>& rows);
  void MoveMean();
  void WriteInnovation(Estimate* estimate) const;
  void LeaveOutliersOut(Estimate* estimate);
  const Eigen::MatrixXd& R() const { return sample_cov_ ? *sample_cov_ : measurement_cov_; }
  void Restart();
  void PutInside(FilterModel::Scratch* scratch, Estimate* estimate);
  void JudgeHealth(Estimate* estimate);
  bool warming_up() const { return state_.window.size() < window_size_; }

  JointModel joint_;
  bool case_one_ = false;
  bool next_input_ = false;  // f takes the input of the sample it leads to
  int32_t input_size_ = 0, output_size_ = 0;
  int32_t model_size_ = 0, state_size_ = 0;  // of the model, and of what is followed
  size_t window_size_ = 0;  // values in a full window
  data::Normaliser normaliser_;
  std::optional<physics::Polyhedron> set_;             // of what is estimated, in physical units
  std::optional<physics::Polyhedron> normalised_set_;  // of the state
  Eigen::MatrixXd process_factor_;    // Q^½, normalised
  Eigen::MatrixXd measurement_cov_, measurement_factor_;  // R and R^½, normalised
  Eigen::VectorXd initial_mean_;      // normalised
  Eigen::MatrixXd initial_factor_;
  std::vector<double> gate_limits_;   // on the NIS of 1 … n_y components; empty: no gate
  int64_t recover_after_ = 0;
  bool restart_after_divergence_ = true;
  Projection projection_ = Projection::kQuadraticProgram;

  FilterState state_;
  StepTrace* trace_ = nullptr;
  // Scratch of a step, sized once.
  bool passes_time_ = false;
  std::optional<Eigen::MatrixXd> sample_cov_;  // R of the sample, normalised, where it brings one
  Eigen::VectorXd u_, y_, value_, latent_, h_, whitened_;
  std::vector<Eigen::Index> measured_;  // components of y, those that are
  Eigen::Index updated_ = 0;            // components in the last UpdateFactor
  Eigen::MatrixXd F_, H_, H_rows_, time_work_, update_work_, output_factor_, prior_factor_;
};

}  // namespace metaekf::filter
