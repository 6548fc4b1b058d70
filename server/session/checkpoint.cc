#include "server/session/checkpoint.h"

#include <cstring>

namespace metaekf::server {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr uint64_t kVersion = 4;

uint64_t Fnv1a(const char* data, size_t size) {
  uint64_t hash = 0xcbf29ce484222325;
  for (size_t i = 0; i < size; ++i) hash = (hash ^ static_cast<unsigned char>(data[i])) * 0x100000001b3;
  return hash;
}

/// Words of 8 bytes, one after the other.
class Words {
 public:
  Words() = default;
  explicit Words(const std::string& bytes) : bytes_(bytes) {}

  template <typename T>
  void Put(T value) {
    static_assert(sizeof(T) == 8);
    bytes_.append(reinterpret_cast<const char*>(&value), 8);
  }
  template <typename T>
  T Take() {
    static_assert(sizeof(T) == 8);
    T value{};
    if (at_ + 8 <= bytes_.size()) std::memcpy(&value, bytes_.data() + at_, 8);
    at_ += 8;
    return value;
  }

  void PutAll(const double* values, Index count) {
    for (Index i = 0; i < count; ++i) Put(values[i]);
  }
  void TakeAll(double* values, Index count) {
    for (Index i = 0; i < count; ++i) values[i] = Take<double>();
  }

  /// Words that are not taken yet.
  int64_t left() const { return (static_cast<int64_t>(bytes_.size()) - static_cast<int64_t>(at_)) / 8; }
  bool AtEnd() const { return at_ == bytes_.size(); }
  const std::string& bytes() const { return bytes_; }

 private:
  std::string bytes_;
  size_t at_ = 0;
};

void PutState(const filter::FilterState& state, Words* words) {
  words->Put(state.samples);
  words->Put(state.nis.nis);
  words->Put(state.nis.measured);
  words->Put(state.nis.samples);
  words->Put(state.nis.correlation);
  words->Put(state.nis.past_square);
  words->Put(state.nis.pairs);
  words->Put(static_cast<int64_t>(state.nis.past.size()));
  words->PutAll(state.nis.past.data(), state.nis.past.size());
  words->Put(state.gated_in_row);
  words->Put(static_cast<int64_t>(state.started));
  words->Put(static_cast<int64_t>(state.diverged));
  words->Put(static_cast<int64_t>(state.window.size()));
  words->PutAll(state.mean.data(), state.mean.size());
  words->PutAll(state.factor.data(), state.factor.size());
  words->PutAll(state.last_input.data(), state.last_input.size());
  words->PutAll(state.window.data(), static_cast<Index>(state.window.size()));
}

/// @return whether the words were there.
bool TakeState(Words* words, filter::FilterState* state) {
  state->samples = words->Take<int64_t>();
  state->nis.nis = words->Take<double>();
  state->nis.measured = words->Take<double>();
  state->nis.samples = words->Take<int64_t>();
  state->nis.correlation = words->Take<double>();
  state->nis.past_square = words->Take<double>();
  state->nis.pairs = words->Take<int64_t>();
  const int64_t past = words->Take<int64_t>();
  if (past < 0 || past > words->left()) return false;
  state->nis.past.resize(past);
  words->TakeAll(state->nis.past.data(), past);
  state->gated_in_row = words->Take<int64_t>();
  state->started = words->Take<int64_t>() != 0;
  state->diverged = words->Take<int64_t>() != 0;
  const int64_t window = words->Take<int64_t>();
  if (window < 0 || window > words->left()) return false;
  words->TakeAll(state->mean.data(), state->mean.size());
  words->TakeAll(state->factor.data(), state->factor.size());
  words->TakeAll(state->last_input.data(), state->last_input.size());
  state->window.assign(static_cast<size_t>(window), 0);
  words->TakeAll(state->window.data(), window);
  return true;
}

void PutSample(const filter::Sample& sample, Words* words) {
  words->PutAll(sample.input.data(), sample.input.size());
  words->PutAll(sample.output.data(), sample.output.size());
  words->Put(static_cast<int64_t>(sample.measurement_cov.has_value()));
  if (sample.measurement_cov) words->PutAll(sample.measurement_cov->data(), sample.measurement_cov->size());
}

filter::Sample TakeSample(Index n_u, Index n_y, Words* words) {
  filter::Sample sample{.input = VectorXd(n_u), .output = VectorXd(n_y)};
  words->TakeAll(sample.input.data(), n_u);
  words->TakeAll(sample.output.data(), n_y);
  if (words->Take<int64_t>() == 0) return sample;
  sample.measurement_cov = MatrixXd(n_y, n_y);
  words->TakeAll(sample.measurement_cov->data(), n_y * n_y);
  return sample;
}

}  // namespace

std::string Encode(const Checkpoint& checkpoint) {
  Words words;
  words.Put(kVersion);
  words.Put(checkpoint.seq);
  words.Put(checkpoint.time_s);
  PutState(checkpoint.state, &words);
  words.Put(static_cast<int64_t>(checkpoint.samples.size()));
  for (const filter::Sample& sample : checkpoint.samples) PutSample(sample, &words);
  words.Put(Fnv1a(words.bytes().data(), words.bytes().size()));
  return words.bytes();
}

absl::StatusOr<Checkpoint> DecodeCheckpoint(const std::string& bytes, const filter::FilterState& state, Index n_y) {
  const absl::Status damaged = absl::DataLossError("the session's checkpoint is damaged");
  if (bytes.size() < 8) return damaged;
  Words checksum(bytes.substr(bytes.size() - 8));
  if (checksum.Take<uint64_t>() != Fnv1a(bytes.data(), bytes.size() - 8)) return damaged;
  Words words(bytes.substr(0, bytes.size() - 8));
  if (words.Take<uint64_t>() != kVersion) {
    return absl::FailedPreconditionError("the session's checkpoint was written by another version of the server");
  }
  Checkpoint checkpoint;
  checkpoint.seq = words.Take<uint64_t>();
  checkpoint.time_s = words.Take<double>();
  checkpoint.state = state;
  if (!TakeState(&words, &checkpoint.state)) return damaged;
  const int64_t samples = words.Take<int64_t>();
  if (samples < 0 || samples > words.left()) return damaged;
  for (int64_t i = 0; i < samples; ++i) checkpoint.samples.push_back(TakeSample(state.last_input.size(), n_y, &words));
  if (!words.AtEnd()) return damaged;
  return checkpoint;
}

}  // namespace metaekf::server
