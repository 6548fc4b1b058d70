#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

#include "metaekf/client.h"

/// What a stream of a test sends, and what it keeps of what comes back.
namespace metaekf::testing {

/// Samples of a system that nobody but the test knows: one input, one output, one value in seven not measured.
inline client::SampleBatch SignalSamples(int stream, uint64_t first_seq, size_t count) {
  client::SampleBatch batch{.samples = count};
  for (size_t i = 0; i < count; ++i) {
    const double t = static_cast<double>(first_seq + i);
    batch.inputs.push_back(std::sin(0.1 * t + stream));
    const bool missing = (first_seq + i + static_cast<uint64_t>(stream)) % 7 == 0;
    batch.outputs.push_back(missing ? std::nan("")
                                    : 0.5 * std::cos(0.1 * t) + 0.1 * std::sin(31.7 * t * (stream + 1)));
  }
  return batch;
}

/// A digest of all bits of all means and covariances, in order (FNV-1a).
class EstimateDigest {
 public:
  void Add(const client::EstimateBatch& batch) {
    const size_t n = batch.means.size() / batch.samples, triangle = batch.covariances.size() / batch.samples;
    for (size_t i = 0; i < batch.samples; ++i) {
      for (size_t k = 0; k < n; ++k) Add(batch.means[i * n + k]);
      for (size_t k = 0; k < triangle; ++k) Add(batch.covariances[i * triangle + k]);
    }
  }
  uint64_t value() const { return value_; }

 private:
  void Add(double number) {
    for (uint64_t bits = std::bit_cast<uint64_t>(number), byte = 0; byte < 8; ++byte, bits >>= 8) {
      value_ = (value_ ^ (bits & 0xff)) * 0x100000001b3;
    }
  }
  uint64_t value_ = 0xcbf29ce484222325;
};

}  // namespace metaekf::testing
