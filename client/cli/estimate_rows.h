#pragma once

#include <ostream>
#include <string>
#include <vector>

#include "metaekf/client.h"

namespace metaekf::cli {

/// Names of the columns: t, means, standard deviations, nis, health, flags; slack and projection
/// where states are constrained. Means are called as the states (Case II), or as the outputs with
/// _hat (Case I); deviations have an s before the name.
std::string EstimateHeader(const std::vector<client::Channel>& estimated, bool states,
                           bool constrained);

/// Row i of a batch with diagonal covariances, as CSV; what is NaN is empty.
std::string EstimateRow(const client::EstimateBatch& batch, size_t i);

/// "consistent"
const char* HealthWord(client::Health health);
/// "missing|gated"; "" for 0
std::string FlagWords(uint32_t flags);

}  // namespace metaekf::cli
