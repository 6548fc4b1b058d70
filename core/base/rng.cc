#include "core/base/rng.h"

#include <bit>
#include <cmath>
#include <numbers>

namespace metaekf::base {
namespace {

uint64_t SplitMix64(uint64_t& state) {
  uint64_t z = (state += 0x9e3779b97f4a7c15);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
  z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
  return z ^ (z >> 31);
}

}  // namespace

Rng::Rng(uint64_t seed, uint64_t stream) {
  // Hashing the seed before the stream is mixed in keeps (seed, stream) and (seed + 1, stream − 1) apart.
  uint64_t state = seed;
  state = SplitMix64(state) ^ (stream * 0xd1342543de82ef95 + 1);
  for (uint64_t& word : words_) word = SplitMix64(state);
}

Rng Rng::FromState(const State& state) {
  Rng rng;
  rng.words_ = state.words;
  rng.spare_normal_ = state.spare_normal;
  rng.has_spare_ = state.has_spare;
  return rng;
}

uint64_t Rng::NextBits() {
  const uint64_t result = std::rotl(words_[0] + words_[3], 23) + words_[0];
  const uint64_t shifted = words_[1] << 17;
  words_[2] ^= words_[0];
  words_[3] ^= words_[1];
  words_[1] ^= words_[2];
  words_[0] ^= words_[3];
  words_[2] ^= shifted;
  words_[3] = std::rotl(words_[3], 45);
  return result;
}

double Rng::Uniform() { return static_cast<double>(NextBits() >> 11) * 0x1.0p-53; }

double Rng::Normal() {
  if (has_spare_) {
    has_spare_ = false;
    return spare_normal_;
  }
  // 1 − U lies in (0, 1], so the logarithm is finite.
  const double radius = std::sqrt(-2.0 * std::log(1.0 - Uniform()));
  const double angle = 2.0 * std::numbers::pi * Uniform();
  spare_normal_ = radius * std::sin(angle);
  has_spare_ = true;
  return radius * std::cos(angle);
}

uint64_t Rng::Index(uint64_t n) {
  // Draws below the largest multiple of n; the rest would favour small indices.
  const uint64_t rejected_below = (0 - n) % n;
  uint64_t bits = NextBits();
  while (bits < rejected_below) bits = NextBits();
  return bits % n;
}

}  // namespace metaekf::base
