#pragma once

#include <grpcpp/grpcpp.h>

#include <chrono>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>

#include "metaekf/v1/estimation.pb.h"
#include "server/executor/give_way.h"
#include "server/handlers/unary_call.h"
#include "server/metrics/metrics.h"
#include "server/session/estimation_service.h"

namespace metaekf::server {

/// One stream: open or resume, then batch by batch. At any time at most one read and one write are in flight and one
/// batch is in work; the next batch, or the rest of a large one, waits for the response before it. Deletes itself when it is done.
class EstimateStream : public grpc::ServerBidiReactor<v1::EstimateRequest, v1::EstimateResponse> {
 public:
  EstimateStream(EstimationService* service, grpc::CallbackServerContext* context, std::shared_ptr<CallRecord> record, Caller caller);

  void Start(bool draining);

  void OnReadDone(bool ok) override;
  void OnWriteDone(bool ok) override;
  void OnCancel() override;
  void OnDone() override;

  /// First half of a drain: applies nothing more.
  void StopApplying();
  /// Second half: all that was applied is durable.
  void EndForDrain();

  /// Ends a stream whose client does not read or whose session is no longer its own.
  void Sweep(std::chrono::steady_clock::time_point now);
  void Cancel() { context_->TryCancel(); }

  /// What the stream holds while it waits for its client, and since when; nothing if it is at work or has not waited long.
  std::optional<std::pair<std::chrono::steady_clock::time_point, int64_t>> Waits(std::chrono::steady_clock::time_point now);
  /// Ends it for what it holds.
  void Shed();

 private:
  // With mutex_ held, all but the last four.
  void End(absl::Status status);
  void EndForMemory(const char* advice);
  /// Starts whatever may start now; every event ends here.
  void Advance();
  void StartNext();
  void StartWork();
  void Read();
  void WorkDone(const absl::Status& status);
  /// Whether the answer does not reach the batch's end: it holds so much and no more.
  bool HasRest() const;
  /// Tells the service how much the stream holds.
  void Account();
  /// After each batch.
  void Count(const v1::EstimateBatch& estimates);
  /// Whether work_ may be done in a reaction: others wait meanwhile.
  bool IsShort();
  void TookPerValue(std::chrono::steady_clock::duration time);
  /// Whether batches of many sessions of this model are applied together where they wait.
  bool Queues() const;
  /// Whether what comes next may be worked on. Beyond its tenant's rate a request waits, and with it the client; so it does where its
  /// answer would be one too many to hold. The next sweep looks again. Only while goes_on_ or has_request_: else request_ is being read.
  bool MayWork() const;
  /// Outputs that are estimated, which is what work takes time for.
  int64_t ValuesOf(const v1::EstimateRequest& work) const;

  /// Runs one of the next two as a background thread's work.
  template <typename Function>
  void Work(const Function& function);
  absl::Status OpenOrResume();
  absl::Status Apply();
  void Applied(const absl::Status& status, std::chrono::steady_clock::duration cost);

  EstimationService& service_;
  grpc::CallbackServerContext* const context_;
  const FreeProcessor free_processor_;
  const std::shared_ptr<CallRecord> record_;
  const Caller caller_;  // and not what its tenant has: streams are many, and need it once
  SampleRate* const rate_;  // of its tenant; null: as fast as it likes
  const StreamCounters counters_;
  v1::EstimateRequest request_;    // being read, or waiting
  v1::EstimateRequest work_;       // being worked on
  v1::EstimateResponse response_;  // being made or written
  std::shared_ptr<LiveSession> live_;
  int64_t output_size_ = 0;
  int64_t row_bytes_ = 0;
  std::chrono::steady_clock::duration time_per_value_{}, last_time_per_value_{};  // of outputs in a batch, as measured
  uint64_t rush_ = 0;  // for Crowd

  std::mutex mutex_;  // guards everything; batches themselves are applied without it
  bool reading_ = false;
  bool has_request_ = false;  // request_ holds a request that waits
  bool half_closed_ = false;
  bool working_ = false;
  bool goes_on_ = false;  // work_ has a rest, for the next answer
  bool writing_ = false;
  bool stop_applying_ = false;
  bool finished_ = false;
  std::optional<absl::Status> finish_with_;
  std::chrono::steady_clock::time_point read_time_;   // of request_
  std::chrono::steady_clock::time_point work_time_;   // when work_ was read
  std::chrono::steady_clock::time_point write_start_;
  int64_t answer_bytes_ = 0;   // of response_
  int64_t counted_bytes_ = 0;  // that the service knows of
};

}  // namespace metaekf::server
