#include "client/src/outbox.h"

#include <algorithm>
#include <limits>
#include <utility>

namespace metaekf::client {

Outbox::Entry Outbox::Add(v1::SampleBatch batch, size_t samples) {
  batch.set_first_seq(sent_seq_ + 1);
  batch.set_received_seq(answered_seq_);
  sent_seq_ += samples;
  const auto request = std::make_shared<v1::EstimateRequest>();
  *request->mutable_samples() = std::move(batch);
  return entries_.emplace_back(Entry{next_id_++, sent_seq_, request});
}

Outbox::Entry Outbox::Add(v1::ForecastRequest forecast) {
  const auto request = std::make_shared<v1::EstimateRequest>();
  *request->mutable_forecast() = std::move(forecast);
  return entries_.emplace_back(Entry{next_id_++, 0, request});
}

void Outbox::Begin(uint64_t durable_seq) {
  durable_seq_ = answered_seq_ = durable_seq;
  sent_seq_ = std::max(sent_seq_, durable_seq);
  Forget(std::numeric_limits<size_t>::max());
}

void Outbox::Answered(uint64_t last_seq, uint64_t durable_seq, size_t keep) {
  answered_seq_ = std::max(answered_seq_, last_seq);
  durable_seq_ = std::max(durable_seq_, durable_seq);
  Forget(keep);
}

void Outbox::ForecastAnswered() {
  // Answers come in the order of what they answer.
  const auto asked = std::find_if(entries_.begin(), entries_.end(),
                                  [](const Entry& entry) { return entry.last_seq == 0; });
  if (asked != entries_.end()) entries_.erase(asked);
}

void Outbox::Refused() {
  std::erase_if(entries_, [this](const Entry& entry) { return entry.last_seq == 0 || entry.last_seq > answered_seq_; });
  sent_seq_ = answered_seq_;
}

void Outbox::Forget(size_t keep) {
  const auto durable = [this](const Entry& entry) {
    return entry.last_seq != 0 && entry.last_seq <= durable_seq_;
  };
  // A forecast that waits for its answer must come after the samples before it; those are not durable then.
  while (!entries_.empty() && durable(entries_.front())) entries_.pop_front();
  // Nothing is durable on a server that keeps sessions in memory only: waiting would be for ever.
  while (!entries_.empty() && durable_seq_ == 0 && entries_.front().last_seq != 0 &&
         entries_.front().last_seq <= answered_seq_ && sent_seq_ >= keep && oldest_seq() <= sent_seq_ - keep) {
    entries_.pop_front();
  }
}

std::optional<Outbox::Entry> Outbox::After(uint64_t id) const {
  const auto found = std::upper_bound(entries_.begin(), entries_.end(), id,
                                      [](uint64_t value, const Entry& entry) { return value < entry.id; });
  return found == entries_.end() ? std::nullopt : std::optional(*found);
}

uint64_t Outbox::oldest_seq() const {
  for (const Entry& entry : entries_) {
    if (entry.last_seq != 0) return entry.request->samples().first_seq();
  }
  return sent_seq_ + 1;
}

}  // namespace metaekf::client
