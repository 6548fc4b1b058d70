#include <algorithm>
#include <cassert>
#include <map>

#include "core/autodiff/arena_allocator.h"
#include "core/autodiff/kernel.h"
#include "core/autodiff/merge_products.h"
#include "core/autodiff/program.h"
#include "core/autodiff/uses.h"

namespace metaekf::autodiff {
namespace {

int64_t SizeOf(const Node& node) { return int64_t{node.rows} * node.cols; }

bool IsView(Op op) { return op == Op::kSliceRows || op == Op::kSliceCols || op == Op::kTile || op == Op::kCollect || op == Op::kFinalCarry; }

Operand Tiled(Operand operand, const Node& tile) {
  operand.tile_width = tile.width;
  operand.tile_count = tile.count;
  return operand;
}

class Compiler {
 public:
  Compiler(const Graph& graph, const std::vector<Output>& outputs) : graph_(graph), outputs_(outputs) {}

  Program Run() {
    FindNeeded();
    uses_ = std::make_unique<Uses>(graph_, needed_, kept_);
    Schedule();
    FindLastReaders();
    AssignOutputs();
    for (const Value v : order_) {
      Emit(v);
      ReleaseReadBy(v);
    }
    for (const Output& output : outputs_) {
      if (bound_.count(output.value) != 0 && bound_.at(output.value) == &output) continue;
      const Node& node = graph_.node(output.value);
      EmitCopy(&program_.instructions, SlotOperand(output, node.rows), place(output.value), node);
    }
    program_.arena_size = arena_.end();
    return std::move(program_);
  }

 private:
  struct LoopNeeds {
    std::vector<bool> body;       // needed body values
    std::vector<bool> collected;  // body values that the outer graph reads
    std::vector<bool> carries;
  };

  const Operand& place(Value v) const { return place_[static_cast<size_t>(v)]; }
  static Operand SlotOperand(const Output& output, int32_t rows) {
    return {.slot = output.slot, .offset = output.offset, .ld = rows};
  }

  // ---- what is needed ----

  void FindNeeded() {
    const size_t size = static_cast<size_t>(graph_.size());
    needed_.assign(size, false);
    kept_.assign(size, false);
    place_.assign(size, Operand{});
    for (const Output& output : outputs_) {
      needed_[static_cast<size_t>(output.value)] = true;
      kept_[static_cast<size_t>(output.value)] = true;
    }
    std::map<Value, std::vector<const Node*>> readers;  // of scans
    for (Value v = graph_.size() - 1; v >= 0; --v) {
      if (!needed_[static_cast<size_t>(v)]) continue;
      const Node& node = graph_.node(v);
      if (node.op == Op::kScan) {
        for (const Value input : ScanInputsNeeded(v, node, readers[v])) needed_[static_cast<size_t>(input)] = true;
        continue;
      }
      if (node.op == Op::kCollect || node.op == Op::kFinalCarry) readers[node.inputs[0]].push_back(&node);
      for (const Value input : node.inputs) needed_[static_cast<size_t>(input)] = true;
    }
  }

  std::vector<Value> ScanInputsNeeded(Value v, const Node& node, const std::vector<const Node*>& readers) {
    const Scan& scan = graph_.scan_of(v);
    const Graph& body = *scan.body;
    LoopNeeds needs;
    needs.body.assign(static_cast<size_t>(body.size()), false);
    needs.collected.assign(static_cast<size_t>(body.size()), false);
    needs.carries.assign(scan.carry_in.size(), false);
    for (const Node* reader : readers) {
      if (reader->op == Op::kFinalCarry) {
        needs.carries[static_cast<size_t>(reader->index)] = true;
      } else {
        needs.body[static_cast<size_t>(reader->index)] = true;
        needs.collected[static_cast<size_t>(reader->index)] = true;
      }
    }
    for (bool changed = true; changed;) {
      changed = false;
      for (size_t i = 0; i < scan.carry_in.size(); ++i) {
        if (needs.carries[i]) needs.body[static_cast<size_t>(scan.carry_out[i])] = true;
      }
      for (Value b = body.size() - 1; b >= 0; --b) {
        if (!needs.body[static_cast<size_t>(b)]) continue;
        for (const Value input : body.node(b).inputs) needs.body[static_cast<size_t>(input)] = true;
      }
      for (size_t i = 0; i < scan.carry_in.size(); ++i) {
        if (needs.body[static_cast<size_t>(scan.carry_in[i])] && !needs.carries[i]) {
          needs.carries[i] = true;
          changed = true;
        }
      }
    }
    std::vector<Value> inputs;
    size_t position = 0;
    for (size_t i = 0; i < scan.carry_in.size(); ++i, ++position) {
      if (needs.carries[i]) inputs.push_back(node.inputs[position]);
    }
    for (const auto* list : {&scan.sequence_in, &scan.constant_in}) {
      for (const Value input : *list) {
        if (needs.body[static_cast<size_t>(input)]) inputs.push_back(node.inputs[position]);
        ++position;
      }
    }
    scan_inputs_[v] = inputs;
    loop_needs_[v] = std::move(needs);
    return inputs;
  }

  // ---- order ----

  const std::vector<Value>& InputsOf(Value v) const {
    return graph_.node(v).op == Op::kScan ? scan_inputs_.at(v) : graph_.node(v).inputs;
  }

  /// Outputs in the order in which they were made, each value shortly before who reads it first: a derivative's graph begins with all
  /// that it is the derivative of, and what that is needed for comes much later. Of several operands the one with the longest way comes
  /// first, so that the others need not be kept on it.
  void Schedule() {
    std::vector<int32_t> length(static_cast<size_t>(graph_.size()), 0);  // of the longest way to each value
    for (Value v = 0; v < graph_.size(); ++v) {
      if (!needed_[static_cast<size_t>(v)]) continue;
      int32_t& own = length[static_cast<size_t>(v)];
      for (const Value input : InputsOf(v)) own = std::max(own, length[static_cast<size_t>(input)] + 1);
    }
    std::vector<Value> roots;
    for (const Output& output : outputs_) roots.push_back(output.value);
    std::sort(roots.begin(), roots.end());
    position_.assign(length.size(), -1);
    for (const Value root : roots) ScheduleAfterInputs(root, length);
  }

  void ScheduleAfterInputs(Value v, const std::vector<int32_t>& length) {
    if (position_[static_cast<size_t>(v)] >= 0) return;
    std::vector<Value> inputs = InputsOf(v);
    std::stable_sort(inputs.begin(), inputs.end(), [&](Value a, Value b) { return length[static_cast<size_t>(a)] > length[static_cast<size_t>(b)]; });
    for (const Value input : inputs) ScheduleAfterInputs(input, length);
    position_[static_cast<size_t>(v)] = static_cast<int64_t>(order_.size());
    order_.push_back(v);
  }

  // ---- lifetimes ----

  /// The value whose buffer `v` is read from.
  Value BufferOf(Value v) const {
    const Node& node = graph_.node(v);
    if (uses_->in_place[static_cast<size_t>(v)] && IsView(node.op)) return BufferOf(node.inputs[0]);
    return v;
  }

  void FindLastReaders() {
    last_reader_.assign(static_cast<size_t>(graph_.size()), kNoValue);
    for (const Value v : order_) {
      // A fused product's operands are read when the addition runs.
      const Value reader = uses_->fused[static_cast<size_t>(v)] ? uses_->last[static_cast<size_t>(v)] : v;
      for (const Value input : InputsOf(v)) {
        Value& last = last_reader_[static_cast<size_t>(BufferOf(input))];
        if (last == kNoValue || position_[static_cast<size_t>(reader)] > position_[static_cast<size_t>(last)]) last = reader;
      }
    }
    for (const Output& output : outputs_) last_reader_[static_cast<size_t>(BufferOf(output.value))] = kNoValue;  // the caller
    read_last_by_.assign(last_reader_.size(), {});
    for (const Value v : order_) {
      const Value last = last_reader_[static_cast<size_t>(v)];
      if (last != kNoValue) read_last_by_[static_cast<size_t>(last)].push_back(v);
    }
  }

  void ReleaseReadBy(Value reader) {
    for (const Value v : read_last_by_[static_cast<size_t>(reader)]) Release(v);
  }

  void Release(Value v) {
    const auto it = buffers_.find(v);
    if (it == buffers_.end()) return;
    for (const auto& [offset, size] : it->second) arena_.Free(offset, size);
    buffers_.erase(it);
  }

  int64_t Allocate(Value owner, int64_t size) {
    const int64_t offset = arena_.Allocate(size);
    buffers_[owner].push_back({offset, size});
    return offset;
  }

  void AssignOutputs() {
    for (const Output& output : outputs_) {
      const Op op = graph_.node(output.value).op;
      const bool computed = op != Op::kInput && op != Op::kConstant && !uses_->in_place[static_cast<size_t>(output.value)];
      if (computed) bound_.emplace(output.value, &output);
    }
  }

  bool IsOverwrittenBy(Value reusable, Value reader) const {
    return reusable != kNoValue && last_reader_[static_cast<size_t>(reusable)] == reader &&
           SizeOf(graph_.node(reusable)) == SizeOf(graph_.node(reader));
  }

  /// The output that `v` is, or that the operations that overwrite it make of it.
  const Output* OutputOf(Value v) const {
    for (Value at = v;;) {
      const auto bound = bound_.find(at);
      if (bound != bound_.end()) return bound->second;
      const Value reader = last_reader_[static_cast<size_t>(at)];
      if (reader == kNoValue || !IsOverwrittenBy(at, reader) || Reusable(reader) != at) return nullptr;
      at = reader;
    }
  }

  /// Where a computed value goes: an output slot, the buffer of an operand that dies here, or a new one.
  Operand Destination(Value v) {
    const Node& node = graph_.node(v);
    if (const Output* output = OutputOf(v)) return SlotOperand(*output, node.rows);
    const Value reusable = Reusable(v);
    if (IsOverwrittenBy(reusable, v) && buffers_.count(reusable) != 0 && buffers_[reusable].size() == 1) {
      auto buffer = buffers_.extract(reusable);
      buffer.key() = v;
      const int64_t offset = buffer.mapped()[0].first;
      buffers_.insert(std::move(buffer));
      return {.offset = offset, .ld = node.rows};
    }
    return {.offset = Allocate(v, SizeOf(node)), .ld = node.rows};
  }

  // ---- instructions ----

  static void EmitCopy(std::vector<Instruction>* list, Operand out, Operand a, const Node& shape) {
    list->push_back({.op = Opcode::kCopy, .rows = shape.rows, .cols = shape.cols, .out = out, .a = a});
  }

  /// The instruction of a value that is neither a leaf, a view nor a scan, with operands from `at`.
  template <typename PlaceOf>
  static void EmitOperation(const Graph& graph, const Uses& uses, const std::vector<bool>& kept, const Node& node,
                            Operand out, const PlaceOf& at, std::vector<Instruction>* list) {
    Instruction i{.rows = node.rows, .cols = node.cols, .scalar = node.scalar, .out = out};
    if (!node.inputs.empty()) i.a = at(node.inputs[0]);
    if (node.inputs.size() > 1) i.b = at(node.inputs[1]);
    const auto set_product = [&](const Node& product) {
      i.a = at(product.inputs[0]);
      i.b = at(product.inputs[1]);
      i.transpose_a = product.transpose_a;
      i.transpose_b = product.transpose_b;
      const Node& a = graph.node(product.inputs[0]);
      i.inner = product.transpose_a ? a.rows : a.cols;
    };
    switch (node.op) {
      case Op::kMatMul:
        i.op = Opcode::kMatMul;
        set_product(node);
        break;
      case Op::kAdd: {
        i.op = Opcode::kAdd;
        const Value product = uses.FusableProduct(graph, node, kept);
        if (product == kNoValue) break;
        i.op = Opcode::kMatMulAdd;
        i.c = at(product == node.inputs[0] ? node.inputs[1] : node.inputs[0]);
        set_product(graph.node(product));
        break;
      }
      case Op::kSub:
        i.op = Opcode::kSub;
        break;
      case Op::kMul:
        i.op = Opcode::kMul;
        break;
      case Op::kScale:
        i.op = Opcode::kScale;
        break;
      case Op::kScaleBy:
        i.op = Opcode::kScaleBy;
        break;
      case Op::kDot:
        i.op = Opcode::kDot;
        i.rows = graph.node(node.inputs[0]).rows;
        i.cols = graph.node(node.inputs[0]).cols;
        break;
      case Op::kActivation:
        i.op = Opcode::kActivation;
        i.activation = node.activation;
        i.order = node.order;
        break;
      case Op::kSoftmax:
        i.op = Opcode::kSoftmax;
        break;
      case Op::kTile:
        i.op = Opcode::kCopy;
        i.a = Tiled(i.a, node);
        break;
      case Op::kSumTiles:
        i.op = Opcode::kSumTiles;
        i.cols = graph.node(node.inputs[0]).cols;
        i.width = node.width;
        i.count = node.count;
        break;
      case Op::kConcatRows: {
        int32_t first = 0;
        for (const Value part : node.inputs) {
          const int32_t rows = graph.node(part).rows;
          list->push_back({.op = Opcode::kCopyRows,
                           .rows = rows,
                           .cols = node.cols,
                           .first = first,
                           .out = out,
                           .a = at(part)});
          first += rows;
        }
        return;
      }
      case Op::kConcatCols: {
        for (const Value part : node.inputs) {
          EmitCopy(list, out, at(part), graph.node(part));
          out.offset += int64_t{out.ld} * graph.node(part).cols;
        }
        return;
      }
      case Op::kSliceCols:
        i.op = Opcode::kCopy;
        i.a.offset += int64_t{i.a.ld} * node.first;
        break;
      case Op::kSliceRows:
        i.op = Opcode::kSliceRows;
        i.first = node.first;
        break;
      case Op::kPadRows:
        list->push_back({.op = Opcode::kFill, .rows = node.rows, .cols = node.cols, .scalar = 0, .out = out});
        i.op = Opcode::kCopyRows;
        i.rows = graph.node(node.inputs[0]).rows;
        i.first = node.first;
        break;
      default:
        assert(false);
    }
    list->push_back(i);
  }

  void Emit(Value v) {
    const Node& node = graph_.node(v);
    Operand& where = place_[static_cast<size_t>(v)];
    switch (node.op) {
      case Op::kInput:
        where = {.slot = node.slot, .offset = node.offset, .ld = node.rows};
        return;
      case Op::kConstant:
        where = ConstantPlace(node);
        return;
      case Op::kScan:
        EmitScan(v, node);
        return;
      case Op::kCollect:
        where = collected_.at({node.inputs[0], node.index});
        return;
      case Op::kFinalCarry:
        where = final_carry_.at({node.inputs[0], node.index});
        return;
      default:
        break;
    }
    if (uses_->in_place[static_cast<size_t>(v)]) {
      where = place(node.inputs[0]);
      if (node.op == Op::kSliceRows) where.offset += node.first;
      if (node.op == Op::kSliceCols) where.offset += int64_t{where.ld} * node.first;
      if (node.op == Op::kTile) where = Tiled(where, node);
      return;
    }
    if (uses_->fused[static_cast<size_t>(v)]) return;
    where = Destination(v);
    EmitOperation(graph_, *uses_, kept_, node, where, [this](Value input) { return place(input); },
                  &program_.instructions);
  }

  /// An operand whose buffer the result may overwrite: read elementwise, untiled, and not a view of something else.
  Value Reusable(Value v) const {
    const Node& node = graph_.node(v);
    const bool elementwise = IsBinaryElementwise(node.op) || node.op == Op::kScale || node.op == Op::kActivation;
    if (!elementwise) return kNoValue;
    const Value product = node.op == Op::kAdd ? uses_->FusableProduct(graph_, node, kept_) : kNoValue;
    for (const Value input : node.inputs) {
      if (input == product) continue;
      const Op op = graph_.node(input).op;
      if (op == Op::kInput || op == Op::kConstant || uses_->in_place[static_cast<size_t>(input)]) continue;
      if (last_reader_[static_cast<size_t>(input)] != last_reader_[static_cast<size_t>(BufferOf(input))]) continue;
      if (product != kNoValue) {
        // The product must not read what it accumulates onto.
        const auto& operands = graph_.node(product).inputs;
        if (BufferOf(operands[0]) == input || BufferOf(operands[1]) == input) continue;
      }
      return input;
    }
    return kNoValue;
  }

  Operand ConstantPlace(const Node& node) {
    const int64_t offset = program_.constants_size;
    program_.constants_size += Aligned(SizeOf(node));
    program_.constants.push_back({offset, SizeOf(node), node.scalar, node.data});
    return {.slot = Operand::kConstants, .offset = offset, .ld = node.rows};
  }

  void EmitScan(Value v, const Node& node) {
    const Scan& scan = graph_.scan_of(v);
    const Graph& body = *scan.body;
    const LoopNeeds& needs = loop_needs_.at(v);
    std::vector<Operand> at(static_cast<size_t>(body.size()));
    std::vector<bool> has_place(at.size(), false);
    const auto put = [&](Value b, Operand operand) {
      at[static_cast<size_t>(b)] = operand;
      has_place[static_cast<size_t>(b)] = true;
    };
    Loop loop{.length = scan.length, .reverse = scan.reverse};
    std::vector<std::pair<Operand, Value>> carry_copies;
    // Carries: T + 1 places side by side; the step's own is read, the neighbour in the direction of travel written.
    for (size_t i = 0; i < scan.carry_in.size(); ++i) {
      if (!needs.carries[i]) continue;
      const Node& shape = body.node(scan.carry_in[i]);
      const int64_t size = SizeOf(shape);
      const int64_t base = Allocate(v, size * (scan.length + 1));
      const Operand low{.offset = base, .step_stride = size, .ld = shape.rows};
      Operand high = low;
      high.offset += size;
      Operand start = low, end = low;
      start.step_stride = end.step_stride = 0;
      (scan.reverse ? start : end).offset += size * scan.length;
      EmitCopy(&program_.instructions, start, place(node.inputs[i]), shape);
      const Operand read = scan.reverse ? high : low, written = scan.reverse ? low : high;
      put(scan.carry_in[i], read);
      final_carry_[{v, static_cast<int32_t>(i)}] = end;
      Remember(v, scan.carry_in[i], read);
      const Value out = scan.carry_out[i];
      const Op op = body.node(out).op;
      if (has_place[static_cast<size_t>(out)] || op == Op::kInput || op == Op::kConstant) {
        carry_copies.push_back({written, out});
      } else {
        put(out, written);
        Remember(v, out, written);
      }
    }
    size_t position = scan.carry_in.size();
    for (const Value input : scan.sequence_in) {
      const Node& shape = body.node(input);
      if (needs.body[static_cast<size_t>(input)]) {
        Operand operand = place(node.inputs[position]);
        operand.step_stride = int64_t{operand.ld} * shape.cols;
        put(input, operand);
      }
      ++position;
    }
    for (const Value input : scan.constant_in) {
      if (needs.body[static_cast<size_t>(input)]) put(input, place(node.inputs[position]));
      ++position;
    }
    std::vector<bool> kept = needs.collected;
    for (size_t i = 0; i < scan.carry_out.size(); ++i) {
      if (needs.carries[i]) kept[static_cast<size_t>(scan.carry_out[i])] = true;
    }
    const Uses uses(body, needs.body, kept);
    const Value scratch = -1 - v;  // owns what lives during the loop only
    for (Value b = 0; b < body.size(); ++b) {
      const size_t i = static_cast<size_t>(b);
      if (!needs.body[i]) continue;
      const Node& value = body.node(b);
      if (value.op == Op::kInput) continue;
      if (value.op == Op::kConstant) {
        put(b, ConstantPlace(value));
        continue;
      }
      if (uses.in_place[i]) {
        Operand operand = at[static_cast<size_t>(value.inputs[0])];
        if (value.op == Op::kSliceRows) operand.offset += value.first;
        if (value.op == Op::kTile) operand = Tiled(operand, value);
        put(b, operand);
        continue;
      }
      if (uses.fused[i]) continue;
      if (!has_place[i]) {
        const bool collected = needs.collected[i];
        const int64_t size = SizeOf(value);
        const Operand operand{.offset = Allocate(collected ? v : scratch, collected ? size * scan.length : size),
                              .step_stride = collected ? size : 0,
                              .ld = value.rows};
        put(b, operand);
        if (collected) Remember(v, b, operand);
      }
      EmitOperation(body, uses, kept, value, at[i], [&at](Value input) { return at[static_cast<size_t>(input)]; },
                    &loop.instructions);
    }
    for (const auto& [written, out] : carry_copies) {
      EmitCopy(&loop.instructions, written, at[static_cast<size_t>(out)], body.node(out));
    }
    for (Instruction& i : loop.instructions) {
      if (WantsPanel(i, loop)) i.panel = Allocate(scratch, PanelSize(i.rows, i.inner));
    }
    program_.instructions.push_back(
        {.op = Opcode::kLoop, .loop = static_cast<int32_t>(program_.loops.size())});
    program_.loops.push_back(std::move(loop));
    Release(scratch);
  }

  /// Whether a product in a loop is small and its first factor the same at every step.
  static bool WantsPanel(const Instruction& i, const Loop& loop) {
    constexpr int32_t kMostColumns = 8, kMostElements = 4096;
    if (i.op != Opcode::kMatMul && i.op != Opcode::kMatMulAdd) return false;
    if (i.transpose_b || i.cols > kMostColumns || i.rows * i.inner > kMostElements) return false;
    if (i.a.step_stride != 0 || i.a.tile_width != 0 || i.b.tile_width != 0 || i.c.tile_width != 0) return false;
    return std::none_of(loop.instructions.begin(), loop.instructions.end(), [&](const Instruction& other) {
      return other.out.slot == i.a.slot && i.a.offset >= other.out.offset &&
             i.a.offset < other.out.offset + int64_t{other.out.ld} * other.cols;
    });
  }

  /// Notes where the outer graph finds a body value of all steps.
  void Remember(Value scan_node, Value body_value, Operand operand) {
    operand.step_stride = 0;
    collected_.emplace(std::pair{scan_node, body_value}, operand);
  }

  const Graph& graph_;
  const std::vector<Output>& outputs_;
  Program program_;
  ArenaAllocator arena_;
  std::vector<bool> needed_, kept_;
  std::unique_ptr<Uses> uses_;
  std::vector<Operand> place_;
  std::vector<Value> order_;
  std::vector<int64_t> position_;  // in order_
  std::vector<Value> last_reader_;
  std::vector<std::vector<Value>> read_last_by_;
  std::map<Value, std::vector<std::pair<int64_t, int64_t>>> buffers_;  // owner → places in the arena
  std::map<Value, const Output*> bound_;
  std::map<Value, std::vector<Value>> scan_inputs_;
  std::map<Value, LoopNeeds> loop_needs_;
  std::map<std::pair<Value, int32_t>, Operand> collected_, final_carry_;
};

}  // namespace

Program Compile(const Graph& graph, const std::vector<Output>& outputs) {
  const std::optional<MergedGraph> merged = MergeProducts(graph, outputs);
  return merged ? Compiler(merged->graph, merged->outputs).Run() : Compiler(graph, outputs).Run();
}

}  // namespace metaekf::autodiff
