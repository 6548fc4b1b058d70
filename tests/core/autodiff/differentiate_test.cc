#include "core/autodiff/differentiate.h"

#include "core/autodiff/scan.h"
#include "tests/core/autodiff/derivative_check.h"

namespace metaekf::autodiff {
namespace {

Value Tanh(Graph* g, Value a) { return g->Apply(Activation::kTanh, 0, 0, a); }

std::vector<DifferentiableCase> OperationCases() {
  std::vector<DifferentiableCase> cases;
  for (const bool ta : {false, true}) {
    for (const bool tb : {false, true}) {
      cases.push_back({"MatMul " + std::to_string(ta) + std::to_string(tb),
                       {ta ? Shape{4, 3} : Shape{3, 4}, tb ? Shape{2, 4} : Shape{4, 2}},
                       [ta, tb](Graph* g, const std::vector<Value>& x) { return Tanh(g, g->MatMul(x[0], x[1], ta, tb)); }});
    }
  }
  cases.push_back({"arithmetic",
                   {{3, 2}, {3, 2}},
                   [](Graph* g, const std::vector<Value>& x) {
                     return g->Sub(g->Mul(x[0], g->Add(x[0], x[1])), g->Scale(g->Mul(x[1], x[1]), 0.3));
                   }});
  cases.push_back({"ScaleBy and Dot",
                   {{3, 2}, {3, 2}},
                   [](Graph* g, const std::vector<Value>& x) { return g->ScaleBy(g->Dot(x[0], x[1]), Tanh(g, x[0])); }});
  cases.push_back({"Softmax",
                   {{4, 3}, {4, 3}},
                   [](Graph* g, const std::vector<Value>& x) {
                     return g->Mul(g->Softmax(g->Scale(Tanh(g, x[0]), 3)), x[1]);
                   }});
  cases.push_back({"Tile in blocks",
                   {{2, 4}, {2, 12}},
                   [](Graph* g, const std::vector<Value>& x) { return g->Mul(Tanh(g, x[1]), g->Tile(x[0], 2, 3)); }});
  cases.push_back({"SumTiles in blocks",
                   {{2, 12}},
                   [](Graph* g, const std::vector<Value>& x) { return Tanh(g, g->SumTiles(x[0], 2, 3)); }});
  cases.push_back({"rows",
                   {{3, 2}, {2, 2}},
                   [](Graph* g, const std::vector<Value>& x) {
                     const Value all = g->ConcatRows({Tanh(g, x[0]), x[1]});
                     return g->Mul(g->PadRows(g->SliceRows(all, 1, 3), 1, 5), all);
                   }});
  cases.push_back({"a gradient inside the function",
                   {{4, 2}, {4, 1}, {1, 4}, {2, 3}},
                   [](Graph* g, const std::vector<Value>& x) {
                     // φ = W₂ swish(W₁ p + b) per column; Y = ∂φ/∂p, as the curl-free output has it.
                     const Value hidden = g->Apply(Activation::kSwish, 0, 0, g->AddColumn(g->MatMul(x[0], x[3]), x[1]));
                     const Value potential = g->MatMul(x[2], hidden);
                     return Vjp(g, {{potential, g->Constant(1, 1, 3)}}, {x[3]})[0];
                   }});
  return cases;
}

/// ψ⁺ = ψ + W₂ tanh(W₁[ψ; u] + b), y = C tanh(ψ), written with a scan or step by step.
Value Rollout(Graph* g, const std::vector<Value>& x, bool unrolled, int32_t steps, bool reverse, bool include_final) {
  const Value c = x[3], start = x[4], inputs = x[5];
  const int32_t width = g->node(start).cols, latent = g->node(start).rows, nu = g->node(inputs).rows;
  const auto step = [&](Graph* body, const std::vector<Value>& p, Value psi, Value u) {
    const Value z = body->AddColumn(body->MatMul(p[0], body->ConcatRows({psi, u})), p[1]);
    return body->Add(psi, body->MatMul(p[2], Tanh(body, z)));
  };
  std::vector<Value> parts;
  if (!unrolled) {
    Recurrence rec;
    rec.length = steps;
    rec.reverse = reverse;
    std::vector<Value> p;
    for (int i = 0; i < 4; ++i) {
      const Node shape = g->node(x[static_cast<size_t>(i)]);
      p.push_back(rec.body.Input(i, 0, shape.rows, shape.cols));
      rec.constants.push_back({p.back(), x[static_cast<size_t>(i)]});
    }
    const Value psi = rec.body.Input(10, 0, latent, width), u = rec.body.Input(11, 0, nu, width);
    rec.carries.push_back({psi, start});
    rec.sequences.push_back({u, inputs});
    rec.carry_out.push_back(step(&rec.body, p, psi, u));
    const Value y = rec.body.MatMul(p[3], Tanh(&rec.body, rec.carry_out[0]));
    ScanResult result(g, std::move(rec));
    const Value outer = result.Outer(y);
    return include_final ? g->Add(g->Scale(outer, 0.5), g->Tile(g->MatMul(c, result.Final(0)), width, steps)) : outer;
  }
  // The inputs of step t are picked out by a product with a selection matrix.
  Value psi = start;
  std::vector<Value> outputs(static_cast<size_t>(steps));
  for (int32_t k = 0; k < steps; ++k) {
    const int32_t t = reverse ? steps - 1 - k : k;
    std::vector<double> select(static_cast<size_t>(steps * width * width), 0);
    for (int32_t j = 0; j < width; ++j) select[static_cast<size_t>(t * width + j + j * steps * width)] = 1;
    const Value u = g->MatMul(inputs, g->ConstantData(select, steps * width, width));
    psi = step(g, x, psi, u);
    outputs[static_cast<size_t>(t)] = g->MatMul(c, Tanh(g, psi));
  }
  Value all = kNoValue;
  for (int32_t t = 0; t < steps; ++t) {
    std::vector<double> place(static_cast<size_t>(steps * width * width), 0);
    for (int32_t j = 0; j < width; ++j) place[static_cast<size_t>(j + (t * width + j) * width)] = 1;
    all = g->AddOrEither(all, g->MatMul(outputs[static_cast<size_t>(t)], g->ConstantData(place, width, steps * width)));
  }
  return include_final ? g->Add(g->Scale(all, 0.5), g->Tile(g->MatMul(c, psi), width, steps)) : all;
}

std::vector<Shape> RolloutShapes(int32_t steps, int32_t width) {
  return {{5, 5}, {5, 1}, {3, 5}, {2, 3}, {3, width}, {2, steps * width}};
}

TEST(DifferentiateTest, EveryOperationPassesTheConformanceSuite) {
  for (const DifferentiableCase& c : OperationCases()) CheckDerivatives(c, 17);
}

TEST(DifferentiateTest, ScansPassTheConformanceSuite) {
  for (const bool reverse : {false, true}) {
    for (const bool final : {false, true}) {
      for (const int32_t width : {1, 3}) {
        CheckDerivatives({"scan, width " + std::to_string(width) + (reverse ? ", reverse" : ""),
                          RolloutShapes(4, width),
                          [=](Graph* g, const std::vector<Value>& x) { return Rollout(g, x, false, 4, reverse, final); }},
                         23);
      }
    }
  }
}

// Oracle: the same recurrence written out step by step.
TEST(DifferentiateTest, AScanEqualsItsUnrolledForm) {
  for (const bool reverse : {false, true}) {
    for (const int32_t width : {1, 2}) {
      const int32_t steps = 5;
      std::vector<std::vector<double>> results;
      for (const bool unrolled : {false, true}) {
        Graph g;
        std::vector<Value> x, v;
        int64_t size = 0;
        for (const Shape& s : RolloutShapes(steps, width)) {
          x.push_back(g.Input(0, size, s.rows, s.cols));
          v.push_back(g.Input(1, size, s.rows, s.cols));
          size += int64_t{s.rows} * s.cols;
        }
        const Value y = Rollout(&g, x, unrolled, steps, reverse, true);
        std::vector<Value> outputs = Gradient(&g, g.Dot(y, y), x);
        std::vector<Seed> seeds;
        for (size_t i = 0; i < x.size(); ++i) seeds.push_back({x[i], v[i]});
        for (const Value hv : Jvp(&g, seeds, outputs)) outputs.push_back(hv);
        outputs.push_back(y);
        base::Rng rng(5);
        std::vector<double> point(static_cast<size_t>(size)), direction(point.size());
        for (double& value : point) value = 0.5 * rng.Normal();
        for (double& value : direction) value = rng.Normal();
        results.push_back(EvaluateFlat(g, outputs, {point, direction}));
      }
      ASSERT_EQ(results[0].size(), results[1].size());
      for (size_t i = 0; i < results[0].size(); ++i) EXPECT_NEAR(results[0][i], results[1][i], 1e-12) << i;
    }
  }
}

// The recurrence's own chain is all that may stay in the loop: for ψ⁺ = ψ + W₂ tanh(W₁[ψ; u] + b) a product,
// an activation and an accumulating product; its adjoint needs as many.
TEST(DifferentiateTest, OnlyTheDependencyChainStaysInTheLoop) {
  Graph g;
  std::vector<Value> x;
  int64_t size = 0;
  for (const Shape& s : RolloutShapes(6, 1)) {
    x.push_back(g.Input(0, size, s.rows, s.cols));
    size += int64_t{s.rows} * s.cols;
  }
  const Value y = Rollout(&g, x, false, 6, false, false);
  std::vector<Output> outputs;
  int64_t offset = 0;
  for (const Value v : Gradient(&g, g.Dot(y, y), x)) {
    outputs.push_back({v, 1, offset});
    offset += int64_t{g.node(v).rows} * g.node(v).cols;
  }
  const Program program = Compile(g, outputs);
  ASSERT_EQ(program.loops.size(), 2u);
  for (const Loop& loop : program.loops) {
    for (const Instruction& i : loop.instructions) {
      // Weight gradients are outer products with a transposed right factor: none may run per step.
      EXPECT_FALSE(i.op == Opcode::kMatMul && i.transpose_b);
      EXPECT_NE(i.op, Opcode::kSumTiles);
    }
    EXPECT_LE(loop.instructions.size(), 7u);
  }
}

TEST(DifferentiateTest, DirectionsSideBySideEqualOneAtATime) {
  Graph g;
  const Value w = g.Input(0, 0, 4, 3), x = g.Input(1, 0, 3, 2), v = g.Input(2, 0, 3, 6);
  const Value hidden = g.Apply(Activation::kSwish, 0, 0, g.MatMul(w, x));
  const Value y = g.Mul(hidden, g.Tile(g.SumTiles(hidden, 1, 2), 1, 2));
  const Value all = Jvp(&g, {{x, v}}, {y}, 3)[0];
  base::Rng rng(3);
  std::vector<double> wv(12), xv(6), vv(18);
  for (auto* values : {&wv, &xv, &vv}) {
    for (double& value : *values) value = rng.Normal();
  }
  const std::vector<double> together = EvaluateFlat(g, {all}, {wv, xv, vv});
  for (int32_t k = 0; k < 3; ++k) {
    Graph one;
    const Value w1 = one.Input(0, 0, 4, 3), x1 = one.Input(1, 0, 3, 2), v1 = one.Input(2, 6 * k, 3, 2);
    const Value h1 = one.Apply(Activation::kSwish, 0, 0, one.MatMul(w1, x1));
    const Value y1 = one.Mul(h1, one.Tile(one.SumTiles(h1, 1, 2), 1, 2));
    const std::vector<double> alone = EvaluateFlat(one, {Jvp(&one, {{x1, v1}}, {y1})[0]}, {wv, xv, vv});
    for (size_t i = 0; i < alone.size(); ++i) EXPECT_NEAR(together[static_cast<size_t>(k) * 8 + i], alone[i], 1e-14);
  }
}

TEST(DifferentiateTest, WhatDoesNotDependIsAbsent) {
  Graph g;
  const Value x = g.Input(0, 0, 2, 2), w = g.Input(1, 0, 2, 2);
  const Value y = g.Dot(x, x);
  EXPECT_EQ(Vjp(&g, {{y, g.Constant(1, 1, 1)}}, {w})[0], kNoValue);
  EXPECT_EQ(Jvp(&g, {{w, w}}, {y})[0], kNoValue);
}

}  // namespace
}  // namespace metaekf::autodiff
