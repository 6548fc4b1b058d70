#pragma once

#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"
#include "metaekf/v1/data.pb.h"
#include "server/convert/channels.h"

namespace metaekf::server {

/// What a call takes as samples.
struct SampleRules {
  ChannelCounts channels;
  /// Outputs and states may be absent or NaN: they were not measured.
  bool missing_measurements = false;
  double sample_period_s = 0;  ///< the model's, which that of the samples must be; 0: any
  int64_t max_samples = 0;     ///< over all trajectories
};

/// Checks the Samples messages of one call, one after the other; keeps lengths, not values.
class SampleChecker {
 public:
  struct Recording {
    std::string name;
    int64_t samples = 0;
    double start_s = 0;
    double sample_period_s = 0;
  };

  explicit SampleChecker(const SampleRules& rules) : rules_(rules) {}

  /// Errors: InvalidArgument with a violation below `samples` that names trajectory and sample:
  /// wrong sizes, infinity, NaN where the rules do not take it, another period than the model's, a
  /// trajectory that goes on after another has begun; ResourceExhausted beyond max_samples.
  absl::Status Add(const v1::Samples& samples);

  /// The trajectories so far, the last perhaps still growing.
  const std::vector<Recording>& recordings() const { return recordings_; }
  const SampleRules& rules() const { return rules_; }

 private:
  absl::Status Begin(const v1::Samples& samples);
  absl::Status CheckMatrix(const std::string& signal, int32_t width, bool is_measurement,
                           const google::protobuf::RepeatedField<double>& values,
                           uint32_t rows) const;

  SampleRules rules_;
  std::vector<Recording> recordings_;
  std::set<std::string> names_;
  int64_t total_samples_ = 0;
};

/// Puts trajectories together from Samples messages.
class TrajectoryAssembler {
 public:
  explicit TrajectoryAssembler(const SampleRules& rules) : checker_(rules) {}

  /// Adds a message. Returns the trajectory before it, if this message starts a new one.
  /// Errors: as SampleChecker::Add.
  absl::StatusOr<std::optional<data::Trajectory>> Add(const v1::Samples& samples);
  /// The last trajectory; nothing if there was none.
  std::optional<data::Trajectory> Finish();

  /// What the samples of a message take here while they are put together.
  int64_t BytesOf(const v1::Samples& samples) const;

  const SampleChecker& checker() const { return checker_; }

 private:
  SampleChecker checker_;
  std::vector<double> inputs_, outputs_, states_;  // of the last recording, sample by sample
};

}  // namespace metaekf::server
