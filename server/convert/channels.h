#pragma once

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "core/nssm/bundle.h"
#include "metaekf/v1/data.pb.h"

namespace metaekf::server {

/// Widths of the matrices in Samples.
struct ChannelCounts {
  int32_t inputs = 0;
  int32_t outputs = 0;
  int32_t states = 0;
};

ChannelCounts CountChannels(const v1::Channels& channels);

v1::Channels ToMessage(const nssm::ChannelNames& names);

/// Checks that every channel has a name of its own and that there is an output.
/// Errors: InvalidArgument with all violations below `field`.
absl::Status CheckNewChannels(const std::string& field, const v1::Channels& channels);

/// What samples that are used with a model consist of. No channels: all of the model's, in its
/// order. Channels: those, which must be the model's; states that a Case I model does not know may
/// come along.
/// Errors: InvalidArgument with a violation below `field` naming the channel that is missing.
absl::StatusOr<ChannelCounts> MatchChannels(const std::string& field, const v1::Channels& channels,
                                            const nssm::Bundle& bundle);

}  // namespace metaekf::server
