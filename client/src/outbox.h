#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>

#include "metaekf/v1/estimation.pb.h"

namespace metaekf::client {

/// What a stream has sent and may have to send again: samples until they are durable, forecasts until they are answered.
/// In order. Not safe to call concurrently.
class Outbox {
 public:
  struct Entry {
    uint64_t id = 0;        ///< counts entries from 1
    uint64_t last_seq = 0;  ///< of its samples; 0: it asks for a forecast
    std::shared_ptr<const v1::EstimateRequest> request;  ///< which may be forgotten while it is being written
  };

  /// Numbers the samples, the next after the last.
  Entry Add(v1::SampleBatch batch, size_t samples);
  Entry Add(v1::ForecastRequest forecast);

  /// A stream begins after this sample: numbers go on from there.
  void Begin(uint64_t durable_seq);
  /// An answer came. @param keep  samples beyond what is durable that are kept if nothing ever becomes durable.
  void Answered(uint64_t last_seq, uint64_t durable_seq, size_t keep);
  void ForecastAnswered();
  /// The server refuses what comes after the last answer: numbers go on from there.
  void Refused();

  /// The first entry after this id that is still here.
  std::optional<Entry> After(uint64_t id) const;
  /// The first sample that can be sent again.
  uint64_t oldest_seq() const;

  uint64_t sent_seq() const { return sent_seq_; }
  uint64_t answered_seq() const { return answered_seq_; }
  uint64_t durable_seq() const { return durable_seq_; }

 private:
  void Forget(size_t keep);

  std::deque<Entry> entries_;
  uint64_t next_id_ = 1;
  uint64_t sent_seq_ = 0;
  uint64_t answered_seq_ = 0;
  uint64_t durable_seq_ = 0;
};

}  // namespace metaekf::client
