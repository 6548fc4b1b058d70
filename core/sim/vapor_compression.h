#pragma once

#include <Eigen/Core>

#include "core/sim/system.h"

namespace metaekf::sim {

/// Finite volumes along the refrigerant: 1 to 4 the condenser, 5 to 8 the evaporator.
inline constexpr int kVaporCompressionVolumes = 8;
inline constexpr double kVaporCompressionSamplePeriodS = 0.1;

/// What one run of the cycle goes through. States in the rows: pressures p₁…p₈ (Pa), specific enthalpies h₁…h₈ (J/kg), wall
/// temperatures T₁…T₈ (K).
struct VaporCompressionRun {
  Eigen::MatrixXd states;         ///< 24 × T; a run that leaves the range of R134a's equation ends in NaN
  Eigen::VectorXd mass_kg;        ///< of refrigerant, which no one adds or takes
  Eigen::VectorXd energy_J;       ///< of refrigerant and walls
  Eigen::VectorXd energy_in_J;    ///< work of the compressor and heat from the air since the first sample
};

/// A vapor-compression cycle with R134a: two heat exchangers of four volumes each, between them a compressor and an expansion valve.
///
///   V d(ρᵢ)/dt        = ṁᵢ₋₁ − ṁᵢ                              mass
///   V d(ρᵢhᵢ − pᵢ)/dt = ṁᵢ₋₁ hᵢ₋₁ − ṁᵢ hᵢ + α A (Tᵢ − θᵢ)       energy; θ the refrigerant's temperature
///   C dTᵢ/dt          = α A (θᵢ − Tᵢ) + ε ṁ_a c_a (T_a − Tᵢ)     wall, against air that passes it
///
/// Within a heat exchanger ṁ = k √(ρ Δp) of the friction (the momentum balance without inertia), through the valve
/// ṁ = c n √(ρ₄ (p₄ − p₅)) at n counts, enthalpy unchanged; the compressor takes ṁ = η_v V_d f ρ₈ at f Hz and adds the work of a
/// polytropic compression. What is transported has the state of the volume that it leaves. Both heat exchangers have the same length
/// of pipe, to which volumes, areas and walls are proportional.
///
/// Integrated by TR-BDF2 on the conserved quantities ρ, ρh − p and T, unknowns p, h and T: stiff pressures are damped, mass and
/// energy stay to the rounding of Newton's method, whatever the step. Steps are as short as the error estimate asks.
///
/// @param pipe_length_m  of each heat exchanger. @param inputs  2 × T: compressor frequency (Hz), valve (counts), each held for a
///   sample period. @param settle_s  time at 50 Hz and 300 counts before the first sample, from the same state for every length.
/// @param tolerance  relative, of each step. @param max_step_s  of the integrator.
/// Source: paper.tex section sub:num_VCS; the parts are textbook models with constants of a room air conditioner, ours.
VaporCompressionRun SimulateVaporCompression(double pipe_length_m, const Eigen::MatrixXd& inputs, double settle_s,
                                             double tolerance = 1e-7, double max_step_s = kVaporCompressionSamplePeriodS);

/// The family over pipe lengths: with one initial state for all of them, the length decides the mass of refrigerant.
///
/// y = (p₁, T₂, T₄, T₆, p₈, T₈) + noise. Frequency and valve are drawn uniformly anew every hold_s, or recorded.
const System& VaporCompression();

}  // namespace metaekf::sim
