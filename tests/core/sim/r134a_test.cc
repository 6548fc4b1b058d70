#include "core/sim/r134a.h"

#include <gtest/gtest.h>

#include <cmath>

namespace metaekf::sim::r134a {
namespace {

TEST(R134aTest, AgreesWithTheSaturationTable) {
  // ASHRAE Handbook — Fundamentals, "Refrigerant 134a Properties of Saturated Liquid and Saturated Vapor":
  // °C, MPa, kg/m³, m³/kg, kJ/kg, kJ/kg; equal within the last digit printed.
  struct Row {
    double celsius, pressure, liquid_density, vapour_volume, liquid_enthalpy, vapour_enthalpy;
  };
  for (const Row& row : {Row{-40, 0.05121, 1417.7, 0.36108, 148.14, 374.00}, Row{-20, 0.13273, 1358.3, 0.14739, 173.64, 386.55},
                         Row{0, 0.29280, 1294.8, 0.06931, 200.00, 398.60}, Row{20, 0.57171, 1225.3, 0.03600, 227.47, 409.75},
                         Row{40, 1.0166, 1146.7, 0.01997, 256.41, 419.43}}) {
    const Saturation s = SaturationAt(row.celsius + 273.15);
    EXPECT_NEAR(s.pressure_Pa / 1e6 / row.pressure, 1, 1e-4) << row.celsius;
    EXPECT_NEAR(s.liquid_density, row.liquid_density, 0.06) << row.celsius;
    EXPECT_NEAR(1 / s.vapour_density, row.vapour_volume, 6e-6) << row.celsius;
    EXPECT_NEAR(s.liquid_enthalpy / 1e3, row.liquid_enthalpy, 0.006) << row.celsius;
    EXPECT_NEAR(s.vapour_enthalpy / 1e3, row.vapour_enthalpy, 0.006) << row.celsius;
  }
  // The reference state.
  EXPECT_NEAR(AtTemperature(273.15, SaturationAt(273.15).liquid_density).entropy_J_per_kgK, 1000, 0.01);
}

TEST(R134aTest, AgreesWithAnotherProgramInDenseFluid) {
  // CoolProp's anchor state of R134a: 411.598 K, 4480.9471539 mol/m³ at 0.102032 kg/mol; Pa, J/mol, J/(mol K).
  constexpr double kMolarMass = 0.102032;
  const SinglePhase state = AtTemperature(411.598, 4480.9471539000015 * kMolarMass);
  EXPECT_NEAR(state.pressure_Pa, 6858750.808053112, 1e-2);
  EXPECT_NEAR(state.enthalpy_J_per_kg * kMolarMass, 45468.086192270304, 1e-6);
  EXPECT_NEAR(state.entropy_J_per_kgK * kMolarMass, 172.44139866136513, 1e-9);
}

TEST(R134aTest, DerivativesAreThoseOfTheEquation) {
  for (const double temperature : {220.0, 300.0, 440.0}) {
    for (const double density : {0.5, 30.0, 900.0, 1400.0}) {
      const SinglePhase at = AtTemperature(temperature, density);
      const double dT = 1e-6 * temperature, drho = 1e-6 * density;
      const SinglePhase hot = AtTemperature(temperature + dT, density), cold = AtTemperature(temperature - dT, density);
      const SinglePhase more = AtTemperature(temperature, density + drho), less = AtTemperature(temperature, density - drho);
      const auto expect = [](double exact, double difference, double scale) {
        EXPECT_NEAR(exact, difference, 1e-6 * std::abs(exact) + 1e-6 * scale);
      };
      expect(at.dp_dT, (hot.pressure_Pa - cold.pressure_Pa) / (2 * dT), 81.5 * density);
      expect(at.dh_dT, (hot.enthalpy_J_per_kg - cold.enthalpy_J_per_kg) / (2 * dT), 1000);
      expect(at.dp_drho, (more.pressure_Pa - less.pressure_Pa) / (2 * drho), 81.5 * temperature);
      expect(at.dh_drho, (more.enthalpy_J_per_kg - less.enthalpy_J_per_kg) / (2 * drho), 81.5 * temperature / density);
      // An identity of all Helmholtz energies: (∂h/∂ρ)_T = ((∂p/∂ρ)_T − T (∂p/∂T)_ρ/ρ)/ρ.
      EXPECT_NEAR(at.dh_drho, (at.dp_drho - temperature * at.dp_dT / density) / density, 1e-9 * std::abs(at.dp_drho) / density + 1e-9);
    }
  }
}

TEST(R134aTest, StatesByEnthalpyAreSmoothAndTheirDerivativesExact) {
  int compared = 0;
  for (double pressure = 5e4; pressure < 3.5e6; pressure *= 1.17) {
    double last_density = 1e9, last_temperature = 0;
    for (double enthalpy = 140e3; enthalpy < 480e3; enthalpy += 4e3) {
      const Fluid at = AtEnthalpy(pressure, enthalpy);
      ASSERT_TRUE(std::isfinite(at.density)) << pressure << " " << enthalpy;
      EXPECT_LT(at.density, last_density) << "heating expands";
      EXPECT_GE(at.temperature, last_temperature - 1e-9) << "heating does not cool";
      last_density = at.density;
      last_temperature = at.temperature;
      const double dp = 1e-5 * pressure, dh = 0.3;
      const Fluid up = AtEnthalpy(pressure + dp, enthalpy), down = AtEnthalpy(pressure - dp, enthalpy);
      const Fluid more = AtEnthalpy(pressure, enthalpy + dh), less = AtEnthalpy(pressure, enthalpy - dh);
      const auto phase = [](const Fluid& fluid) { return fluid.quality < 0 ? -1 : fluid.quality > 1 ? 1 : 0; };
      if (phase(up) != phase(down) || phase(more) != phase(less)) continue;
      ++compared;
      EXPECT_NEAR(at.drho_dp * 2 * dp, up.density - down.density, 1e-6 * std::abs(at.drho_dp * 2 * dp) + 1e-9 * at.density);
      EXPECT_NEAR(at.drho_dh * 2 * dh, more.density - less.density, 1e-6 * std::abs(at.drho_dh * 2 * dh) + 1e-9 * at.density);
      EXPECT_NEAR(at.dT_dp * 2 * dp, up.temperature - down.temperature, 1e-6 * std::abs(at.dT_dp * 2 * dp) + 1e-9 * at.temperature);
      EXPECT_NEAR(at.dT_dh * 2 * dh, more.temperature - less.temperature, 1e-9 * at.temperature);
    }
  }
  EXPECT_GT(compared, 2000);
}

TEST(R134aTest, PhasesMeetAtTheirBoundary) {
  for (double temperature = 205; temperature < 367; temperature += 9) {
    const Saturation s = SaturationAt(temperature);
    for (const double side : {1 - 1e-11, 1 + 1e-11}) {
      EXPECT_NEAR(AtEnthalpy(s.pressure_Pa, s.liquid_enthalpy * side).density / s.liquid_density, 1, 2e-8);
      EXPECT_NEAR(AtEnthalpy(s.pressure_Pa, s.vapour_enthalpy * side).density / s.vapour_density, 1, 2e-8);
      EXPECT_NEAR(AtEnthalpy(s.pressure_Pa, s.vapour_enthalpy * side).temperature, temperature, 2e-6);
    }
  }
}

TEST(R134aTest, OutsideItsRangeThereIsNothing) {
  EXPECT_TRUE(std::isnan(AtEnthalpy(MaxPressure() * 1.01, 300e3).density));
  EXPECT_TRUE(std::isnan(AtEnthalpy(MinPressure() * 0.99, 300e3).density));
  EXPECT_TRUE(std::isnan(AtEnthalpy(1e5, 900e3).density));
  EXPECT_TRUE(std::isnan(AtEnthalpy(std::nan(""), 300e3).density));
  EXPECT_TRUE(std::isnan(AtEnthalpy(1e5, std::nan("")).density));
}

}  // namespace
}  // namespace metaekf::sim::r134a
