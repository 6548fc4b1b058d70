#pragma once

#include <vector>

#include "core/autodiff/program.h"

namespace metaekf::autodiff {

/// Values that one program computes anyway and that are worth keeping for a later one: those that the later one would have to compute
/// again and that are dear, results of products and of recurrences. Elementwise operations follow from them and are done again, as are
/// products whose sums have a few terms.
///
/// A gradient that keeps its activations and cotangents so takes a third from the Hessian–vector products at its point: of each layer
/// z = W h they need ż = Ẇ h + W ḣ, and likewise of its two products backwards, six products instead of eight.
///
/// @param earlier, later  outputs of the two programs.
/// @param slot  of the values kept, one after the other. @return  outputs for the earlier program; for the later one each is an input
/// (Graph::TurnIntoInput).
std::vector<Output> ValuesToKeep(const Graph& graph, const std::vector<Output>& earlier, const std::vector<Output>& later, int32_t slot);

/// Values behind products that follow from one input slot and constants alone, the last before others join them: computed once, they serve
/// many runs in which the slot holds the same. The derivative of an affine layer by its input is one, for which a slot of weights suffices.
///
/// @param outputs  of the program that is run often. @param from  the slot. @param slot, return  as those of ValuesToKeep.
std::vector<Output> ValuesFromSlot(const Graph& graph, const std::vector<Output>& outputs, int32_t from, int32_t slot);

/// Elements that they take.
int64_t SizeOfKept(const Graph& graph, const std::vector<Output>& kept);

}  // namespace metaekf::autodiff
