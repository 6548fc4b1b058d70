#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

namespace metaekf::data {

/// One recording of one system, evenly sampled, in the user's physical units.
///
/// Column t of each matrix belongs to time start_s + t · sample_period_s. A signal that the recording
/// does not have is a matrix with no rows and `length()` columns. NaN marks an output that was not measured.
struct Trajectory {
  std::string name;            ///< as the file names it; "0", "1", … where it does not
  double start_s = 0;          ///< time of the first sample
  double sample_period_s = 0;  ///< 0: the recording does not say, the model's period is meant
  Eigen::MatrixXd inputs;      ///< u, n_u × T
  Eigen::MatrixXd outputs;     ///< y, n_y × T
  Eigen::MatrixXd states;      ///< x, n_x × T

  Eigen::Index length() const { return outputs.cols(); }
};

/// Recordings with the same channels: a fleet has one trajectory per system.
struct Dataset {
  std::vector<std::string> input_names;   ///< as in the file's header, e.g. "u1"
  std::vector<std::string> output_names;
  std::vector<std::string> state_names;
  std::vector<Trajectory> trajectories;
};

}  // namespace metaekf::data
