#include "core/autodiff/graph.h"

#include <cassert>
#include <functional>

namespace metaekf::autodiff {
namespace {

size_t Hash(const Node& node) {
  size_t hash = static_cast<size_t>(node.op);
  const auto mix = [&hash](uint64_t v) { hash = (hash ^ v) * 0x9e3779b97f4a7c15ull + (hash >> 29); };
  for (const Value input : node.inputs) mix(static_cast<uint64_t>(input));
  mix(static_cast<uint64_t>(node.rows) << 32 | static_cast<uint32_t>(node.cols));
  mix(static_cast<uint64_t>(node.first) << 32 | static_cast<uint32_t>(node.index));
  mix(static_cast<uint64_t>(node.offset) * 31 + static_cast<uint64_t>(node.slot));
  mix(std::hash<double>()(node.scalar) + static_cast<uint64_t>(node.order));
  return hash;
}

}  // namespace

bool Node::operator==(const Node& other) const {
  return op == other.op && rows == other.rows && cols == other.cols && inputs == other.inputs &&
         transpose_a == other.transpose_a && transpose_b == other.transpose_b && activation == other.activation &&
         order == other.order && width == other.width && count == other.count && first == other.first &&
         slot == other.slot && offset == other.offset && index == other.index && scalar == other.scalar &&
         data == other.data && scan == other.scan;
}

Value Graph::Append(Node node) {
  const size_t hash = Hash(node);
  const auto [begin, end] = by_hash_.equal_range(hash);
  for (auto it = begin; it != end; ++it) {
    if (nodes_[static_cast<size_t>(it->second)] == node) return it->second;
  }
  nodes_.push_back(std::move(node));
  by_hash_.emplace(hash, size() - 1);
  return size() - 1;
}

void Graph::TurnIntoInput(Value v, int32_t slot, int64_t offset) {
  Node& turned = nodes_[static_cast<size_t>(v)];
  turned = {.op = Op::kInput, .rows = turned.rows, .cols = turned.cols, .slot = slot, .offset = offset};
}

bool Graph::IsConstant(Value v, double scalar) const {
  return node(v).op == Op::kConstant && !node(v).data && node(v).scalar == scalar;
}

Value Graph::Input(int32_t slot, int64_t offset, int32_t rows, int32_t cols) {
  return Append({.op = Op::kInput, .rows = rows, .cols = cols, .slot = slot, .offset = offset});
}

Value Graph::Constant(double scalar, int32_t rows, int32_t cols) {
  return Append({.op = Op::kConstant, .rows = rows, .cols = cols, .scalar = scalar});
}

Value Graph::ConstantData(std::vector<double> column_major, int32_t rows, int32_t cols) {
  assert(static_cast<int64_t>(column_major.size()) == int64_t{rows} * cols);
  return Append({.op = Op::kConstant,
                 .rows = rows,
                 .cols = cols,
                 .data = std::make_shared<const std::vector<double>>(std::move(column_major))});
}

Value Graph::MatMul(Value a, Value b, bool transpose_a, bool transpose_b) {
  const int32_t rows = transpose_a ? node(a).cols : node(a).rows;
  const int32_t cols = transpose_b ? node(b).rows : node(b).cols;
  assert((transpose_a ? node(a).rows : node(a).cols) == (transpose_b ? node(b).cols : node(b).rows));
  if (IsConstant(a, 0) || IsConstant(b, 0)) return Constant(0, rows, cols);
  return Append({.op = Op::kMatMul,
                 .rows = rows,
                 .cols = cols,
                 .inputs = {a, b},
                 .transpose_a = transpose_a,
                 .transpose_b = transpose_b});
}

Value Graph::Add(Value a, Value b) {
  assert(node(a).rows == node(b).rows && node(a).cols == node(b).cols);
  if (IsConstant(a, 0)) return b;
  if (IsConstant(b, 0)) return a;
  return Append({.op = Op::kAdd, .rows = node(a).rows, .cols = node(a).cols, .inputs = {a, b}});
}

Value Graph::Sub(Value a, Value b) {
  assert(node(a).rows == node(b).rows && node(a).cols == node(b).cols);
  if (IsConstant(b, 0)) return a;
  return Append({.op = Op::kSub, .rows = node(a).rows, .cols = node(a).cols, .inputs = {a, b}});
}

Value Graph::Mul(Value a, Value b) {
  assert(node(a).rows == node(b).rows && node(a).cols == node(b).cols);
  if (IsConstant(a, 0) || IsConstant(b, 1)) return a;
  if (IsConstant(b, 0) || IsConstant(a, 1)) return b;
  return Append({.op = Op::kMul, .rows = node(a).rows, .cols = node(a).cols, .inputs = {a, b}});
}

Value Graph::Scale(Value a, double scalar) {
  const Node& operand = node(a);
  if (scalar == 1) return a;
  if (scalar == 0) return Constant(0, operand.rows, operand.cols);
  if (operand.op == Op::kConstant && !operand.data) return Constant(operand.scalar * scalar, operand.rows, operand.cols);
  if (operand.op == Op::kScale) return Scale(operand.inputs[0], operand.scalar * scalar);
  return Append({.op = Op::kScale, .rows = operand.rows, .cols = operand.cols, .inputs = {a}, .scalar = scalar});
}

Value Graph::ScaleBy(Value scalar, Value a) {
  assert(node(scalar).rows == 1 && node(scalar).cols == 1);
  if (node(scalar).op == Op::kConstant && !node(scalar).data) return Scale(a, node(scalar).scalar);
  return Append({.op = Op::kScaleBy, .rows = node(a).rows, .cols = node(a).cols, .inputs = {scalar, a}});
}

Value Graph::Dot(Value a, Value b) {
  assert(node(a).rows == node(b).rows && node(a).cols == node(b).cols);
  if (IsConstant(a, 0) || IsConstant(b, 0)) return Constant(0, 1, 1);
  return Append({.op = Op::kDot, .rows = 1, .cols = 1, .inputs = {a, b}});
}

Value Graph::Apply(Activation activation, double parameter, int order, Value a) {
  const int32_t rows = node(a).rows, cols = node(a).cols;
  if (activation == Activation::kIdentity) return order == 0 ? a : Constant(order == 1 ? 1 : 0, rows, cols);
  if (DerivativeIsZero(activation, order)) return Constant(0, rows, cols);
  assert(order <= kMaxDerivative);
  std::vector<Value> inputs = {a};
  if (activation == Activation::kSwish) inputs.push_back(Apply(Activation::kSigmoid, 0, 0, a));  // once for all orders
  return Append({.op = Op::kActivation,
                 .rows = rows,
                 .cols = cols,
                 .inputs = std::move(inputs),
                 .activation = activation,
                 .order = order,
                 .scalar = parameter});
}

Value Graph::Softmax(Value a) {
  const int32_t rows = node(a).rows, cols = node(a).cols;
  if (rows == 1) return Constant(1, 1, cols);
  return Append({.op = Op::kSoftmax, .rows = rows, .cols = cols, .inputs = {a}});
}

Value Graph::Tile(Value a, int32_t width, int32_t count) {
  const Node& operand = node(a);
  assert(operand.cols % width == 0);
  if (count == 1) return a;
  if (operand.op == Op::kConstant && !operand.data) return Constant(operand.scalar, operand.rows, operand.cols * count);
  return Append({.op = Op::kTile,
                 .rows = operand.rows,
                 .cols = operand.cols * count,
                 .inputs = {a},
                 .width = width,
                 .count = count});
}

Value Graph::SumTiles(Value a, int32_t width, int32_t count) {
  const Node& operand = node(a);
  assert(operand.cols % (width * count) == 0);
  if (count == 1) return a;
  return Append({.op = Op::kSumTiles,
                 .rows = operand.rows,
                 .cols = operand.cols / count,
                 .inputs = {a},
                 .width = width,
                 .count = count});
}

Value Graph::ConcatRows(const std::vector<Value>& parts) {
  if (parts.size() == 1) return parts[0];
  int32_t rows = 0;
  for (const Value part : parts) rows += node(part).rows;
  return Append({.op = Op::kConcatRows, .rows = rows, .cols = node(parts[0]).cols, .inputs = parts});
}

Value Graph::SliceRows(Value a, int32_t first, int32_t rows) {
  const Node& operand = node(a);
  assert(first >= 0 && first + rows <= operand.rows);
  if (rows == operand.rows) return a;
  if (operand.op == Op::kConstant && !operand.data) return Constant(operand.scalar, rows, operand.cols);
  return Append({.op = Op::kSliceRows, .rows = rows, .cols = operand.cols, .inputs = {a}, .first = first});
}

Value Graph::PadRows(Value a, int32_t first, int32_t rows) {
  const Node& operand = node(a);
  if (rows == operand.rows) return a;
  if (IsConstant(a, 0)) return Constant(0, rows, operand.cols);
  return Append({.op = Op::kPadRows, .rows = rows, .cols = operand.cols, .inputs = {a}, .first = first});
}

Value Graph::ConcatCols(const std::vector<Value>& parts) {
  int32_t cols = 0;
  for (const Value part : parts) cols += node(part).cols;
  return Append({.op = Op::kConcatCols, .rows = node(parts.front()).rows, .cols = cols, .inputs = parts});
}

Value Graph::SliceCols(Value a, int32_t first, int32_t cols) {
  assert(first + cols <= node(a).cols);
  return Append({.op = Op::kSliceCols, .rows = node(a).rows, .cols = cols, .inputs = {a}, .first = first});
}

Value Graph::AddOrEither(Value a, Value b) {
  if (a == kNoValue) return b;
  if (b == kNoValue) return a;
  return Add(a, b);
}

Value Graph::AddScan(Scan scan, const std::vector<Value>& bindings) {
  assert(bindings.size() == scan.carry_in.size() + scan.sequence_in.size() + scan.constant_in.size());
  scans_.push_back(std::move(scan));
  return Append({.op = Op::kScan, .inputs = bindings, .scan = static_cast<int32_t>(scans_.size()) - 1});
}

Value Graph::Collect(Value scan_node, Value body_value) {
  const Scan& scan = scan_of(scan_node);
  const Node& collected = scan.body->node(body_value);
  return Append({.op = Op::kCollect,
                 .rows = collected.rows,
                 .cols = collected.cols * scan.length,
                 .inputs = {scan_node},
                 .index = body_value});
}

Value Graph::FinalCarry(Value scan_node, int32_t carry) {
  const Scan& scan = scan_of(scan_node);
  const Node& value = scan.body->node(scan.carry_in[static_cast<size_t>(carry)]);
  return Append(
      {.op = Op::kFinalCarry, .rows = value.rows, .cols = value.cols, .inputs = {scan_node}, .index = carry});
}

}  // namespace metaekf::autodiff
