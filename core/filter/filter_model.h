#pragma once

#include <Eigen/Core>
#include <memory>
#include <span>
#include <vector>

#include "core/nssm/bundle.h"

namespace metaekf::filter {

/// The model functions of an EKF with their Jacobians, in normalised units.
///
///   Case II   f(x, u) = 𝓟x𝓓x𝓐𝓔(x, u)    h(x, u) = 𝓟y𝓓y𝓔(x, u)      state x
///   Case I    f(ψ, u) = 𝓐(ψ, u)          h(ψ) = 𝓟𝓓y(ψ)              state ψ, started by 𝓔(window)
///
/// Where parameters come with directions V in which they are not known, ω = ω̂ + V z, the state may be joined by z: f([x; z], u) =
/// f(x, u; ω̂ + V z), and so on, with the derivatives by z behind those by x. A state without z has the parameters ω̂.
///
/// Compiled once per architecture; parameters are arguments, so one FilterModel serves every adaptation of a
/// model. Immutable and safe to share; each thread brings a Scratch. No function allocates.
/// Source: paper.tex eqs. deep_cekf_all, jac_defs, vcc_model_for_ekf.
class FilterModel {
 public:
  /// Parameters in the precision that the programs run in.
  class Parameters {
   public:
    virtual ~Parameters() = default;
    /// r, columns of V.
    Eigen::Index directions() const { return directions_; }

   protected:
    Eigen::Index directions_ = 0;
  };
  /// Memory that one thread works in.
  class Scratch {
   public:
    virtual ~Scratch() = default;
  };

  /// One filter's evaluation of a function: of Transition, for example, value and jacobian are f and F.
  struct Point {
    const Parameters* parameters;
    Eigen::Map<const Eigen::VectorXd> x;  ///< n, or n + r with z behind it
    Eigen::Map<const Eigen::VectorXd> u;
    Eigen::VectorXd* value;     ///< receives n rows, or of Measurement n_y; overlaps neither x nor u
    Eigen::MatrixXd* jacobian;  ///< ∂/∂x, receives so many rows and as many columns as x has; both may be larger
  };

  /// Takes the architecture, and where the start is fitted the prior; not the parameters.
  static std::unique_ptr<FilterModel> Create(const nssm::Bundle& bundle);
  virtual ~FilterModel() = default;

  /// @param directions  V, n_ω × r.
  /// @param base  others of this model that these are adapted from, or null: weights that are the same are kept once, and points that have
  ///   them are evaluated with one reading of them.
  virtual std::unique_ptr<Parameters> Prepare(const std::vector<double>& parameters, const Eigen::MatrixXd& directions,
                                              const Parameters* base = nullptr) const = 0;
  std::unique_ptr<Parameters> Prepare(const std::vector<double>& parameters) const { return Prepare(parameters, Eigen::MatrixXd()); }
  /// The bundle's parameters and what its posterior leaves open of them (UnknownDirections).
  std::unique_ptr<Parameters> Prepare(const nssm::Bundle& bundle, const Parameters* base = nullptr) const;
  virtual std::unique_ptr<Scratch> MakeScratch() const = 0;

  /// f and F = ∂f/∂x at (x, u) of every point. What comes out of one does not depend on the others.
  virtual void Transition(std::span<const Point> points, Scratch* scratch) const = 0;
  /// h and H = ∂h/∂x at (x, u) of every point.
  virtual void Measurement(std::span<const Point> points, Scratch* scratch) const = 0;
  /// At one point.
  void Transition(const Parameters& parameters, const Eigen::Ref<const Eigen::VectorXd>& x, const Eigen::Ref<const Eigen::VectorXd>& u,
                  Eigen::VectorXd* f, Eigen::MatrixXd* F, Scratch* scratch) const;
  void Measurement(const Parameters& parameters, const Eigen::Ref<const Eigen::VectorXd>& x, const Eigen::Ref<const Eigen::VectorXd>& u,
                   Eigen::VectorXd* h, Eigen::MatrixXd* H, Scratch* scratch) const;
  /// Case II: the autoencoder's x̄ = 𝓟x𝓓x𝓔(x, u) and ∂x̄/∂x. Sizes as those of Transition.
  virtual void Reconstruct(const Parameters& parameters, const Eigen::Ref<const Eigen::VectorXd>& x, const Eigen::Ref<const Eigen::VectorXd>& u,
                           Eigen::VectorXd* reconstruction, Eigen::MatrixXd* J, Scratch* scratch) const = 0;
  /// Case I: ψ = 𝓔(window), samples oldest first, each [u; y]; StartFit where the start is fitted.
  virtual void Encode(const Parameters& parameters, const Eigen::Ref<const Eigen::VectorXd>& window, Eigen::VectorXd* latent,
                      Scratch* scratch) const = 0;

  /// Covariance of the latent that the last Encode with this scratch gave; only where the start is fitted.
  virtual Eigen::MatrixXd EncodedCovariance(const Scratch& scratch) const = 0;

  int32_t state_size() const { return state_size_; }
  /// Whether weights are so many that points gain by being evaluated together.
  virtual bool is_large() const = 0;

 protected:
  int32_t state_size_ = 0;
};

}  // namespace metaekf::filter
