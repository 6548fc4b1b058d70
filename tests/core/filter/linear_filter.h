#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <memory>

#include "core/base/rng.h"
#include "core/data/trajectory.h"
#include "core/filter/ekf.h"
#include "core/nssm/bundle.h"

namespace metaekf::filter {

Eigen::VectorXd RandomVector(base::Rng* rng, Eigen::Index n);

/// A linear Case II model x⁺ = A x + B u, y = C x in the parameters of a network without hidden layers.
struct LinearSystem {
  Eigen::MatrixXd A{{0.9, 0.2}, {-0.1, 0.95}}, B{{0.1}, {0.5}}, C{{1, 0}, {0.3, 1}};
  Eigen::MatrixXd Q{{0.02, 0.005}, {0.005, 0.01}}, R{{0.3, 0.1}, {0.1, 0.2}}, P0{{2, 0.3}, {0.3, 1}};
};

nssm::Bundle LinearBundle(const LinearSystem& system);

struct Filter {
  explicit Filter(const nssm::Bundle& bundle, const FilterOptions& options = {});
  std::shared_ptr<FilterModel> model;
  std::unique_ptr<FilterModel::Scratch> scratch;
  Ekf ekf;
  Estimate estimate;
};

/// What the system's true state and measurements do next, with the noise that it says.
struct LinearTruth {
  LinearTruth(const LinearSystem& linear, uint64_t seed);
  void Advance(double u);
  Eigen::VectorXd Measure();

  LinearSystem system;
  base::Rng rng;
  Eigen::VectorXd state;
};

/// A linear system whose f and h err in ways that last.
struct ErringSystem {
  LinearSystem system;
  nssm::GaussMarkov of_f{Eigen::MatrixXd{{0.2}, {0.1}}, 0.95}, of_h{Eigen::MatrixXd{{0.8, 0}, {0.2, 0.5}}, 0.9};

  nssm::Bundle Known() const;
  /// As it happens, states and measurements with the errors in them.
  data::Trajectory Record(uint64_t seed, Eigen::Index steps) const;
};

}  // namespace metaekf::filter
