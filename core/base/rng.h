#pragma once

#include <array>
#include <cstdint>

namespace metaekf::base {

/// A seeded generator of random numbers: xoshiro256++ (Blackman and Vigna, 2019), seeded by SplitMix64.
///
/// The same (seed, stream) gives the same numbers on every machine and compiler, which the
/// distributions of the standard library do not promise. `stream` sets apart the independent draws
/// of one seed (one per system, task or restart), so that results do not depend on the order or the
/// number of threads that make them.
class Rng {
 public:
  explicit Rng(uint64_t seed, uint64_t stream = 0);

  uint64_t NextBits();
  /// Uniform on [0, 1), 53 bits.
  double Uniform();
  double Uniform(double low, double high) { return low + (high - low) * Uniform(); }
  /// Standard normal, by Box and Muller's transformation.
  double Normal();
  /// Uniform on 0 … n−1, unbiased. n must be positive.
  uint64_t Index(uint64_t n);

  /// The whole state, for checkpoints: four words, and the spare normal deviate with its flag.
  struct State {
    std::array<uint64_t, 4> words;
    double spare_normal;
    bool has_spare;
  };
  State state() const { return {words_, spare_normal_, has_spare_}; }
  static Rng FromState(const State& state);

 private:
  Rng() = default;

  std::array<uint64_t, 4> words_{};
  double spare_normal_ = 0;
  bool has_spare_ = false;
};

}  // namespace metaekf::base
