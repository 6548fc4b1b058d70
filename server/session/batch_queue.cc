#include "server/session/batch_queue.h"

#include <utility>

#include "server/status/details.h"

namespace metaekf::server {

using std::chrono::steady_clock;

namespace {

constexpr int kWorkers = 2;
constexpr size_t kMostTogether = 8;              // FilterModel takes so many points at once
constexpr std::chrono::milliseconds kTurn(10);  // others want the thread, too

}  // namespace

absl::Status TakenOver() {
  return WithReason(absl::AbortedError("another stream has resumed the session, or it was deleted"), "SESSION_TAKEN_OVER", {});
}

void CompleteAnswer(const v1::SampleBatch& batch, LiveSession& live, v1::EstimateBatch* estimates) {
  if (batch.has_received_seq()) {
    const uint64_t told = std::min(batch.received_seq(), live.session->applied_seq());
    live.received_seq = std::max(live.received_seq.value_or(live.durable_seq), told);
  }
  estimates->set_durable_seq(live.durable_seq);
  if (estimates->nis().empty()) estimates->set_first_seq(live.session->applied_seq());
}

struct BatchQueue::Lane {
  explicit Lane(Batch b) : batch(std::move(b)), lock(batch.live->mutex) {}

  absl::Status Begin() {
    if (batch.live->taken_over) return TakenOver();
    return session().Begin(*batch.samples, batch.goes_on, batch.estimates, &application);
  }
  Session& session() const { return *batch.live->session; }
  void End(const absl::Status& status) {
    CompleteAnswer(*batch.samples, *batch.live, batch.estimates);
    lock.unlock();
    batch.done(status, cost);
  }

  Batch batch;
  std::unique_lock<std::mutex> lock;
  Session::Application application;
  steady_clock::duration cost{};
};

std::unique_ptr<BatchQueue::Scratch> BatchQueue::Take() {
  {
    std::lock_guard lock(mutex_);
    if (!free_.empty()) {
      auto scratch = std::move(free_.back());
      free_.pop_back();
      return scratch;
    }
  }
  return model_->MakeScratch();
}

void BatchQueue::GiveBack(std::unique_ptr<Scratch> scratch) {
  std::lock_guard lock(mutex_);
  free_.push_back(std::move(scratch));
}

bool BatchQueue::Enter() {
  std::lock_guard lock(mutex_);
  if (workers_ == kWorkers || !waiting_.empty()) return false;
  ++workers_;
  return true;
}

bool BatchQueue::Leave() {
  std::lock_guard lock(mutex_);
  if (!waiting_.empty()) return true;
  --workers_;
  return false;
}

bool BatchQueue::Add(Batch batch) {
  std::lock_guard lock(mutex_);
  waiting_.push_back(std::move(batch));
  if (workers_ == kWorkers) return false;
  ++workers_;
  return true;
}

bool BatchQueue::Work() {
  const steady_clock::time_point end = steady_clock::now() + kTurn;
  std::unique_ptr<Scratch> scratch = Take();
  Lanes lanes;
  do {
    if (steady_clock::now() < end) Fill(&lanes);
    Advance(&lanes, scratch.get());
  } while (!lanes.empty());
  GiveBack(std::move(scratch));
  return Leave();
}

void BatchQueue::Fill(Lanes* lanes) {
  std::vector<Batch> taken;
  {
    std::lock_guard lock(mutex_);
    for (; !waiting_.empty() && lanes->size() + taken.size() < kMostTogether; waiting_.pop_front()) taken.push_back(std::move(waiting_.front()));
  }
  for (Batch& batch : taken) {
    auto lane = std::make_unique<Lane>(std::move(batch));
    const absl::Status status = lane->Begin();
    if (status.ok()) {
      lanes->push_back(std::move(lane));
    } else {
      lane->End(status);
    }
  }
}

void BatchQueue::Advance(Lanes* lanes, Scratch* scratch) {
  Lanes going;
  std::vector<filter::NextReplaySample> steps;
  for (std::unique_ptr<Lane>& lane : *lanes) {
    filter::NextReplaySample step;
    const absl::StatusOr<bool> more = lane->session().Next(&lane->application, scratch, &step);
    if (more.ok() && *more) {
      steps.push_back(std::move(step));
      going.push_back(std::move(lane));
    } else {
      lane->End(more.status());
    }
  }
  lanes->clear();
  const steady_clock::time_point start = steady_clock::now();
  StepTogether(std::span<filter::NextReplaySample>(steps), scratch);
  const steady_clock::duration taken = steady_clock::now() - start;
  for (size_t i = 0; i < steps.size(); ++i) {
    going[i]->cost += taken / static_cast<int64_t>(steps.size());
    const absl::Status taught = going[i]->session().Taught(steps[i], &going[i]->application);
    if (taught.ok()) {
      lanes->push_back(std::move(going[i]));
    } else {
      going[i]->End(taught);
    }
  }
}

}  // namespace metaekf::server
