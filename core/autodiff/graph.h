#pragma once

#include <cstdint>
#include <memory>
#include <unordered_map>
#include <vector>

#include "core/autodiff/activation.h"

namespace metaekf::autodiff {

/// A value in a graph: the index of the node that computes it.
using Value = int32_t;
inline constexpr Value kNoValue = -1;

enum class Op : uint8_t {
  kInput,       // bound when the program runs: slot, offset
  kConstant,    // every element is `scalar`, or the elements in `data`
  kMatMul,      // op(A) op(B); flags say which operand is transposed
  kAdd,         // A + B
  kSub,         // A − B
  kMul,         // A ⊙ B
  kScale,       // scalar · A
  kScaleBy,     // a · B, a being 1 × 1
  kDot,         // Σ A ⊙ B, 1 × 1
  kActivation,  // σ^(order)(A); swish has A's sigmoid for a second input, as a help
  kSoftmax,     // e^a / Σ e^a, column by column
  kTile,        // each block of `width` columns, `count` times in a row
  kSumTiles,    // the transpose of kTile: sums runs of `count` blocks
  kConcatRows,  // [A; B; …]
  kSliceRows,   // rows first … first + rows − 1 of A
  kPadRows,     // A as rows first … of a matrix of zeros
  kConcatCols,  // [A B …]; this and the next are what MergeProducts makes, and have no derivatives
  kSliceCols,   // columns first … first + cols − 1 of A
  kScan,        // a recurrence; see Scan. Its values are read by the two operations below
  kCollect,     // body value `index` of every step, side by side: n × (T·w)
  kFinalCarry,  // carry `index` after the last step
};

struct Node {
  Op op{};
  int32_t rows = 0;
  int32_t cols = 0;
  std::vector<Value> inputs;
  bool transpose_a = false;
  bool transpose_b = false;
  Activation activation{};
  int32_t order = 0;   // of an activation's derivative
  int32_t width = 0;   // of a tile
  int32_t count = 0;   // of tiles
  int32_t first = 0;   // row, or column, of a slice or pad
  int32_t slot = -1;   // of an input
  int64_t offset = 0;  // of an input, elements from the slot's start
  int32_t index = -1;  // of a collected body value or a final carry
  double scalar = 0;
  std::shared_ptr<const std::vector<double>> data;
  int32_t scan = -1;  // index into Graph::scans

  bool operator==(const Node& other) const;
};

class Graph;

/// c_{t+1} = body(c_t, s_t, k): a recurrence over `length` steps, t ascending, or descending if `reverse`.
///
/// The inputs of the kScan node are the initial carries, then what the sequences and the constants are bound to.
/// A sequence of T blocks of w columns is read one block a step.
struct Scan {
  std::shared_ptr<const Graph> body;  ///< only what the next carries need (see BuildScan)
  std::vector<Value> carry_in;        ///< body inputs
  std::vector<Value> sequence_in;     ///< body inputs, read blockwise
  std::vector<Value> constant_in;     ///< body inputs, the same at every step
  std::vector<Value> carry_out;       ///< body values
  int32_t length = 0;
  bool reverse = false;
};

/// Matrix operations in single-assignment form. Methods append a node and return its value; they simplify
/// what is trivially simple (sums with zero, products with one) and return an existing node where an equal
/// one stands, so nothing is computed twice. Shapes are the caller's duty and asserted in debug builds.
class Graph {
 public:
  /// A matrix bound at run time: elements offset … of `slot`, column-major.
  Value Input(int32_t slot, int64_t offset, int32_t rows, int32_t cols);
  Value Constant(double scalar, int32_t rows, int32_t cols);
  Value ConstantData(std::vector<double> column_major, int32_t rows, int32_t cols);

  Value MatMul(Value a, Value b, bool transpose_a = false, bool transpose_b = false);
  Value Add(Value a, Value b);
  Value Sub(Value a, Value b);
  Value Mul(Value a, Value b);
  Value Scale(Value a, double scalar);
  Value ScaleBy(Value scalar, Value a);
  Value Dot(Value a, Value b);
  Value Apply(Activation activation, double parameter, int order, Value a);
  Value Softmax(Value a);
  /// Repeats each block of `width` columns `count` times: [a₁ a₂] → [a₁ … a₁ a₂ … a₂].
  Value Tile(Value a, int32_t width, int32_t count);
  Value SumTiles(Value a, int32_t width, int32_t count);
  Value ConcatRows(const std::vector<Value>& parts);
  Value SliceRows(Value a, int32_t first, int32_t rows);
  Value PadRows(Value a, int32_t first, int32_t rows);
  Value ConcatCols(const std::vector<Value>& parts);
  Value SliceCols(Value a, int32_t first, int32_t cols);
  /// a + b where either may be absent (kNoValue, standing for zero).
  Value AddOrEither(Value a, Value b);
  /// a with a column of biases added to each of its columns.
  Value AddColumn(Value a, Value column) { return Add(a, Tile(column, 1, node(a).cols)); }

  /// Appends a scan whose body holds nothing to be hoisted. Models call BuildScan instead.
  Value AddScan(Scan scan, const std::vector<Value>& bindings);
  Value Collect(Value scan_node, Value body_value);
  Value FinalCarry(Value scan_node, int32_t carry);

  const Node& node(Value v) const { return nodes_[static_cast<size_t>(v)]; }
  const Scan& scan_of(Value scan_node) const { return scans_[static_cast<size_t>(node(scan_node).scan)]; }
  Value size() const { return static_cast<Value>(nodes_.size()); }
  bool IsConstant(Value v, double scalar) const;

  /// Appends `node` as it is (for transforms that copy nodes).
  Value Append(Node node);
  /// From here on `v` is read from a slot: somebody else computes it.
  void TurnIntoInput(Value v, int32_t slot, int64_t offset);

 private:
  std::vector<Node> nodes_;
  std::vector<Scan> scans_;
  std::unordered_multimap<size_t, Value> by_hash_;
};

}  // namespace metaekf::autodiff
