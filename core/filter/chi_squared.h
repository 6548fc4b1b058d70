#pragma once

namespace metaekf::filter {

/// P(χ²_ν > x): the probability that the squared length of ν independent standard normal deviates exceeds x.
///
///   ν even  e^(−x/2) Σ_{k < ν/2} (x/2)^k/k!
///   ν odd   erfc √(x/2) + e^(−x/2) Σ_{1 ≤ k ≤ (ν−1)/2} (x/2)^(k−½)/Γ(k + ½)
///
/// @param dof  ν ≥ 1; above 100, and where it is not whole, by the approximation of Wilson and Hilferty.
double ChiSquaredTail(double x, double dof);

/// x with P(χ²_ν > x) = tail, 0 < tail < 1, to 10⁻¹⁰ relative.
double ChiSquaredQuantile(double tail, double dof);

}  // namespace metaekf::filter
