#pragma once

#include <Eigen/Core>
#include <memory>
#include <span>

#include "core/filter/filter_model.h"

namespace metaekf::filter {

/// What a filter follows: the model's state, what is not known of its parameters, and errors of its functions that last,
///
///   s = [x; z; c_f; c_h]
///   f(s, u) = [f(x, u; ω̂ + V z) + W_f c_f;  z;  φ_f c_f;  φ_h c_h]      h(s, u) = h(x, u; ω̂ + V z) + W_h c_h
///
/// with process noise of covariance diag(Q, 0, (1 − φ_f²) I, (1 − φ_h²) I). c begins as N(0, I), where the noise keeps it, and z as
/// N(0, σ² I) (FilterNoise::parameter_std).
/// Normalised units. Immutable; functions do not allocate.
class JointModel {
 public:
  JointModel() = default;
  /// @param process_bias, measurement_bias  in normalised units.
  JointModel(std::shared_ptr<const FilterModel> model, std::shared_ptr<const FilterModel::Parameters> parameters,
             nssm::GaussMarkov process_bias, nssm::GaussMarkov measurement_bias);

  /// Of s, of x, and of what is beside x.
  Eigen::Index size() const { return bias_begin_ + process_bias_.loadings.cols() + measurement_bias_.loadings.cols(); }
  Eigen::Index state_size() const { return state_size_; }
  Eigen::Index extra_size() const { return size() - state_size_; }

  /// Deviations of z and c at the beginning.
  Eigen::VectorXd ExtraDeviations(double parameter_std) const;
  /// Deviations of the process noise of z and c.
  Eigen::VectorXd ExtraNoise() const;

  /// One filter's evaluation of a function.
  struct Point {
    const JointModel* joint;
    const Eigen::VectorXd* s;
    const Eigen::VectorXd* u;
    Eigen::VectorXd* value;
    Eigen::MatrixXd* jacobian;
  };
  /// Transition and Measurement of several filters on one FilterModel (FilterModel::Point).
  static void Transition(std::span<const Point> points, FilterModel::Scratch* scratch);
  static void Measurement(std::span<const Point> points, FilterModel::Scratch* scratch);

  /// f and F = ∂f/∂s at (s, u). @param F  size() × size().
  void Transition(const Eigen::Ref<const Eigen::VectorXd>& s, const Eigen::Ref<const Eigen::VectorXd>& u, Eigen::VectorXd* f, Eigen::MatrixXd* F,
                  FilterModel::Scratch* scratch) const;
  /// h and H = ∂h/∂s at (s, u). @param H  n_y × size().
  void Measurement(const Eigen::Ref<const Eigen::VectorXd>& s, const Eigen::Ref<const Eigen::VectorXd>& u, Eigen::VectorXd* h, Eigen::MatrixXd* H,
                   FilterModel::Scratch* scratch) const;
  /// Case II: s with the autoencoder's x̄ of x, and its Jacobian.
  void Reconstruct(const Eigen::Ref<const Eigen::VectorXd>& s, const Eigen::Ref<const Eigen::VectorXd>& u, Eigen::VectorXd* reconstruction,
                   Eigen::MatrixXd* J, FilterModel::Scratch* scratch) const;
  /// Case I: ψ of a window.
  void Encode(const Eigen::Ref<const Eigen::VectorXd>& window, Eigen::VectorXd* latent, FilterModel::Scratch* scratch) const;

 private:
  using Together = void (FilterModel::*)(std::span<const FilterModel::Point>, FilterModel::Scratch*) const;
  static void Evaluate(Together function, std::span<const Point> points, FilterModel::Scratch* scratch);
  /// What the model has said of x, with the rest.
  void CompleteTransition(const Eigen::Ref<const Eigen::VectorXd>& s, Eigen::VectorXd* f, Eigen::MatrixXd* F) const;
  void CompleteMeasurement(const Eigen::Ref<const Eigen::VectorXd>& s, Eigen::VectorXd* h, Eigen::MatrixXd* H) const;
  /// What is beside x stays as it is.
  void Keep(const Eigen::Ref<const Eigen::VectorXd>& s, Eigen::VectorXd* value, Eigen::MatrixXd* jacobian) const;

  std::shared_ptr<const FilterModel> model_;
  std::shared_ptr<const FilterModel::Parameters> parameters_;
  nssm::GaussMarkov process_bias_, measurement_bias_;
  Eigen::Index state_size_ = 0, bias_begin_ = 0;  // of x, and of x and z
};

}  // namespace metaekf::filter
