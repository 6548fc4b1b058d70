// The kernels one by one, beside what the machine allows (README.md).
//
// Counters: "ops" operations per second, "bytes" that must be read or written per second at least, "of_ceiling" the share of the roofline:
// the time that the operations or the bytes take at best, over the time taken.

#include <benchmark/benchmark.h>

#include <vector>

#include "core/autodiff/activation.h"
#include "core/autodiff/kernel.h"
#include "core/base/rng.h"
#include "core/filter/square_root.h"
#include "core/linalg/products.h"
#include "tests/benchmark/ceilings.h"
#include "tests/benchmark/filter_steps.h"
#include "tests/benchmark/networks.h"

namespace metaekf::benchmark {
namespace {

using ::benchmark::Counter;
using ::benchmark::State;

template <typename T>
std::vector<T> Random(int64_t size) {
  base::Rng rng(1);
  std::vector<T> values(static_cast<size_t>(size));
  for (T& value : values) value = static_cast<T>(rng.Normal());
  return values;
}

/// @param operations, bytes  of one iteration.
template <typename T>
void Report(State& state, double operations, double bytes) {
  state.counters["ops"] = Counter(operations, Counter::kIsIterationInvariantRate);
  state.counters["bytes"] = Counter(bytes, Counter::kIsIterationInvariantRate, Counter::kIs1024);
  state.counters["of_ceiling"] = Counter(Ceilings::Measured().Seconds<T>(operations, bytes), Counter::kIsIterationInvariantRate);
}

/// op(A) op(B), m × k and k × n.
template <typename T>
void Product(State& state, bool transpose_a, bool transpose_b) {
  const auto m = static_cast<int32_t>(state.range(0)), n = static_cast<int32_t>(state.range(1)), k = static_cast<int32_t>(state.range(2));
  const std::vector<T> a = Random<T>(int64_t{m} * k), b = Random<T>(int64_t{k} * n);
  std::vector<T> c(static_cast<size_t>(m) * static_cast<size_t>(n));
  for ([[maybe_unused]] const auto _ : state) {
    linalg::MatMul(transpose_a, transpose_b, m, n, k, a.data(), transpose_a ? k : m, b.data(), transpose_b ? n : k, c.data(), m, false);
    ::benchmark::ClobberMemory();
  }
  Report<T>(state, 2.0 * m * n * k, static_cast<double>(sizeof(T) * (a.size() + b.size() + c.size())));
}

void FloatProduct(State& state, bool transpose_a, bool transpose_b) { Product<float>(state, transpose_a, transpose_b); }
void DoubleProduct(State& state, bool transpose_a, bool transpose_b) { Product<double>(state, transpose_a, transpose_b); }

void Elementwise(State& state) {
  const int64_t size = state.range(0);
  const std::vector<float> a = Random<float>(size), b = Random<float>(size);
  std::vector<float> out(a.size());
  const autodiff::Instruction i{.op = autodiff::Opcode::kMul, .rows = static_cast<int32_t>(size), .cols = 1};
  const autodiff::Places<float> at{.out = out.data(), .a = a.data(), .b = b.data(), .c = nullptr, .panel = nullptr};
  const autodiff::Kernel<float> kernel = autodiff::SelectKernel<float>(i);
  for ([[maybe_unused]] const auto _ : state) {
    kernel(i, at);
    ::benchmark::ClobberMemory();
  }
  Report<float>(state, static_cast<double>(size), 3.0 * sizeof(float) * static_cast<double>(size));
}

/// Operations are not counted: what a function takes is its own affair.
void Activation(State& state, autodiff::Activation activation) {
  const std::vector<float> z = Random<float>(state.range(0));
  std::vector<float> out(z.size());
  for ([[maybe_unused]] const auto _ : state) {
    autodiff::ApplyActivation(activation, 0, 0.0f, z.data(), out.data(), z.size());
    ::benchmark::ClobberMemory();
  }
  Report<float>(state, 0, 2.0 * sizeof(float) * static_cast<double>(z.size()));
}

/// The lower triangle of C += A Aᵀ: the normal matrix of a second-order fit.
void Square(State& state) {
  const auto m = static_cast<int32_t>(state.range(0)), k = static_cast<int32_t>(state.range(1));
  const std::vector<double> a = Random<double>(int64_t{m} * k);
  std::vector<double> c(static_cast<size_t>(m) * static_cast<size_t>(m));
  for ([[maybe_unused]] const auto _ : state) {
    linalg::AddSquare(m, k, a.data(), m, c.data(), m);
    ::benchmark::ClobberMemory();
  }
  Report<double>(state, double{1} * m * (m + 1) * k, static_cast<double>(sizeof(double) * (a.size() + c.size())));
}

/// A time update's factor, n × 2n, made lower triangular: 2 n²(2n − n/3) operations to leading order.
void Triangularise(State& state) {
  const Eigen::Index n = state.range(0);
  base::Rng rng(1);
  const Eigen::MatrixXd from = Eigen::MatrixXd::NullaryExpr(n, 2 * n, [&] { return rng.Normal(); });
  Eigen::MatrixXd work = from;
  for ([[maybe_unused]] const auto _ : state) {
    work = from;
    filter::LowerTriangularise(work);
    ::benchmark::ClobberMemory();
  }
  const double size = static_cast<double>(n);
  Report<double>(state, 2 * size * size * (2 * size - size / 3), 2 * 8.0 * size * 2 * size);
}

/// The gradient of a free run: each step waits for the last, so no ceiling but latency's; time per step is what counts.
void RolloutGradient(State& state) {
  SmallRollout rollout(state.range(0));
  for ([[maybe_unused]] const auto _ : state) rollout.ComputeGradient();
  state.counters["steps"] = Counter(static_cast<double>(state.range(0)), Counter::kIsIterationInvariantRate);
}

/// A sample of the van der Pol model that ships: two states, each operation waits for the last.
void FilterStep(State& state) {
  FilterSteps filter(ZooModel("van-der-pol"), Oscillation(200));
  for ([[maybe_unused]] const auto _ : state) filter.Step();
}

// A layer of the localisation network and a context of 80 samples, halved between two threads; a sample with its three tangents.
BENCHMARK_CAPTURE(FloatProduct, forward, true, false)->Args({256, 80, 256})->Args({256, 40, 256})->Args({256, 4, 256})->Args({256, 1, 256});
BENCHMARK_CAPTURE(FloatProduct, backward, false, false)->Args({256, 80, 256})->Args({256, 40, 256})->Args({256, 4, 256});
BENCHMARK_CAPTURE(FloatProduct, gradient, false, true)->Args({256, 256, 80})->Args({256, 256, 40});
BENCHMARK_CAPTURE(DoubleProduct, forward, true, false)->Args({256, 80, 256})->Args({256, 4, 256});
BENCHMARK(Elementwise)->Arg(16)->Arg(256 * 40)->Arg(256 * 80);
BENCHMARK_CAPTURE(Activation, tanh, autodiff::Activation::kTanh)->Arg(16)->Arg(256 * 40);
BENCHMARK_CAPTURE(Activation, swish, autodiff::Activation::kSwish)->Arg(16)->Arg(256 * 40);
BENCHMARK(Square)->Args({144, 8192});
BENCHMARK(Triangularise)->Arg(4)->Arg(24);
BENCHMARK(RolloutGradient)->Arg(4096);
BENCHMARK(FilterStep);

}  // namespace
}  // namespace metaekf::benchmark

BENCHMARK_MAIN();
