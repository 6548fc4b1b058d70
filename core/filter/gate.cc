#include "core/filter/gate.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <numeric>

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

double SquaredLength(const VectorXd& innovation, const MatrixXd& cov) {
  return innovation.dot(cov.llt().solve(innovation));
}

}  // namespace

std::vector<Index> Outliers(const VectorXd& innovation, const MatrixXd& innovation_cov, const std::vector<double>& limits) {
  std::vector<Index> left(static_cast<size_t>(innovation.size())), out;
  std::iota(left.begin(), left.end(), 0);
  const auto size_of = [&](Index i) { return innovation[i] * innovation[i] / innovation_cov(i, i); };
  // Not "greater": what cannot be computed does not pass.
  while (!left.empty() && !(SquaredLength(innovation(left), innovation_cov(left, left)) <= limits[left.size() - 1])) {
    const auto worst = std::max_element(left.begin(), left.end(), [&](Index a, Index b) { return size_of(a) < size_of(b); });
    out.push_back(*worst);
    left.erase(worst);
  }
  std::sort(out.begin(), out.end());
  return out;
}

double WideningFor(const VectorXd& innovation, const MatrixXd& predicted_cov, const MatrixXd& measurement_cov) {
  constexpr double kLargest = 1e12;
  const double expected = static_cast<double>(innovation.size());
  const auto nis = [&](double widening) { return SquaredLength(innovation, widening * predicted_cov + measurement_cov); };
  if (nis(1) <= expected) return 1;
  double low = 0, high = std::log(kLargest);  // of ln λ
  while (high - low > 1e-6) {
    const double middle = (low + high) / 2;
    (nis(std::exp(middle)) > expected ? low : high) = middle;
  }
  return std::exp(high);
}

}  // namespace metaekf::filter
