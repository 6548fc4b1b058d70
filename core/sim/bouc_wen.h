#pragma once

#include <Eigen/Core>

#include "core/sim/signal.h"
#include "core/sim/system.h"

namespace metaekf::sim {

/// Mass on a spring, a damper and a hysteretic element.
struct BoucWenParameters {
  double m_L;    ///< mass, kg
  double c_L;    ///< damping, N s/m
  double k_L;    ///< stiffness, N/m
  double alpha;  ///< initial stiffness of the hysteretic element, N/m
  double beta;   ///< shape of the loop, 1/m
  double gamma;  ///< shape of the loop
  double delta;  ///< shape of the loop
};

/// Samples per second, of the input and of what is recorded.
inline constexpr double kBoucWenSampleRateHz = 750;

/// How finely the oscillator is integrated: in as many steps per sample as the input has segments,
/// each refined until its halves change it by no more than the tolerance (see RefineStep). Halving
/// steps and tolerance changes y by less than 1e-9 m everywhere in the parameter box.
inline constexpr int kBoucWenSegmentsPerSample = 4;
inline constexpr double kBoucWenToleranceM = 1e-11;

/// States of the Bouc–Wen oscillator, ν = 1, at 750 Hz:
///
///   ẋ₁ = x₂
///   ẋ₂ = (u − k_L x₁ − c_L x₂ − x₃) / m_L
///   ẋ₃ = α x₂ − β (γ |x₂| x₃ + δ x₂ |x₃|)
///
/// @param input    force u in N, from the start of the warm-up.
/// @param initial  x at the start of the warm-up.
/// @param warmup   samples simulated before the first recorded one.
/// @return x₁ (m), x₂ (m/s), x₃ (N) in the rows, `steps` columns. A run that diverges ends in NaN.
///
/// Source: paper.tex eq. boucwen_model.
Eigen::MatrixXd SimulateBoucWen(const BoucWenParameters& parameters, const Signal& input,
                                const Eigen::Vector3d& initial, Eigen::Index warmup,
                                Eigen::Index steps, double tolerance_m = kBoucWenToleranceM);

/// The family of these oscillators over the parameter box of the paper (tab:bw_params), y = x₁ +
/// noise.
///
/// The force is a random-phase multisine (one period unless the length is given), 120 sin 2πt
/// (10,000 samples), or recorded (its own length). By default one period of it is simulated before
/// recording, so that the steady response is seen. A mass that is not positive, a multisine without
/// lines in its band, and an option of an excitation that is not in use are refused.
const System& BoucWen();

}  // namespace metaekf::sim
