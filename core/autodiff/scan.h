#pragma once

#include <vector>

#include "core/autodiff/graph.h"

namespace metaekf::autodiff {

/// A recurrence as a model writes it, before it is split.
///
/// The body's inputs are told apart by their slots only; any numbers do, each used once. Body values are
/// columnwise: apart from sums over columns that leave by `ScanResult::Sum`, no operation mixes columns.
struct Recurrence {
  Graph body;
  struct Binding {
    Value body_input;
    Value outer;  ///< initial value of a carry; T blocks of a sequence; a constant
  };
  std::vector<Binding> carries;
  std::vector<Binding> sequences;
  std::vector<Binding> constants;
  std::vector<Value> carry_out;  ///< one per carry
  int32_t length = 0;
  bool reverse = false;

  /// Set where this body extends that of another scan of the same graph: its first `primal_size` values are
  /// those of `primal_scan`, which has computed them already (its carries are sequences here).
  Value primal_scan = kNoValue;
  Value primal_size = 0;
};

/// The values of a recurrence in the outer graph.
///
/// Body values fall into three parts. What does not depend on a carry is computed before the loop for all steps at
/// once; what no carry depends on, after it; only the rest, the dependency chain, is the body of the scan.
class ScanResult {
 public:
  ScanResult(Graph* outer, Recurrence recurrence);

  /// The body value at every step, side by side: n × (T·w), n × w if it is the same at every step.
  Value Outer(Value body_value);
  /// As Outer, repeated for every step where it is the same at all.
  Value AtEveryStep(Value body_value);
  /// The sum over the steps.
  Value Sum(Value body_value);
  /// Carry `index` after the last step.
  Value Final(int32_t index);

 private:
  bool IsInvariant(Value v) const { return invariant_[static_cast<size_t>(v)]; }
  void Classify();
  void BuildLoop();
  Value Translate(const Node& node);

  Graph* outer_;
  Recurrence rec_;
  std::vector<bool> invariant_;  // the same at every step
  std::vector<bool> in_loop_;    // depends on a carry, and a carry depends on it
  std::vector<Value> reduced_;   // body value → value of the loop's body
  std::vector<Value> outer_of_;  // memo of Outer
  Value scan_ = kNoValue;
};

}  // namespace metaekf::autodiff
