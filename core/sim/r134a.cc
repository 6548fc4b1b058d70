#include "core/sim/r134a.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

namespace metaekf::sim::r134a {
namespace {

constexpr double kGasConstant = 8.314471 / 0.102032;  // J/(kg K)
constexpr double kReducingTemperature = 374.18;       // K
constexpr double kReducingDensity = 508;              // kg/m³
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// α⁰ = ln δ + a₁ + a₂ τ + a₃ ln τ + a₄ τ^−½ + a₅ τ^−¾
constexpr double kIdealConstant = -1.019535, kIdealLinear = 9.047135, kIdealLogarithm = -1.629789;
constexpr double kIdealHalf = -9.723916, kIdealThreeQuarters = -3.927170;

/// One term of αʳ: n τ^(t/2) δ^d exp(−δ^l), without the exponential where l = 0.
struct Term {
  double n;
  int twice_t, d, l;
};

constexpr std::array<Term, 21> kTerms = {{
    {0.5586817e-1, -1, 2, 0},   {0.4982230, 0, 1, 0},       {0.2458698e-1, 0, 3, 0},    {0.8570145e-3, 0, 6, 0},
    {0.4788584e-3, 3, 6, 0},    {-1.800808, 3, 1, 0},       {0.2671641, 4, 1, 0},       {-0.4781652e-1, 4, 2, 0},
    {0.1423987e-1, 2, 5, 1},    {0.3324062, 6, 2, 1},       {-0.7485907e-2, 10, 2, 1},  {0.1017263e-3, 2, 4, 2},
    {-0.5184567, 10, 1, 2},     {-0.8692288e-1, 10, 4, 2},  {0.2057144, 12, 1, 2},      {-0.5000457e-2, 20, 2, 2},
    {0.4603262e-3, 20, 4, 2},   {-0.3497836e-2, 20, 1, 3},  {0.6995038e-2, 36, 5, 3},   {-0.1452184e-1, 44, 3, 3},
    {-0.1285458e-3, 100, 10, 4},
}};

double Power(double base, int exponent) {
  double result = 1;
  for (int left = std::abs(exponent); left > 0; left /= 2, base *= base) {
    if (left % 2 == 1) result *= base;
  }
  return exponent < 0 ? 1 / result : result;
}

/// αʳ and δ, τ times its derivatives: αʳ, δ αʳ_δ, δ² αʳ_δδ, τ αʳ_τ, τ² αʳ_ττ, δ τ αʳ_δτ.
struct Residual {
  double a = 0, d = 0, dd = 0, t = 0, tt = 0, dt = 0;
};

Residual ResidualAt(double delta, double tau) {
  const double root = std::sqrt(tau);
  std::array<double, 5> powers{};  // δ^l
  std::array<double, 5> decays{};  // exp(−δ^l)
  for (size_t l = 0; l < 5; ++l) {
    powers[l] = l == 0 ? 0 : Power(delta, static_cast<int>(l));
    decays[l] = l == 0 ? 1 : std::exp(-powers[l]);
  }
  Residual sum;
  for (const Term& term : kTerms) {
    const double value = term.n * Power(root, term.twice_t) * Power(delta, term.d) * decays[static_cast<size_t>(term.l)];
    const double l_power = term.l * powers[static_cast<size_t>(term.l)];
    const double first = term.d - l_power;  // δ ∂/∂δ of the logarithm
    const double second = first * (first - 1) - term.l * l_power;
    const double t = 0.5 * term.twice_t;
    sum.a += value;
    sum.d += value * first;
    sum.dd += value * second;
    sum.t += value * t;
    sum.tt += value * t * (t - 1);
    sum.dt += value * t * first;
  }
  return sum;
}

/// The saturation curve on an even grid of ln p: values and derivatives by ln p.
class SaturationTable {
 public:
  static constexpr double kMinTemperature = 200, kMaxTemperature = 368;

  SaturationTable() {
    const double low = std::log(SaturationAt(kMinTemperature).pressure_Pa);
    const double high = std::log(SaturationAt(kMaxTemperature).pressure_Pa);
    const auto intervals = static_cast<size_t>(std::ceil((high - low) / 0.01));
    first_ = low;
    step_ = (high - low) / static_cast<double>(intervals);
    double temperature = kMinTemperature;
    for (size_t i = 0; i <= intervals; ++i) {
      // Newton on ln p(T) by the slope of Clapeyron; the last node's temperature is a good start for the next.
      const double target = low + step_ * static_cast<double>(i);
      Node node;
      for (int iteration = 0; iteration < 20; ++iteration) {
        node = MakeNode(SaturationAt(temperature));
        const double miss = target - std::log(node.pressure);
        temperature += miss * node.slopes[0];
        if (std::abs(miss) < 1e-13) break;
      }
      nodes_.push_back(node);
    }
  }

  double min_pressure() const { return std::exp(first_); }
  double max_pressure() const { return std::exp(first_ + step_ * static_cast<double>(nodes_.size() - 1)); }

  /// Temperature and density of the saturated liquid of about this enthalpy, or of the coldest or hottest.
  std::pair<double, double> LiquidNear(double enthalpy) const {
    const auto above = std::lower_bound(nodes_.begin(), nodes_.end() - 1, enthalpy,
                                        [](const Node& node, double value) { return node.values[3] < value; });
    return {above->values[0], 1 / above->values[1]};
  }

  /// T, v', v", h', h" and their derivatives by p.
  struct Point {
    std::array<double, 5> values, slopes;
  };

  Point At(double pressure) const {
    const double position = (std::log(pressure) - first_) / step_;
    const size_t interval = std::min(static_cast<size_t>(std::max(position, 0.0)), nodes_.size() - 2);
    const double s = position - static_cast<double>(interval);
    const Node& a = nodes_[interval];
    const Node& b = nodes_[interval + 1];
    Point point;
    for (size_t k = 0; k < 5; ++k) {
      const double rise = b.values[k] - a.values[k];
      const double left = step_ * a.slopes[k] - rise, right = rise - step_ * b.slopes[k];
      // The cubic with these values and slopes: a + s rise + s (1 − s) (left (1 − s) + right s).
      point.values[k] = a.values[k] + s * rise + s * (1 - s) * (left * (1 - s) + right * s);
      const double by_s = rise + (1 - 2 * s) * (left * (1 - s) + right * s) + s * (1 - s) * (right - left);
      point.slopes[k] = by_s / (step_ * pressure);
    }
    return point;
  }

 private:
  struct Node {
    double pressure = 0;
    std::array<double, 5> values{}, slopes{};  // of T, v', v", h', h"; by ln p
  };

  static Node MakeNode(const Saturation& s) {
    const double liquid_volume = 1 / s.liquid_density, vapour_volume = 1 / s.vapour_density;
    const double dT_dp =
        s.temperature_K * (vapour_volume - liquid_volume) / (s.vapour_enthalpy - s.liquid_enthalpy);
    Node node{.pressure = s.pressure_Pa,
              .values = {s.temperature_K, liquid_volume, vapour_volume, s.liquid_enthalpy, s.vapour_enthalpy}};
    node.slopes[0] = s.pressure_Pa * dT_dp;
    for (const bool vapour : {false, true}) {
      const double density = vapour ? s.vapour_density : s.liquid_density;
      const SinglePhase phase = AtTemperature(s.temperature_K, density);
      const double drho_dp = (1 - phase.dp_dT * dT_dp) / phase.dp_drho;  // along the curve
      node.slopes[vapour ? 2 : 1] = -s.pressure_Pa * drho_dp / (density * density);
      node.slopes[vapour ? 4 : 3] = s.pressure_Pa * (phase.dh_drho * drho_dp + phase.dh_dT * dT_dp);
    }
    return node;
  }

  double first_ = 0, step_ = 0;
  std::vector<Node> nodes_;
};

const SaturationTable& Table() {
  static const SaturationTable table;
  return table;
}

/// One phase at (p, h), by Newton's method from a state nearby.
Fluid SolveSinglePhase(double pressure, double enthalpy, double temperature, double density) {
  for (int iteration = 0; iteration < 50; ++iteration) {
    const SinglePhase at = AtTemperature(temperature, density);
    const double determinant = at.dp_drho * at.dh_dT - at.dp_dT * at.dh_drho;
    const double p_miss = pressure - at.pressure_Pa, h_miss = enthalpy - at.enthalpy_J_per_kg;
    double density_step = (at.dh_dT * p_miss - at.dp_dT * h_miss) / determinant;
    const double temperature_step = (at.dp_drho * h_miss - at.dh_drho * p_miss) / determinant;
    if (density + density_step <= 0.5 * density) density_step = -0.5 * density;
    density += density_step;
    temperature += temperature_step;
    if (!(temperature > 150 && temperature < 700) || !std::isfinite(density)) break;
    if (std::abs(density_step) < 1e-12 * density && std::abs(temperature_step) < 1e-12 * temperature) {
      if (temperature < 180 || temperature > 455) break;
      return {.density = density,
              .temperature = temperature,
              .quality = 0,
              .drho_dp = at.dh_dT / determinant,
              .drho_dh = -at.dp_dT / determinant,
              .dT_dp = -at.dh_drho / determinant,
              .dT_dh = at.dp_drho / determinant};
    }
  }
  return {kNaN, kNaN, kNaN, kNaN, kNaN, kNaN, kNaN};
}

}  // namespace

SinglePhase AtTemperature(double temperature_K, double density_kg_per_m3) {
  const double tau = kReducingTemperature / temperature_K, delta = density_kg_per_m3 / kReducingDensity;
  const double half = 1 / std::sqrt(tau), three_quarters = half * std::sqrt(half);
  const double ideal_a = std::log(delta) + kIdealConstant + kIdealLinear * tau + kIdealLogarithm * std::log(tau) +
                         kIdealHalf * half + kIdealThreeQuarters * three_quarters;
  const double ideal_t =
      kIdealLinear * tau + kIdealLogarithm - 0.5 * kIdealHalf * half - 0.75 * kIdealThreeQuarters * three_quarters;
  const double ideal_tt =
      -kIdealLogarithm + 0.75 * kIdealHalf * half + 0.75 * 1.75 * kIdealThreeQuarters * three_quarters;
  const Residual r = ResidualAt(delta, tau);
  const double RT = kGasConstant * temperature_K;
  return {.pressure_Pa = density_kg_per_m3 * RT * (1 + r.d),
          .enthalpy_J_per_kg = RT * (1 + ideal_t + r.t + r.d),
          .entropy_J_per_kgK = kGasConstant * (ideal_t + r.t - ideal_a - r.a),
          .dp_drho = RT * (1 + 2 * r.d + r.dd),
          .dp_dT = density_kg_per_m3 * kGasConstant * (1 + r.d - r.dt),
          .dh_drho = RT / density_kg_per_m3 * (r.dt + r.d + r.dd),
          .dh_dT = kGasConstant * (1 + r.d - r.dt - ideal_tt - r.tt)};
}

Saturation SaturationAt(double temperature_K) {
  // A start within a few per cent: Antoine-like vapour pressure, the liquid by a root law.
  const double theta = 1 - temperature_K / 374.21;
  double liquid = 511.9 * (1 + 1.9 * std::cbrt(theta) + 0.55 * theta);
  double vapour = 4.0593e6 * std::exp(-7.1 * theta / (1 - theta)) / (kGasConstant * temperature_K);
  for (int iteration = 0; iteration < 60; ++iteration) {
    const SinglePhase l = AtTemperature(temperature_K, liquid), v = AtTemperature(temperature_K, vapour);
    const auto gibbs = [&](const SinglePhase& phase) {
      return phase.enthalpy_J_per_kg - temperature_K * phase.entropy_J_per_kgK;
    };
    // Equal pressures and Gibbs energies, dg = dp/ρ at constant temperature.
    const double p_miss = v.pressure_Pa - l.pressure_Pa, g_miss = gibbs(v) - gibbs(l);
    const double a = l.dp_drho, b = v.dp_drho;
    // a δl − b δv = p_miss; a δl/ρ' − b δv/ρ" = g_miss
    const double determinant = -a * b / vapour + a * b / liquid;
    double liquid_step = (-b / vapour * p_miss + b * g_miss) / determinant;
    double vapour_step = (a * g_miss - a / liquid * p_miss) / determinant;
    liquid_step = std::max(-0.1 * liquid, std::min(0.1 * liquid, liquid_step));
    vapour_step = std::max(-0.5 * vapour, std::min(0.5 * vapour, vapour_step));
    liquid += liquid_step;
    vapour += vapour_step;
    if (std::abs(liquid_step) < 1e-13 * liquid && std::abs(vapour_step) < 1e-12 * vapour) break;
  }
  const SinglePhase l = AtTemperature(temperature_K, liquid), v = AtTemperature(temperature_K, vapour);
  return {.pressure_Pa = v.pressure_Pa,
          .temperature_K = temperature_K,
          .liquid_density = liquid,
          .vapour_density = vapour,
          .liquid_enthalpy = l.enthalpy_J_per_kg,
          .vapour_enthalpy = v.enthalpy_J_per_kg};
}

double MinPressure() { return Table().min_pressure(); }
double MaxPressure() { return Table().max_pressure(); }

Fluid AtEnthalpy(double pressure_Pa, double enthalpy_J_per_kg) {
  const SaturationTable& table = Table();
  if (!(pressure_Pa >= table.min_pressure() && pressure_Pa <= table.max_pressure()) || !std::isfinite(enthalpy_J_per_kg)) {
    return {kNaN, kNaN, kNaN, kNaN, kNaN, kNaN, kNaN};
  }
  const SaturationTable::Point point = table.At(pressure_Pa);
  const auto [T, liquid_volume, vapour_volume, liquid_enthalpy, vapour_enthalpy] = point.values;
  const auto [dT, dv_liquid, dv_vapour, dh_liquid, dh_vapour] = point.slopes;
  const double latent = vapour_enthalpy - liquid_enthalpy;
  const double quality = (enthalpy_J_per_kg - liquid_enthalpy) / latent;
  if (quality < 0 || quality > 1) {
    // From where Newton's method is sure to find this phase: liquid hardly depends on pressure, vapour expands with temperature.
    constexpr double kVapourHeat = 1000;  // J/(kg K), about
    const double superheated = T + (enthalpy_J_per_kg - vapour_enthalpy) / kVapourHeat;
    const auto [start, density] = quality < 0 ? table.LiquidNear(enthalpy_J_per_kg)
                                              : std::pair(superheated, T / (superheated * vapour_volume));
    Fluid fluid = SolveSinglePhase(pressure_Pa, enthalpy_J_per_kg, start, density);
    fluid.quality = quality;
    return fluid;
  }
  const double volume = liquid_volume + quality * (vapour_volume - liquid_volume);
  const double dx_dp = (-dh_liquid - quality * (dh_vapour - dh_liquid)) / latent;
  const double dv_dp = dv_liquid + quality * (dv_vapour - dv_liquid) + dx_dp * (vapour_volume - liquid_volume);
  const double dv_dh = (vapour_volume - liquid_volume) / latent;
  return {.density = 1 / volume,
          .temperature = T,
          .quality = quality,
          .drho_dp = -dv_dp / (volume * volume),
          .drho_dh = -dv_dh / (volume * volume),
          .dT_dp = dT,
          .dT_dh = 0};
}

}  // namespace metaekf::sim::r134a
