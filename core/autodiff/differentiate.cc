#include "core/autodiff/differentiate.h"

#include <algorithm>
#include <cassert>
#include <map>

#include "core/autodiff/scan.h"

namespace metaekf::autodiff {
namespace {

/// Which values depend on any of `sources`.
std::vector<bool> DependentsOf(const Graph& graph, const std::vector<Value>& sources) {
  std::vector<bool> dependent(static_cast<size_t>(graph.size()), false);
  for (const Value source : sources) dependent[static_cast<size_t>(source)] = true;
  for (size_t v = 0; v < dependent.size(); ++v) {
    for (const Value input : graph.node(static_cast<Value>(v)).inputs) {
      if (dependent[static_cast<size_t>(input)]) dependent[v] = true;
    }
  }
  return dependent;
}

/// Which values `outputs` are computed from.
std::vector<bool> AncestorsOf(const Graph& graph, const std::vector<Value>& outputs) {
  std::vector<bool> ancestor(static_cast<size_t>(graph.size()), false);
  for (const Value output : outputs) ancestor[static_cast<size_t>(output)] = true;
  for (size_t v = ancestor.size(); v-- > 0;) {
    if (!ancestor[v]) continue;
    for (const Value input : graph.node(static_cast<Value>(v)).inputs) ancestor[static_cast<size_t>(input)] = true;
  }
  return ancestor;
}

/// σ^(n+1)(z) beside σ^(n)(z). That of tanh comes from its value, which is there already.
Value SlopeOf(Graph* graph, const Node& activation) {
  const Value z = activation.inputs[0];
  if (activation.activation == Activation::kTanh && activation.order == 0) {
    return graph->Apply(Activation::kTanhSlope, 0, 0, graph->Apply(Activation::kTanh, activation.scalar, 0, z));
  }
  return graph->Apply(activation.activation, activation.scalar, activation.order + 1, z);
}

/// Of s = softmax(a), whose Jacobian is symmetric: (diag(s) − s sᵀ) v, column by column.
Value SoftmaxDerivative(Graph* graph, Value s, Value v) {
  const int32_t rows = graph->node(s).rows;
  const Value product = graph->Mul(s, v);
  const Value sums = graph->MatMul(graph->Constant(1, rows, rows), product);  // Σ s v in every row
  return graph->Sub(product, graph->Mul(s, sums));
}

/// The derivative of a scan is a scan over an extended copy of its body, in which the primal carries are
/// sequences: they are known by then. `active` says which body inputs have a derivative; carries are active if
/// any active input reaches them through the recurrence.
struct ScanParts {
  ScanParts(const Graph& graph, Value scan_node, const std::vector<bool>& outer_active)
      : node(graph.node(scan_node)), scan(graph.scan_of(scan_node)) {
    const size_t carries = scan.carry_in.size(), sequences = scan.sequence_in.size();
    std::vector<Value> sources;
    const auto collect = [&](const std::vector<Value>& body_inputs, size_t first, std::vector<size_t>* active) {
      for (size_t i = 0; i < body_inputs.size(); ++i) {
        if (!outer_active[static_cast<size_t>(node.inputs[first + i])]) continue;
        sources.push_back(body_inputs[i]);
        if (active != nullptr) active->push_back(i);
      }
    };
    collect(scan.carry_in, 0, nullptr);
    collect(scan.sequence_in, carries, &active_sequences);
    collect(scan.constant_in, carries + sequences, &active_constants);
    carry_active.assign(carries, false);
    for (bool changed = true; changed;) {
      changed = false;
      const std::vector<bool> dependent = DependentsOf(*scan.body, sources);
      for (size_t i = 0; i < carries; ++i) {
        const bool active = dependent[static_cast<size_t>(scan.carry_out[i])] ||
                            dependent[static_cast<size_t>(scan.carry_in[i])];
        if (!active || carry_active[i]) continue;
        carry_active[i] = true;
        sources.push_back(scan.carry_in[i]);
        changed = true;
      }
    }
    for (size_t i = 0; i < carries; ++i) {
      if (carry_active[i]) active_carries.push_back(i);
    }
  }

  Value carry_binding(size_t i) const { return node.inputs[i]; }
  Value sequence_binding(size_t i) const { return node.inputs[scan.carry_in.size() + i]; }
  Value constant_binding(size_t i) const {
    return node.inputs[scan.carry_in.size() + scan.sequence_in.size() + i];
  }

  /// A recurrence whose body starts as a copy of this scan's.
  Recurrence Extend(Graph* graph, Value scan_node) const {
    Recurrence rec;
    rec.body = *scan.body;
    rec.length = scan.length;
    rec.primal_scan = scan_node;
    rec.primal_size = scan.body->size();
    for (const Value carry : scan.carry_in) rec.sequences.push_back({carry, graph->Collect(scan_node, carry)});
    for (size_t i = 0; i < scan.sequence_in.size(); ++i) {
      rec.sequences.push_back({scan.sequence_in[i], sequence_binding(i)});
    }
    for (size_t i = 0; i < scan.constant_in.size(); ++i) {
      rec.constants.push_back({scan.constant_in[i], constant_binding(i)});
    }
    return rec;
  }

  /// A new input of an extended body, of the shape of an existing one.
  static Value NewInput(Recurrence* rec, Value like) {
    // Slots only tell body inputs apart; the number of values so far is a fresh one.
    const Node& shape = rec->body.node(like);
    return rec->body.Input(1000000 + rec->body.size(), 0, shape.rows, shape.cols);
  }

  const Node node;
  const Scan scan;
  std::vector<bool> carry_active;
  std::vector<size_t> active_carries, active_sequences, active_constants;
};

class ForwardMode {
 public:
  ForwardMode(Graph* graph, int32_t directions) : graph_(*graph), directions_(directions) {}

  /// Tangents of the values below `limit`; of those only that are `needed`, if given.
  std::vector<Value> Run(const std::vector<Seed>& seeds, Value limit, const std::vector<bool>* needed) {
    tangent_.assign(static_cast<size_t>(limit), kNoValue);
    for (const Seed& seed : seeds) tangent_[static_cast<size_t>(seed.value)] = seed.derivative;
    for (Value v = 0; v < limit; ++v) {
      if (tangent(v) != kNoValue || (needed != nullptr && !(*needed)[static_cast<size_t>(v)])) continue;
      const Node node = graph_.node(v);
      bool active = false;
      for (const Value input : node.inputs) active = active || tangent(input) != kNoValue;
      active = active || node.op == Op::kCollect || node.op == Op::kFinalCarry;
      if (active) tangent_[static_cast<size_t>(v)] = Rule(v, node);
    }
    return tangent_;
  }

 private:
  struct TangentScan {
    ScanParts parts;
    ScanResult result;
    std::vector<Value> body_tangent;
  };

  Value tangent(Value v) const { return tangent_[static_cast<size_t>(v)]; }
  Value TangentOrZero(Value v) {
    if (tangent(v) != kNoValue) return tangent(v);
    return graph_.Constant(0, graph_.node(v).rows, graph_.node(v).cols * directions_);
  }
  /// A primal value beside tangents: repeated for every direction.
  Value Repeat(Value v) { return graph_.Tile(v, graph_.node(v).cols, directions_); }

  /// The tangent of a sum; what is added to a product's two tangents goes to the first of them, which then needs no pass of its own for it.
  Value SumOf(Value a, Value b) {
    if (a == kNoValue || b == kNoValue || graph_.node(a).op != Op::kAdd) return graph_.AddOrEither(a, b);
    const Value first = graph_.node(a).inputs[0], second = graph_.node(a).inputs[1];
    if (graph_.node(first).op != Op::kMatMul || graph_.node(second).op != Op::kMatMul) return graph_.Add(a, b);
    return graph_.Add(graph_.Add(first, b), second);
  }

  Value Rule(Value v, const Node& node) {
    const auto t = [&](size_t i) { return tangent(node.inputs[i]); };
    switch (node.op) {
      case Op::kConcatCols:
      case Op::kSliceCols:
        assert(false);  // made after differentiation
        return kNoValue;
      case Op::kInput:
      case Op::kConstant:
        return kNoValue;
      case Op::kMatMul: {
        const Value a = node.inputs[0], b = node.inputs[1];
        assert(directions_ == 1 || (t(0) == kNoValue && !node.transpose_b));
        const Value from_a =
            t(0) == kNoValue ? kNoValue : graph_.MatMul(t(0), b, node.transpose_a, node.transpose_b);
        const Value from_b =
            t(1) == kNoValue ? kNoValue : graph_.MatMul(a, t(1), node.transpose_a, node.transpose_b);
        return graph_.AddOrEither(from_a, from_b);
      }
      case Op::kAdd:
        return SumOf(t(0), t(1));
      case Op::kSub:
        return graph_.AddOrEither(t(0), t(1) == kNoValue ? kNoValue : graph_.Scale(t(1), -1));
      case Op::kMul:
        return graph_.AddOrEither(
            t(0) == kNoValue ? kNoValue : graph_.Mul(Repeat(node.inputs[1]), t(0)),
            t(1) == kNoValue ? kNoValue : graph_.Mul(Repeat(node.inputs[0]), t(1)));
      case Op::kScale:
        return graph_.Scale(t(0), node.scalar);
      case Op::kScaleBy:
        assert(directions_ == 1);
        return graph_.AddOrEither(
            t(0) == kNoValue ? kNoValue : graph_.ScaleBy(t(0), node.inputs[1]),
            t(1) == kNoValue ? kNoValue : graph_.ScaleBy(node.inputs[0], t(1)));
      case Op::kDot:
        assert(directions_ == 1);
        return graph_.AddOrEither(t(0) == kNoValue ? kNoValue : graph_.Dot(t(0), node.inputs[1]),
                                  t(1) == kNoValue ? kNoValue : graph_.Dot(node.inputs[0], t(1)));
      case Op::kActivation:
        return graph_.Mul(Repeat(SlopeOf(&graph_, node)), t(0));
      case Op::kSoftmax:
        return SoftmaxDerivative(&graph_, Repeat(v), t(0));
      case Op::kTile:
        return graph_.Tile(t(0), node.width, node.count);
      case Op::kSumTiles:
        return graph_.SumTiles(t(0), node.width, node.count);
      case Op::kConcatRows: {
        std::vector<Value> parts;
        for (const Value input : node.inputs) parts.push_back(TangentOrZero(input));
        return graph_.ConcatRows(parts);
      }
      case Op::kSliceRows:
        return graph_.SliceRows(t(0), node.first, node.rows);
      case Op::kPadRows:
        return graph_.PadRows(t(0), node.first, node.rows);
      case Op::kScan:
        BuildTangentScan(v);
        return kNoValue;
      case Op::kCollect: {
        const auto it = scans_.find(node.inputs[0]);
        if (it == scans_.end()) return kNoValue;
        const Value body_tangent = it->second.body_tangent[static_cast<size_t>(node.index)];
        return body_tangent == kNoValue ? kNoValue : it->second.result.AtEveryStep(body_tangent);
      }
      case Op::kFinalCarry: {
        const auto it = scans_.find(node.inputs[0]);
        if (it == scans_.end()) return kNoValue;
        const auto& active = it->second.parts.active_carries;
        const auto position = std::find(active.begin(), active.end(), static_cast<size_t>(node.index));
        return position == active.end() ? kNoValue
                                        : it->second.result.Final(static_cast<int32_t>(position - active.begin()));
      }
    }
    return kNoValue;
  }

  void BuildTangentScan(Value scan_node) {
    assert(directions_ == 1);
    std::vector<bool> active(tangent_.size());
    for (size_t v = 0; v < active.size(); ++v) active[v] = tangent_[v] != kNoValue;
    ScanParts parts(graph_, scan_node, active);
    Recurrence rec = parts.Extend(&graph_, scan_node);
    rec.reverse = parts.scan.reverse;
    const Value primal_size = rec.body.size();
    std::vector<Seed> seeds;
    for (const size_t i : parts.active_carries) {
      const Value carry = parts.scan.carry_in[i];
      const Value input = ScanParts::NewInput(&rec, carry);
      rec.carries.push_back({input, TangentOrZero(parts.carry_binding(i))});
      seeds.push_back({carry, input});
    }
    for (const size_t i : parts.active_sequences) {
      const Value input = ScanParts::NewInput(&rec, parts.scan.sequence_in[i]);
      rec.sequences.push_back({input, tangent(parts.sequence_binding(i))});
      seeds.push_back({parts.scan.sequence_in[i], input});
    }
    for (const size_t i : parts.active_constants) {
      const Value input = ScanParts::NewInput(&rec, parts.scan.constant_in[i]);
      rec.constants.push_back({input, tangent(parts.constant_binding(i))});
      seeds.push_back({parts.scan.constant_in[i], input});
    }
    std::vector<Value> body_tangent = ForwardMode(&rec.body, 1).Run(seeds, primal_size, nullptr);
    for (const size_t i : parts.active_carries) {
      const Value out = parts.scan.carry_out[i];
      Value out_tangent = body_tangent[static_cast<size_t>(out)];
      if (out_tangent == kNoValue) {
        const Node shape = rec.body.node(out);
        out_tangent = rec.body.Constant(0, shape.rows, shape.cols);
      }
      rec.carry_out.push_back(out_tangent);
    }
    ScanResult result(&graph_, std::move(rec));
    scans_.emplace(scan_node, TangentScan{std::move(parts), std::move(result), std::move(body_tangent)});
  }

  Graph& graph_;
  const int32_t directions_;
  std::vector<Value> tangent_;
  std::map<Value, TangentScan> scans_;
};

class ReverseMode {
 public:
  explicit ReverseMode(Graph* graph) : graph_(*graph) {}

  std::vector<Value> Run(const std::vector<Seed>& seeds, const std::vector<Value>& wrt) {
    active_ = DependentsOf(graph_, wrt);
    cotangent_.assign(active_.size(), kNoValue);
    Value last = -1;
    for (const Seed& seed : seeds) {
      Accumulate(seed.value, seed.derivative);
      last = std::max(last, seed.value);
    }
    for (Value v = last; v >= 0; --v) {
      const Node node = graph_.node(v);
      if (node.op == Op::kScan) {
        if (scan_seeds_.count(v) != 0) PropagateScan(v);
      } else if (cotangent_[static_cast<size_t>(v)] != kNoValue) {
        Rule(node, cotangent_[static_cast<size_t>(v)]);
      }
    }
    std::vector<Value> result;
    for (const Value v : wrt) result.push_back(cotangent_[static_cast<size_t>(v)]);
    return result;
  }

 private:
  /// Cotangents of a scan's collected body values and final carries.
  struct ScanSeeds {
    std::vector<Seed> collected;
    std::map<int32_t, Value> final_carry;
  };

  bool IsActive(Value v) const { return active_[static_cast<size_t>(v)]; }
  void Accumulate(Value v, Value cotangent) {
    if (!IsActive(v)) return;
    Value& sum = cotangent_[static_cast<size_t>(v)];
    sum = graph_.AddOrEither(sum, cotangent);
  }

  void Rule(const Node& node, Value g) {
    const auto in = [&](size_t i) { return node.inputs[i]; };
    switch (node.op) {
      case Op::kConcatCols:
      case Op::kSliceCols:
        assert(false);  // made after differentiation
        return;
      case Op::kInput:
      case Op::kConstant:
      case Op::kScan:
        return;
      case Op::kMatMul:
        // C = op(A) op(B): Ā = Ḡ op(B)ᵀ, transposed where A was; B̄ = op(A)ᵀ Ḡ likewise.
        if (IsActive(in(0))) {
          Accumulate(in(0), node.transpose_a ? graph_.MatMul(in(1), g, node.transpose_b, true)
                                             : graph_.MatMul(g, in(1), false, !node.transpose_b));
        }
        if (IsActive(in(1))) {
          Accumulate(in(1), node.transpose_b ? graph_.MatMul(g, in(0), true, node.transpose_a)
                                             : graph_.MatMul(in(0), g, !node.transpose_a, false));
        }
        return;
      case Op::kAdd:
        Accumulate(in(0), g);
        Accumulate(in(1), g);
        return;
      case Op::kSub:
        Accumulate(in(0), g);
        if (IsActive(in(1))) Accumulate(in(1), graph_.Scale(g, -1));
        return;
      case Op::kMul:
        if (IsActive(in(0))) Accumulate(in(0), graph_.Mul(in(1), g));
        if (IsActive(in(1))) Accumulate(in(1), graph_.Mul(in(0), g));
        return;
      case Op::kScale:
        Accumulate(in(0), graph_.Scale(g, node.scalar));
        return;
      case Op::kScaleBy:
        if (IsActive(in(0))) Accumulate(in(0), graph_.Dot(in(1), g));
        if (IsActive(in(1))) Accumulate(in(1), graph_.ScaleBy(in(0), g));
        return;
      case Op::kDot:
        if (IsActive(in(0))) Accumulate(in(0), graph_.ScaleBy(g, in(1)));
        if (IsActive(in(1))) Accumulate(in(1), graph_.ScaleBy(g, in(0)));
        return;
      case Op::kActivation:
        Accumulate(in(0), graph_.Mul(SlopeOf(&graph_, node), g));
        return;
      case Op::kSoftmax:
        Accumulate(in(0), SoftmaxDerivative(&graph_, graph_.Softmax(in(0)), g));
        return;
      case Op::kTile:
        Accumulate(in(0), graph_.SumTiles(g, node.width, node.count));
        return;
      case Op::kSumTiles:
        Accumulate(in(0), graph_.Tile(g, node.width, node.count));
        return;
      case Op::kConcatRows: {
        int32_t first = 0;
        for (const Value part : node.inputs) {
          const int32_t rows = graph_.node(part).rows;
          if (IsActive(part)) Accumulate(part, graph_.SliceRows(g, first, rows));
          first += rows;
        }
        return;
      }
      case Op::kSliceRows:
        Accumulate(in(0), graph_.PadRows(g, node.first, graph_.node(in(0)).rows));
        return;
      case Op::kPadRows:
        Accumulate(in(0), graph_.SliceRows(g, node.first, graph_.node(in(0)).rows));
        return;
      case Op::kCollect:
        scan_seeds_[in(0)].collected.push_back({node.index, g});
        return;
      case Op::kFinalCarry:
        scan_seeds_[in(0)].final_carry.emplace(node.index, g);
        return;
    }
  }

  void PropagateScan(Value scan_node) {
    const ScanSeeds& seeds = scan_seeds_[scan_node];
    const ScanParts parts(graph_, scan_node, active_);
    Recurrence rec = parts.Extend(&graph_, scan_node);
    rec.reverse = !parts.scan.reverse;
    std::vector<Seed> body_seeds;
    for (const size_t i : parts.active_carries) {
      const Value carry = parts.scan.carry_in[i];
      const Value input = ScanParts::NewInput(&rec, carry);
      const auto final_seed = seeds.final_carry.find(static_cast<int32_t>(i));
      const Node shape = rec.body.node(carry);
      rec.carries.push_back(
          {input, final_seed != seeds.final_carry.end() ? final_seed->second
                                                         : graph_.Constant(0, shape.rows, shape.cols)});
      body_seeds.push_back({parts.scan.carry_out[i], input});
    }
    for (const Seed& collected : seeds.collected) {
      const Value input = ScanParts::NewInput(&rec, collected.value);
      rec.sequences.push_back({input, collected.derivative});
      body_seeds.push_back({collected.value, input});
    }
    std::vector<Value> wrt;
    for (const size_t i : parts.active_carries) wrt.push_back(parts.scan.carry_in[i]);
    for (const size_t i : parts.active_sequences) wrt.push_back(parts.scan.sequence_in[i]);
    for (const size_t i : parts.active_constants) wrt.push_back(parts.scan.constant_in[i]);
    const std::vector<Value> body_cotangent = ReverseMode(&rec.body).Run(body_seeds, wrt);
    for (size_t j = 0; j < parts.active_carries.size(); ++j) {
      const Node shape = rec.body.node(wrt[j]);
      rec.carry_out.push_back(body_cotangent[j] != kNoValue ? body_cotangent[j]
                                                            : rec.body.Constant(0, shape.rows, shape.cols));
    }
    ScanResult result(&graph_, std::move(rec));
    size_t j = 0;
    for (size_t k = 0; k < parts.active_carries.size(); ++k, ++j) {
      Accumulate(parts.carry_binding(parts.active_carries[k]), result.Final(static_cast<int32_t>(k)));
    }
    for (const size_t i : parts.active_sequences) {
      const Value cotangent = body_cotangent[j++];
      if (cotangent != kNoValue) Accumulate(parts.sequence_binding(i), result.AtEveryStep(cotangent));
    }
    for (const size_t i : parts.active_constants) {
      const Value cotangent = body_cotangent[j++];
      if (cotangent != kNoValue) Accumulate(parts.constant_binding(i), result.Sum(cotangent));
    }
  }

  Graph& graph_;
  std::vector<bool> active_;
  std::vector<Value> cotangent_;
  std::map<Value, ScanSeeds> scan_seeds_;
};

}  // namespace

std::vector<Value> Jvp(Graph* graph, const std::vector<Seed>& seeds, const std::vector<Value>& outputs,
                       int32_t directions) {
  const Value limit = outputs.empty() ? 0 : *std::max_element(outputs.begin(), outputs.end()) + 1;
  std::vector<Seed> relevant;
  for (const Seed& seed : seeds) {
    if (seed.value < limit) relevant.push_back(seed);
  }
  const std::vector<bool> needed = AncestorsOf(*graph, outputs);
  const std::vector<Value> tangents = ForwardMode(graph, directions).Run(relevant, limit, &needed);
  std::vector<Value> result;
  for (const Value output : outputs) result.push_back(tangents[static_cast<size_t>(output)]);
  return result;
}

std::vector<Value> Vjp(Graph* graph, const std::vector<Seed>& seeds, const std::vector<Value>& wrt) {
  return ReverseMode(graph).Run(seeds, wrt);
}

std::vector<Value> Gradient(Graph* graph, Value scalar, const std::vector<Value>& wrt) {
  std::vector<Value> result = Vjp(graph, {{scalar, graph->Constant(1, 1, 1)}}, wrt);
  for (size_t i = 0; i < wrt.size(); ++i) {
    const Node shape = graph->node(wrt[i]);
    if (result[i] == kNoValue) result[i] = graph->Constant(0, shape.rows, shape.cols);
  }
  return result;
}

}  // namespace metaekf::autodiff
