#pragma once

#include <Eigen/Core>

#include "core/sim/system.h"

namespace metaekf::sim {

/// A sphere around the origin with uniform magnetization (m_X, m_Y) A/m and radius r₀.
struct MagnetizedSphere {
  Eigen::Vector2d magnetization;
  double radius_m = 0;

  /// The field in the plane through its centre, A/m:
  ///
  ///   −𝓜/3                                   inside
  ///   (r₀³/3)(−𝓜/r³ + 3 (𝓜ᵀp) p/r⁵)           outside, a dipole
  ///
  /// The paper's eq. h_theta has +𝓜/r³, which is not curl-free.
  Eigen::Vector2d FieldAt(const Eigen::Vector2d& position_m) const;
};

/// A car as one track: axles at distances l_f and l_r from the point whose position is followed.
struct SingleTrack {
  double l_f_m = 0, l_r_m = 0;

  /// (p_X, p_Y, ψ) after a duration with the inputs (δ rad, ω_f, ω_r rad/s) held: the arc that solves
  ///
  ///   ṗ = v_X (cos(ψ + β), sin(ψ + β))/cos β,  ψ̇ = v_X tan δ/L,   β = atan(l_r tan δ/L),  v_X = (ω_f + ω_r) R_w/2.
  ///
  /// Source: paper.tex eq. KinematicEquations.
  Eigen::Vector3d Move(const Eigen::Vector3d& state, const Eigen::Vector3d& input, double duration_s) const;
};

/// Radius of the wheels, R_w.
inline constexpr double kWheelRadiusM = 0.05;

/// Where all vehicles are to go: an ellipse around the sphere, counter-clockwise from (6, 0) m; it is 6 m by 5 m, outside every
/// sphere of the family, in fields of 0.01 to 0.6 A/m. `parameter` is its angle; bends are at least 4.2 m wide.
Eigen::Vector2d ReferencePath(double parameter);

/// a − b as an angle in (−π, π].
double AngleBetween(double a, double b);

/// Vehicles in the fields of magnetized spheres; state (p_X, p_Y, ψ), input (δ, ω_f, ω_r), output the field where the vehicle is.
///
/// Pure pursuit from the rear axle follows the path at the speed of 0.4 m/s² lateral acceleration (1.3 to 1.7 m/s); process noise
/// (slip) acts on the state, sensor noise on the output. Headings are not wrapped: they grow with every turn.
const System& MagneticLocalization();

}  // namespace metaekf::sim
