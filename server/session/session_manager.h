#pragma once

#include <chrono>
#include <condition_variable>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/metrics/metrics.h"
#include "server/serving/model_cache.h"
#include "server/session/batch_queue.h"
#include "server/store/store.h"

namespace metaekf::server {

/// Sessions between their streams and the store. Safe to call concurrently; Open, Resume, Flush and Delete block on
/// SQL and files.
class SessionManager {
 public:
  /// @param period  between checkpoints; 0: only at the end of a stream and of the manager.
  SessionManager(store::Store& store, ModelCache& models, std::shared_ptr<Metrics> metrics, absl::Duration period);
  ~SessionManager();

  /// @param mine  of the caller's tenant, here and below.
  absl::StatusOr<std::shared_ptr<LiveSession>> Open(store::TenantStore& mine, const v1::OpenSession& open);
  absl::StatusOr<std::shared_ptr<LiveSession>> Resume(store::TenantStore& mine, const v1::ResumeSession& resume);

  /// Notes that samples were applied: they become durable with the next commit.
  void MarkDirty(const std::shared_ptr<LiveSession>& live);
  /// The stream has ended; what its client may go on behind is still written.
  /// @param all_arrived  the client has ended it after all answers.
  void Close(const std::shared_ptr<LiveSession>& live, bool all_arrived);
  /// Writes what is dirty now.
  void Flush();

  /// What streams have sessions now, by tenant.
  std::map<std::string, int64_t> CountStreaming();
  /// How long samples wait, that have been applied, to become durable; 0 if none waits.
  absl::Duration CheckpointLag();

  absl::StatusOr<v1::Session> Get(store::TenantStore& mine, const std::string& name);
  absl::StatusOr<v1::ListSessionsResponse> List(store::TenantStore& mine, const v1::ListSessionsRequest& request);
  absl::Status Delete(store::TenantStore& mine, const std::string& name);

 private:
  /// Puts a session behind its stream, and tells the stream that had it before.
  std::shared_ptr<LiveSession> Attach(const std::string& tenant, const store::Session& stored, const std::string& token, std::unique_ptr<Session> session,
                                      const std::shared_ptr<const filter::FilterModel>& model);
  std::shared_ptr<BatchQueue> QueueOf(const std::shared_ptr<const filter::FilterModel>& model);
  v1::Session ToMessage(const std::string& tenant, const store::Session& stored);
  /// The stream's that has it, or null.
  std::shared_ptr<LiveSession> FindLive(const std::string& tenant, int64_t number);
  void RunCheckpoints();

  store::Store& store_;
  ModelCache& models_;
  const std::shared_ptr<Metrics> metrics_;
  const std::chrono::nanoseconds period_;
  std::mutex mutex_;
  std::map<std::pair<std::string, int64_t>, std::shared_ptr<LiveSession>> live_;  // by tenant and number
  std::set<std::shared_ptr<LiveSession>> dirty_;
  absl::Time dirty_since_ = absl::InfiniteFuture();  // the first of them
  absl::Time flushed_since_ = absl::InfiniteFuture();  // the first of those that are being written
  std::vector<std::weak_ptr<BatchQueue>> queues_;
  bool closed_ = false;  // a stream has, since the last commit
  bool stopping_ = false;
  std::condition_variable changed_;
  std::mutex flush_mutex_;  // one commit at a time
  std::thread checkpoints_;
};

}  // namespace metaekf::server
