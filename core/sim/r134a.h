#pragma once

#include <Eigen/Core>

namespace metaekf::sim {

/// Thermodynamics of the refrigerant R134a (1,1,1,2-tetrafluoroethane), from its fundamental equation: the Helmholtz energy
/// a(T, ρ)/(R T) = α⁰(δ, τ) + αʳ(δ, τ), δ = ρ/508 kg/m³, τ = 374.18 K/T.
///
/// Valid from 169.85 K to 455 K and up to 70 MPa. h = 200 kJ/kg and s = 1 kJ/(kg K) of saturated liquid at 0 °C.
/// Source: R. Tillner-Roth, H. D. Baehr, "An International Standard Formulation for the Thermodynamic Properties of
/// 1,1,1,2-Tetrafluoroethane (HFC-134a)", J. Phys. Chem. Ref. Data 23 (1994) 657.
namespace r134a {

/// A state of one phase, with what Newton's method and flows need of it. SI units.
struct SinglePhase {
  double pressure_Pa, enthalpy_J_per_kg, entropy_J_per_kgK;
  double dp_drho, dp_dT;  ///< at constant T, at constant ρ
  double dh_drho, dh_dT;
};

/// The equation itself, at a temperature and a density.
SinglePhase AtTemperature(double temperature_K, double density_kg_per_m3);

/// Liquid and vapour in equilibrium.
struct Saturation {
  double pressure_Pa, temperature_K;
  double liquid_density, vapour_density;    // kg/m³
  double liquid_enthalpy, vapour_enthalpy;  // J/kg
};

/// Where both phases have the same pressure and Gibbs energy, by Newton's method; from 169.85 K to 370 K.
Saturation SaturationAt(double temperature_K);

/// The range of pressures that AtEnthalpy knows: saturation from 200 K to 368 K.
double MinPressure();
double MaxPressure();

/// A state of liquid, vapour or both, at a pressure and a specific enthalpy.
struct Fluid {
  double density, temperature;  ///< kg/m³, K
  double quality;               ///< (h − h')/(h" − h'): below 0 liquid, above 1 vapour
  double drho_dp, drho_dh, dT_dp, dT_dh;
};

/// ρ and T at (p, h) with their derivatives.
///
/// Between the phases by the lever rule on the saturation curve, which is tabulated every 1 % of pressure with exact slopes and
/// interpolated by cubics to a few 1e-9; in one phase by Newton's method on the equation itself.
/// @return NaN where the pressure is outside [MinPressure, MaxPressure], or the temperature outside [180 K, 455 K].
Fluid AtEnthalpy(double pressure_Pa, double enthalpy_J_per_kg);

}  // namespace r134a
}  // namespace metaekf::sim
