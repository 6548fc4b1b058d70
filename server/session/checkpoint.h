#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/filter/replay.h"

namespace metaekf::server {

/// All of a session that changes.
struct Checkpoint {
  uint64_t seq = 0;   ///< the last sample applied
  double time_s = 0;  ///< of the newest sample
  filter::FilterState state;            ///< before `samples`
  std::vector<filter::Sample> samples;  ///< that a late measurement may still go back to
};

/// As bytes of this machine's order, with version and checksum.
std::string Encode(const Checkpoint& checkpoint);

/// @param state  of the session's filter, for the sizes. @param n_y  outputs.
/// Errors: DataLoss if the bytes are damaged; FailedPrecondition if another version of the server has written them.
absl::StatusOr<Checkpoint> DecodeCheckpoint(const std::string& bytes, const filter::FilterState& state, Eigen::Index n_y);

}  // namespace metaekf::server
