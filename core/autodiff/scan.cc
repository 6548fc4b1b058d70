#include "core/autodiff/scan.h"

#include <cassert>

namespace metaekf::autodiff {

ScanResult::ScanResult(Graph* outer, Recurrence recurrence) : outer_(outer), rec_(std::move(recurrence)) {
  const size_t size = static_cast<size_t>(rec_.body.size());
  outer_of_.assign(size, kNoValue);
  reduced_.assign(size, kNoValue);
  for (const auto& sequence : rec_.sequences) outer_of_[static_cast<size_t>(sequence.body_input)] = sequence.outer;
  for (const auto& constant : rec_.constants) outer_of_[static_cast<size_t>(constant.body_input)] = constant.outer;
  Classify();
  BuildLoop();
}

void ScanResult::Classify() {
  const size_t size = static_cast<size_t>(rec_.body.size());
  std::vector<bool> depends_on_carry(size, false), needed(size, false);
  invariant_.assign(size, false);
  for (const auto& constant : rec_.constants) invariant_[static_cast<size_t>(constant.body_input)] = true;
  for (const auto& carry : rec_.carries) depends_on_carry[static_cast<size_t>(carry.body_input)] = true;
  for (size_t v = 0; v < size; ++v) {
    const Node& node = rec_.body.node(static_cast<Value>(v));
    if (node.op == Op::kInput) continue;
    bool invariant = true;
    for (const Value input : node.inputs) {
      invariant = invariant && invariant_[static_cast<size_t>(input)];
      if (depends_on_carry[static_cast<size_t>(input)]) depends_on_carry[v] = true;
    }
    invariant_[v] = invariant;
  }
  for (const Value out : rec_.carry_out) needed[static_cast<size_t>(out)] = true;
  in_loop_.assign(size, false);
  for (size_t v = size; v-- > 0;) {
    if (!needed[v] || !depends_on_carry[v]) continue;
    in_loop_[v] = true;
    for (const Value input : rec_.body.node(static_cast<Value>(v)).inputs) needed[static_cast<size_t>(input)] = true;
  }
}

void ScanResult::BuildLoop() {
  auto body = std::make_shared<Graph>();
  Scan scan;
  scan.length = rec_.length;
  scan.reverse = rec_.reverse;
  std::vector<Value> carry_bindings, sequence_bindings, constant_bindings;
  int32_t next_slot = 0;
  for (const auto& carry : rec_.carries) {
    const Node& node = rec_.body.node(carry.body_input);
    const Value input = body->Input(next_slot++, 0, node.rows, node.cols);
    reduced_[static_cast<size_t>(carry.body_input)] = input;
    in_loop_[static_cast<size_t>(carry.body_input)] = true;
    scan.carry_in.push_back(input);
    carry_bindings.push_back(carry.outer);
  }
  // A value from outside the loop becomes a sequence of the scan, or a constant.
  const auto import = [&](Value v) {
    Value& reduced = reduced_[static_cast<size_t>(v)];
    if (reduced != kNoValue) return reduced;
    const Node& node = rec_.body.node(v);
    if (node.op == Op::kConstant) return reduced = body->Append(node);
    reduced = body->Input(next_slot++, 0, node.rows, node.cols);
    (IsInvariant(v) ? scan.constant_in : scan.sequence_in).push_back(reduced);
    (IsInvariant(v) ? constant_bindings : sequence_bindings).push_back(Outer(v));
    return reduced;
  };
  for (Value v = 0; v < rec_.body.size(); ++v) {
    if (!in_loop_[static_cast<size_t>(v)] || reduced_[static_cast<size_t>(v)] != kNoValue) continue;
    Node node = rec_.body.node(v);
    for (Value& input : node.inputs) input = import(input);
    reduced_[static_cast<size_t>(v)] = body->Append(std::move(node));
  }
  for (const Value out : rec_.carry_out) scan.carry_out.push_back(import(out));
  scan.body = std::move(body);
  std::vector<Value> bindings = std::move(carry_bindings);
  bindings.insert(bindings.end(), sequence_bindings.begin(), sequence_bindings.end());
  bindings.insert(bindings.end(), constant_bindings.begin(), constant_bindings.end());
  scan_ = outer_->AddScan(std::move(scan), bindings);
}

Value ScanResult::Outer(Value v) {
  const size_t i = static_cast<size_t>(v);
  if (outer_of_[i] != kNoValue) return outer_of_[i];
  if (in_loop_[i]) return outer_of_[i] = outer_->Collect(scan_, reduced_[i]);
  const Node node = rec_.body.node(v);
  if (v < rec_.primal_size && node.op != Op::kConstant && !IsInvariant(v)) {
    return outer_of_[i] = outer_->Collect(rec_.primal_scan, v);
  }
  return outer_of_[i] = Translate(node);
}

Value ScanResult::AtEveryStep(Value v) {
  const Value outer = Outer(v);
  return IsInvariant(v) ? outer_->Tile(outer, rec_.body.node(v).cols, rec_.length) : outer;
}

Value ScanResult::Translate(const Node& node) {
  bool invariant = true;
  for (const Value input : node.inputs) invariant = invariant && IsInvariant(input);
  if (invariant) {
    Node copy = node;
    for (Value& input : copy.inputs) input = Outer(input);
    return outer_->Append(std::move(copy));
  }
  switch (node.op) {
    case Op::kMatMul:
      assert(IsInvariant(node.inputs[0]) && !node.transpose_b && "a body value mixes columns");
      return outer_->MatMul(Outer(node.inputs[0]), Outer(node.inputs[1]), node.transpose_a, false);
    case Op::kScaleBy:
      assert(IsInvariant(node.inputs[0]) && "a body value mixes columns");
      return outer_->ScaleBy(Outer(node.inputs[0]), Outer(node.inputs[1]));
    case Op::kDot:
      assert(false && "a body value mixes columns");
      return kNoValue;
    default: {
      // Elementwise and blockwise operations: the same one on all steps' columns.
      Node copy = node;
      for (Value& input : copy.inputs) input = AtEveryStep(input);
      copy.cols *= rec_.length;
      return outer_->Append(std::move(copy));
    }
  }
}

Value ScanResult::Sum(Value v) {
  const Node node = rec_.body.node(v);
  if (IsInvariant(v)) return outer_->Scale(Outer(v), rec_.length);
  switch (node.op) {
    case Op::kAdd:
      return outer_->Add(Sum(node.inputs[0]), Sum(node.inputs[1]));
    case Op::kSub:
      return outer_->Sub(Sum(node.inputs[0]), Sum(node.inputs[1]));
    case Op::kScale:
      return outer_->Scale(Sum(node.inputs[0]), node.scalar);
    case Op::kScaleBy:
      if (!IsInvariant(node.inputs[0])) break;
      return outer_->ScaleBy(Outer(node.inputs[0]), Sum(node.inputs[1]));
    case Op::kMatMul:
      if (node.transpose_b && !node.transpose_a) {
        // Σ_t A_t B_tᵀ = [A_1 … A_T] [B_1 … B_T]ᵀ
        return outer_->MatMul(AtEveryStep(node.inputs[0]), AtEveryStep(node.inputs[1]), false, true);
      }
      break;
    case Op::kDot:
      return outer_->Dot(AtEveryStep(node.inputs[0]), AtEveryStep(node.inputs[1]));
    case Op::kPadRows:
      return outer_->PadRows(Sum(node.inputs[0]), node.first, node.rows);
    case Op::kSliceRows:
      return outer_->SliceRows(Sum(node.inputs[0]), node.first, node.rows);
    case Op::kSumTiles:
      if (node.cols == node.width) {
        return outer_->SumTiles(AtEveryStep(node.inputs[0]), node.width, node.count * rec_.length);
      }
      break;
    default:
      break;
  }
  return outer_->SumTiles(Outer(v), node.cols, rec_.length);
}

Value ScanResult::Final(int32_t index) { return outer_->FinalCarry(scan_, index); }

}  // namespace metaekf::autodiff
