#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "server/store/models.h"

namespace metaekf::store {

enum class JobState { kQueued, kRunning, kSucceeded, kFailed, kCancelled };

struct Job {
  int64_t number = 0;
  std::string model;
  std::string spec_json;
  std::string dataset_digest;  ///< the blob is kept until the job has ended
  JobState state = JobState::kQueued;
  int64_t attempt = 0;   ///< how often a worker has taken it up
  int64_t failures = 0;  ///< attempts in a row that were lost without a checkpoint
  std::string worker;    ///< who has it, or had it last
  absl::Time lease_end;  ///< of kRunning
  std::string progress_json;
  std::string error;           ///< of kFailed, or why the last attempt was lost
  int64_t result_version = 0;  ///< of kSucceeded
  absl::Time create_time;
  absl::Time start_time;  ///< of the latest attempt; 1970 before the first
  absl::Time end_time;    ///< 1970 before the end
};

struct NewJob {
  std::string model;
  std::string spec_json;
  StagedBlob dataset;
  RequestId request;
};

/// A worker's right to a job. The attempt is a fencing token: once the job has been taken from the
/// worker, nothing that it still sends has any effect.
struct JobLease {
  std::string tenant;
  int64_t number = 0;
  int64_t attempt = 0;
};

/// Background jobs of a tenant. Safe to call concurrently. Errors of all: NotFound; the database's
/// own.
class JobStore {
 public:
  explicit JobStore(Context context) : context_(std::move(context)) {}

  /// Errors: InvalidArgument for a bad model name; AlreadyExists if the request.id was used with
  /// another fingerprint; those of quota.h.
  absl::StatusOr<Job> Create(NewJob job);
  absl::StatusOr<Job> Get(int64_t number);
  /// Newest first.
  absl::StatusOr<Page<Job>> List(const PageRequest& request);
  /// Ends a job that has not ended; no change if it was cancelled before.
  /// Errors: FailedPrecondition if it has succeeded or failed.
  absl::StatusOr<Job> Cancel(int64_t number);

 private:
  Context context_;
};

/// The jobs of all tenants, for those who work on them. Safe to call concurrently.
///
/// Functions that take a JobLease return Aborted if the job is no longer the worker's: cancelled,
/// ended, or given to another. Errors of all: NotFound; the database's own.
class JobQueue {
 public:
  /// A job whose attempts are lost this often in a row without a new checkpoint has failed.
  static constexpr int64_t kMaxFailures = 3;

  /// @param context  of any tenant. @param quotas  outlive the queue.
  JobQueue(Context context, const Quotas& quotas) : context_(std::move(context)), quotas_(quotas) {}

  struct Claimed {
    Job job;
    JobLease lease;
  };
  /// Gives a queued job to a worker, nothing if none is queued: the oldest of the tenants that have
  /// fewest running, so that none waits for all jobs of another; and of none that has as many running as its quota lets
  /// it.
  /// @param worker  unique per start of a worker.
  absl::StatusOr<std::optional<Claimed>> Claim(const std::string& worker, absl::Duration lease);
  /// All that run now, the oldest first.
  absl::StatusOr<std::vector<Claimed>> ListRunning();
  /// Extends the lease and tells the progress.
  /// @param checkpointed  a checkpoint was written since the last call: the attempt got somewhere.
  absl::Status Renew(const JobLease& lease, absl::Duration duration,
                     const std::string& progress_json, bool checkpointed);

  /// Ends the job with its result, a new version of its model: both or neither.
  absl::StatusOr<ModelVersion> Publish(const JobLease& lease, StagedBlob file,
                                       const std::string& metadata_json);
  /// Ends the job with an error that another attempt would meet again.
  absl::Status Fail(const JobLease& lease, const std::string& error);
  /// Queues the job again, as at a shutdown.
  absl::Status GiveBack(const JobLease& lease);
  /// Queues the job again, or fails it if that was the last of kMaxFailures.
  absl::Status Lose(const JobLease& lease, const std::string& reason);

  /// Loses the jobs whose lease has ended.
  absl::Status LoseExpired();
  /// Queues all running jobs again: at a start, when workers of an earlier server do not count.
  absl::Status GiveBackAll();

  /// A directory of the job's own, for checkpoints; it is there until the job has ended, and stays
  /// if the job has failed.
  absl::StatusOr<std::string> WorkDirectory(const JobLease& lease);

 private:
  /// The context of the job's tenant.
  Context Of(const std::string& tenant) const;
  /// Runs `work` on the leased job in a write transaction; cleans up if the job has ended then.
  absl::Status WithLease(const JobLease& lease,
                         const std::function<absl::Status(const Context&, Connection&, Job&)>& work);

  Context context_;
  const Quotas& quotas_;
};

/// The name of a job's directory. No two tenants share one: numbers have no dash.
std::string JobDirectoryName(const std::string& tenant, int64_t number);

}  // namespace metaekf::store
