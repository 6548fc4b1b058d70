#pragma once

#include <chrono>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "server/session/session.h"

namespace metaekf::server {

class BatchQueue;

/// A session that a stream serves. `mutex` guards all but the constants.
struct LiveSession {
  std::string tenant;
  int64_t number = 0;
  uint64_t epoch = 0;
  std::string token;  ///< of a session just made; empty when resumed
  std::shared_ptr<BatchQueue> queue;

  std::mutex mutex;
  std::unique_ptr<Session> session;
  uint64_t durable_seq = 0;
  std::optional<uint64_t> received_seq;  ///< whose estimates have arrived, of clients that tell
  /// Of clients that tell: the session after samples whose estimates may not have arrived, the oldest first. Durable is what
  /// has: a client that was cut off goes on where it is, not where the server is.
  std::deque<std::pair<uint64_t, std::string>> waiting;
  bool taken_over = false;  ///< another stream has claimed the session
};

/// Applies batches to the sessions of one filter model.
///
/// A large model's weights are read anew for every sample, so batches that wait at the same time are applied sample by sample side by
/// side; each is done when its own samples are. None waits for one that has not come: while there are fewer than kWorkers at work, a
/// batch is applied at once and alone.
/// Safe to call concurrently.
class BatchQueue {
 public:
  using Scratch = filter::FilterModel::Scratch;
  struct Batch {
    std::shared_ptr<LiveSession> live;
    const v1::SampleBatch* samples = nullptr;
    bool goes_on = false;  ///< see Session::Apply
    v1::EstimateBatch* estimates = nullptr;
    /// @param cost  the batch's share of the time that it took.
    std::function<void(const absl::Status&, std::chrono::steady_clock::duration cost)> done;
  };

  explicit BatchQueue(std::shared_ptr<const filter::FilterModel> model) : model_(std::move(model)) {}

  const std::shared_ptr<const filter::FilterModel>& model() const { return model_; }

  /// Scratch memory for filters of the model.
  std::unique_ptr<Scratch> Take();
  void GiveBack(std::unique_ptr<Scratch> scratch);

  /// Whether the caller may apply a batch of its own now, alone. It then calls Leave.
  bool Enter();
  /// Whether batches wait: the caller then sees to it that Work is called.
  bool Leave();

  /// Whether the caller has to see to it that Work is called; else someone is at work who will come to it.
  bool Add(Batch batch);
  /// Applies what waits, for some milliseconds at most. @return whether batches wait still: the caller then sees to it that Work is called again.
  bool Work();

 private:
  /// A batch that is being applied, with its session's mutex held.
  struct Lane;

  using Lanes = std::vector<std::unique_ptr<Lane>>;
  /// Takes up batches that wait, as many as there is place for.
  void Fill(Lanes* lanes);
  /// A sample of each.
  static void Advance(Lanes* lanes, Scratch* scratch);

  const std::shared_ptr<const filter::FilterModel> model_;
  std::mutex mutex_;
  std::vector<std::unique_ptr<Scratch>> free_;
  std::deque<Batch> waiting_;
  int workers_ = 0;
};

/// That another stream has the session now.
absl::Status TakenOver();

/// Completes the answer to a batch with what the session knows, and notes what the batch tells; the session's mutex is held.
void CompleteAnswer(const v1::SampleBatch& batch, LiveSession& live, v1::EstimateBatch* estimates);

}  // namespace metaekf::server
