#pragma once

#include <optional>
#include <vector>

#include "core/autodiff/program.h"

namespace metaekf::autodiff {

/// A graph that computes the same, and its outputs.
struct MergedGraph {
  Graph graph;
  std::vector<Output> outputs;
};

/// Products of few columns that share their first factor, A B and A C, become one, A [B C], where neither waits for the other: of a layer
/// met by one sample and its tangents the weights are then read once, and reading them is what takes the time. Every element of the
/// result is the same sum as before.
///
/// @return nothing where there is nothing to merge, or a recurrence.
std::optional<MergedGraph> MergeProducts(const Graph& graph, const std::vector<Output>& outputs);

}  // namespace metaekf::autodiff
