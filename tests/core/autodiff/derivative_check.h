#pragma once

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <vector>

#include "core/autodiff/differentiate.h"
#include "core/autodiff/evaluate.h"
#include "core/base/rng.h"

namespace metaekf::autodiff {

/// Runs what a graph computes on flat inputs, one vector per slot.
inline std::vector<double> EvaluateFlat(const Graph& graph, const std::vector<Value>& outputs,
                                        const std::vector<std::vector<double>>& inputs) {
  std::vector<Output> bound;
  int64_t size = 0;
  const int32_t slot = static_cast<int32_t>(inputs.size());
  for (const Value output : outputs) {
    bound.push_back({output, slot, size});
    size += int64_t{graph.node(output).rows} * graph.node(output).cols;
  }
  const Executable<double> executable(Compile(graph, bound));
  const Arena<double> arena({&executable});
  Slots<double> slots;
  for (size_t i = 0; i < inputs.size(); ++i) slots.Input(static_cast<int32_t>(i), inputs[i].data());
  std::vector<double> result(static_cast<size_t>(size), std::nan(""));
  slots.Output(slot, result.data());
  Evaluate(executable, slots, arena);
  // A second run must not depend on what the first left behind.
  const std::vector<double> first = result;
  Evaluate(executable, slots, arena);
  EXPECT_EQ(first, result);
  return result;
}

struct Shape {
  int32_t rows, cols;
};

/// A differentiable function of matrices, as the conformance suite takes it.
struct DifferentiableCase {
  std::string name;
  std::vector<Shape> arguments;
  std::function<Value(Graph*, const std::vector<Value>&)> build;
};

/// Checks gradient, Jacobian–vector and Hessian–vector products of L = c·Y + ½‖Y‖² for Y = f(arguments): against
/// central differences in double, and forward against reverse mode.
inline void CheckDerivatives(const DifferentiableCase& c, uint64_t seed, double tolerance = 1e-6) {
  SCOPED_TRACE(c.name);
  Graph graph;
  std::vector<Value> arguments, directions;
  int64_t size = 0;
  for (const Shape& shape : c.arguments) {
    arguments.push_back(graph.Input(0, size, shape.rows, shape.cols));
    directions.push_back(graph.Input(1, size, shape.rows, shape.cols));
    size += int64_t{shape.rows} * shape.cols;
  }
  base::Rng rng(seed);
  const Value y = c.build(&graph, arguments);
  std::vector<double> weights(static_cast<size_t>(graph.node(y).rows) * static_cast<size_t>(graph.node(y).cols));
  for (double& w : weights) w = rng.Normal();
  const Value weighted = graph.Dot(y, graph.ConstantData(weights, graph.node(y).rows, graph.node(y).cols));
  const Value loss = graph.Add(weighted, graph.Scale(graph.Dot(y, y), 0.5));

  const std::vector<Value> gradient = Gradient(&graph, loss, arguments);
  std::vector<Seed> seeds;
  for (size_t i = 0; i < arguments.size(); ++i) seeds.push_back({arguments[i], directions[i]});
  const auto or_zero = [&graph](Value v, const Node like) {
    return v == kNoValue ? graph.Constant(0, like.rows, like.cols) : v;
  };
  const Value slope = or_zero(Jvp(&graph, seeds, {loss})[0], graph.node(loss));
  std::vector<Value> forward_over_reverse = Jvp(&graph, seeds, gradient);
  for (size_t i = 0; i < arguments.size(); ++i) {
    forward_over_reverse[i] = or_zero(forward_over_reverse[i], graph.node(arguments[i]));
  }
  const std::vector<Value> reverse_over_forward = Gradient(&graph, slope, arguments);

  std::vector<double> x(static_cast<size_t>(size)), v(x.size());
  for (double& value : x) value = rng.Normal();
  for (double& value : v) value = rng.Normal();
  const std::vector<double> g = EvaluateFlat(graph, gradient, {x, v});
  const double jvp = EvaluateFlat(graph, {slope}, {x, v})[0];
  const std::vector<double> hv = EvaluateFlat(graph, forward_over_reverse, {x, v});
  const std::vector<double> hv2 = EvaluateFlat(graph, reverse_over_forward, {x, v});

  const auto norm = [](const std::vector<double>& a) {
    double sum = 0;
    for (const double value : a) sum += value * value;
    return std::sqrt(sum);
  };
  const double step = 1e-5;
  const auto shifted = [&](double h) {
    std::vector<double> moved = x;
    for (size_t i = 0; i < x.size(); ++i) moved[i] += h * v[i];
    return moved;
  };
  const std::vector<double> up = shifted(step), down = shifted(-step);
  const double slope_fd =
      (EvaluateFlat(graph, {loss}, {up, v})[0] - EvaluateFlat(graph, {loss}, {down, v})[0]) / (2 * step);
  double g_dot_v = 0;
  for (size_t i = 0; i < x.size(); ++i) g_dot_v += g[i] * v[i];
  const double scale = 1 + norm(g) * norm(v);
  EXPECT_NEAR(jvp, g_dot_v, 1e-12 * scale) << "forward and reverse mode disagree";
  EXPECT_NEAR(jvp, slope_fd, tolerance * scale) << "directional derivative against central difference";
  for (size_t i = 0; i < x.size(); ++i) {
    std::vector<double> plus = x, minus = x;
    plus[i] += step;
    minus[i] -= step;
    const double fd =
        (EvaluateFlat(graph, {loss}, {plus, v})[0] - EvaluateFlat(graph, {loss}, {minus, v})[0]) / (2 * step);
    EXPECT_NEAR(g[i], fd, tolerance * (1 + norm(g))) << "gradient element " << i;
  }
  const std::vector<double> g_up = EvaluateFlat(graph, gradient, {up, v});
  const std::vector<double> g_down = EvaluateFlat(graph, gradient, {down, v});
  for (size_t i = 0; i < x.size(); ++i) {
    EXPECT_NEAR(hv[i], hv2[i], 1e-11 * (1 + norm(hv))) << "element " << i;
    EXPECT_NEAR(hv[i], (g_up[i] - g_down[i]) / (2 * step), tolerance * (1 + norm(hv))) << "element " << i;
  }
}

}  // namespace metaekf::autodiff
