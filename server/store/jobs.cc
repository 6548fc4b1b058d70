#include "server/store/jobs.h"

#include <filesystem>

#include "core/base/status.h"
#include "server/store/audit.h"
#include "server/store/names.h"

namespace metaekf::store {
namespace {

constexpr const char* kKind = "job";
constexpr const char* kStateNames[] = {"QUEUED", "RUNNING", "SUCCEEDED", "FAILED", "CANCELLED"};
constexpr const char* kSelect =
    "SELECT number, model, spec_json, dataset_digest, state, attempt, failures, worker, lease_end, "
    "progress_json, error, result_version, create_time, start_time, end_time, tenant FROM jobs ";
constexpr const char* kOfTenant = "WHERE tenant = ?1 ";

const char* Name(JobState state) { return kStateNames[static_cast<int>(state)]; }

JobState StateNamed(const std::string& name) {
  int state = 0;
  while (name != kStateNames[state]) ++state;
  return static_cast<JobState>(state);
}

bool HasEnded(JobState state) { return state != JobState::kQueued && state != JobState::kRunning; }

Job ReadJob(const Row& row) {
  Job job;
  job.number = row.Int(0);
  job.model = row.Text(1);
  job.spec_json = row.Text(2);
  job.dataset_digest = row.Text(3);
  job.state = StateNamed(row.Text(4));
  job.attempt = row.Int(5);
  job.failures = row.Int(6);
  job.worker = row.Text(7);
  job.lease_end = absl::FromUnixMicros(row.Int(8));
  job.progress_json = row.Text(9);
  job.error = row.Text(10);
  job.result_version = row.Int(11);
  job.create_time = absl::FromUnixMicros(row.Int(12));
  job.start_time = absl::FromUnixMicros(row.Int(13));
  job.end_time = absl::FromUnixMicros(row.Int(14));
  return job;
}

absl::StatusOr<Job> FindJob(const Context& context, Connection& connection, int64_t number) {
  std::optional<Job> found;
  METAEKF_RETURN_IF_ERROR(
      connection.Execute(absl::StrCat(kSelect, kOfTenant, "AND number = ?2"), {context.tenant, number},
                         [&](const Row& row) { found = ReadJob(row); }));
  if (found) return *std::move(found);
  return absl::NotFoundError(absl::StrCat("there is no job ", number));
}

/// Writes the columns that change in a job's life.
absl::Status Update(const Context& context, Connection& connection, const Job& job) {
  return connection.Execute(
      "UPDATE jobs SET state = ?3, attempt = ?4, failures = ?5, worker = ?6, lease_end = ?7, "
      "progress_json = ?8, error = ?9, result_version = ?10, start_time = ?11, end_time = ?12 "
      "WHERE tenant = ?1 AND number = ?2",
      {context.tenant, job.number, Name(job.state), job.attempt, job.failures, job.worker,
       absl::ToUnixMicros(job.lease_end), job.progress_json, job.error, job.result_version,
       absl::ToUnixMicros(job.start_time), absl::ToUnixMicros(job.end_time)});
}

std::string Resource(int64_t number) { return absl::StrCat("jobs/", number); }

void End(const Context& context, JobState state, Job& job) {
  job.state = state;
  job.end_time = context.clock();
}

void LoseAttempt(const Context& context, const std::string& reason, Job& job) {
  job.state = JobState::kQueued;
  job.error = absl::StrCat("attempt ", job.attempt, ": ", reason);
  if (++job.failures < JobQueue::kMaxFailures) return;
  absl::StrAppend(&job.error, "; given up after ", job.failures,
                  " attempts in a row without a new checkpoint");
  End(context, JobState::kFailed, job);
}

std::string DirectoryOf(const Context& context, int64_t number) {
  return absl::StrCat(context.jobs_directory, "/", JobDirectoryName(context.tenant, number));
}

/// After a job has ended.
void CleanUp(const Context& context, const Job& job) {
  if (job.state != JobState::kFailed) {
    std::error_code ignored;  // the next start tries again
    std::filesystem::remove_all(DirectoryOf(context, job.number), ignored);
  }
  RemoveIfUnreferenced(context, job.dataset_digest);
}

}  // namespace

std::string JobDirectoryName(const std::string& tenant, int64_t number) {
  return absl::StrCat(tenant, "-", number);
}

absl::StatusOr<Job> JobStore::Create(NewJob wanted) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", wanted.model));
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<Job> {
    METAEKF_ASSIGN_OR_RETURN(const auto before,
                             FindRequest(context_, connection, kKind, wanted.request));
    if (before) return FindJob(context_, connection, before->number);
    METAEKF_RETURN_IF_ERROR(CheckMayQueueJob(context_, connection));
    METAEKF_RETURN_IF_ERROR(CheckMayStore(context_, connection, wanted.dataset.size_bytes()));
    METAEKF_ASSIGN_OR_RETURN(const int64_t number, NextNumber(context_, connection, kKind));
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "INSERT INTO jobs (tenant, number, model, spec_json, dataset_digest, state, create_time) "
        "VALUES (?1, ?2, ?3, ?4, ?5, 'QUEUED', ?6)",
        {context_.tenant, number, wanted.model, wanted.spec_json, wanted.dataset.digest(),
         absl::ToUnixMicros(context_.clock())}));
    METAEKF_RETURN_IF_ERROR(context_.blobs.Publish(wanted.dataset));
    METAEKF_RETURN_IF_ERROR(
        RecordRequest(context_, connection, kKind, wanted.request, {"", number}));
    METAEKF_RETURN_IF_ERROR(Audit(context_, connection, "CreateTrainingJob", Resource(number),
                                  absl::StrCat("models/", wanted.model)));
    return FindJob(context_, connection, number);
  });
}

absl::StatusOr<Job> JobStore::Get(int64_t number) {
  return context_.database.Read(
      [&](Connection& connection) { return FindJob(context_, connection, number); });
}

absl::StatusOr<Page<Job>> JobStore::List(const PageRequest& request) {
  const std::string list = "jobs";
  METAEKF_ASSIGN_OR_RETURN(const PageCursor cursor, ParsePage(list, request));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Page<Job>> {
    std::vector<Job> jobs;
    METAEKF_RETURN_IF_ERROR(
        connection.Execute(absl::StrCat(kSelect, kOfTenant, "AND number < ?2 ORDER BY number DESC LIMIT ?3"),
                           {context_.tenant, NumberLimit(cursor), cursor.size + 1},
                           [&](const Row& row) { jobs.push_back(ReadJob(row)); }));
    return MakePage(list, cursor, std::move(jobs),
                    [](const Job& job) { return absl::StrCat(job.number); });
  });
}

absl::StatusOr<Job> JobStore::Cancel(int64_t number) {
  METAEKF_ASSIGN_OR_RETURN(
      Job job, context_.database.Write([&](Connection& connection) -> absl::StatusOr<Job> {
        METAEKF_ASSIGN_OR_RETURN(Job found, FindJob(context_, connection, number));
        if (found.state == JobState::kCancelled) return found;
        if (HasEnded(found.state)) {
          return absl::FailedPreconditionError(
              absl::StrCat("job ", number, " has ended: ", Name(found.state)));
        }
        End(context_, JobState::kCancelled, found);
        METAEKF_RETURN_IF_ERROR(Update(context_, connection, found));
        METAEKF_RETURN_IF_ERROR(Audit(context_, connection, "CancelJob", Resource(number)));
        return found;
      }));
  CleanUp(context_, job);
  return job;
}

Context JobQueue::Of(const std::string& tenant) const {
  Context context = context_;
  context.tenant = tenant;
  return context;
}

absl::StatusOr<std::optional<JobQueue::Claimed>> JobQueue::Claim(const std::string& worker,
                                                                 absl::Duration lease) {
  using Result = absl::StatusOr<std::optional<Claimed>>;
  return context_.database.Write([&](Connection& connection) -> Result {
    std::optional<JobLease> next;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "SELECT tenant, number, attempt, (SELECT count(*) FROM jobs AS others WHERE "
        "others.tenant = jobs.tenant AND others.state = 'RUNNING') AS running FROM jobs "
        "WHERE state = 'QUEUED' ORDER BY running, create_time, number",
        {}, [&](const Row& row) {
          const bool may = row.Int(3) < quotas_.Of(row.Text(0)).running_jobs;
          if (!next && may) next = JobLease{row.Text(0), row.Int(1), row.Int(2) + 1};
        }));
    if (!next) return std::nullopt;
    METAEKF_ASSIGN_OR_RETURN(Job job, FindJob(Of(next->tenant), connection, next->number));
    job.state = JobState::kRunning;
    ++job.attempt;
    job.worker = worker;
    job.start_time = context_.clock();
    job.lease_end = job.start_time + lease;
    METAEKF_RETURN_IF_ERROR(Update(Of(next->tenant), connection, job));
    return Claimed{std::move(job), *next};
  });
}

absl::StatusOr<std::vector<JobQueue::Claimed>> JobQueue::ListRunning() {
  using Running = absl::StatusOr<std::vector<Claimed>>;
  return context_.database.Read([&](Connection& connection) -> Running {
    std::vector<Claimed> running;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        absl::StrCat(kSelect, "WHERE state = 'RUNNING' ORDER BY create_time, number"), {}, [&](const Row& row) {
          Job job = ReadJob(row);
          const JobLease lease{row.Text(15), job.number, job.attempt};
          running.push_back({std::move(job), lease});
        }));
    return running;
  });
}

absl::Status JobQueue::WithLease(
    const JobLease& lease,
    const std::function<absl::Status(const Context&, Connection&, Job&)>& work) {
  const Context context = Of(lease.tenant);
  METAEKF_ASSIGN_OR_RETURN(
      const Job job, context.database.Write([&](Connection& connection) -> absl::StatusOr<Job> {
        METAEKF_ASSIGN_OR_RETURN(Job leased, FindJob(context, connection, lease.number));
        if (leased.state != JobState::kRunning || leased.attempt != lease.attempt) {
          return absl::AbortedError(absl::StrCat("attempt ", lease.attempt, " has lost job ",
                                                 lease.number, ", which is ", Name(leased.state),
                                                 " in attempt ", leased.attempt));
        }
        METAEKF_RETURN_IF_ERROR(work(context, connection, leased));
        METAEKF_RETURN_IF_ERROR(Update(context, connection, leased));
        return leased;
      }));
  if (HasEnded(job.state)) CleanUp(context, job);
  return absl::OkStatus();
}

absl::Status JobQueue::Renew(const JobLease& lease, absl::Duration duration,
                             const std::string& progress_json, bool checkpointed) {
  return WithLease(lease, [&](const Context& context, Connection&, Job& job) {
    job.lease_end = context.clock() + duration;
    job.progress_json = progress_json;
    if (checkpointed) job.failures = 0;
    return absl::OkStatus();
  });
}

absl::StatusOr<ModelVersion> JobQueue::Publish(const JobLease& lease, StagedBlob file,
                                               const std::string& metadata_json) {
  absl::StatusOr<ModelVersion> version;
  const absl::Status status =
      WithLease(lease, [&](const Context& context, Connection& connection, Job& job) {
        version = InsertVersion(context, connection, job.model, file, metadata_json);
        if (!version.ok()) return version.status();
        job.result_version = version->version;
        job.error.clear();
        End(context, JobState::kSucceeded, job);
        return absl::OkStatus();
      });
  if (!status.ok()) return status;
  return version;
}

absl::Status JobQueue::Fail(const JobLease& lease, const std::string& error) {
  return WithLease(lease, [&](const Context& context, Connection&, Job& job) {
    job.error = error;
    End(context, JobState::kFailed, job);
    return absl::OkStatus();
  });
}

absl::Status JobQueue::GiveBack(const JobLease& lease) {
  return WithLease(lease, [&](const Context&, Connection&, Job& job) {
    job.state = JobState::kQueued;
    return absl::OkStatus();
  });
}

absl::Status JobQueue::Lose(const JobLease& lease, const std::string& reason) {
  return WithLease(lease, [&](const Context& context, Connection&, Job& job) {
    LoseAttempt(context, reason, job);
    return absl::OkStatus();
  });
}

absl::Status JobQueue::LoseExpired() {
  struct Expired {
    JobLease lease;
    std::string worker;
  };
  using Leases = absl::StatusOr<std::vector<Expired>>;
  METAEKF_ASSIGN_OR_RETURN(
      const auto all, context_.database.Read([&](Connection& connection) -> Leases {
        std::vector<Expired> expired;
        METAEKF_RETURN_IF_ERROR(connection.Execute(
            "SELECT tenant, number, attempt, worker FROM jobs "
            "WHERE state = 'RUNNING' AND lease_end < ?1",
            {absl::ToUnixMicros(context_.clock())}, [&](const Row& row) {
              expired.push_back({{row.Text(0), row.Int(1), row.Int(2)}, row.Text(3)});
            }));
        return expired;
      }));
  for (const Expired& expired : all) {
    const absl::Status lost =
        Lose(expired.lease, absl::StrCat("worker ", expired.worker, " stopped reporting"));
    // It ended by itself meanwhile.
    if (!lost.ok() && !absl::IsAborted(lost)) return lost;
  }
  return absl::OkStatus();
}

absl::Status JobQueue::GiveBackAll() {
  return context_.database.Write([&](Connection& connection) {
    return connection.Execute("UPDATE jobs SET state = 'QUEUED' WHERE state = 'RUNNING'");
  });
}

absl::StatusOr<std::string> JobQueue::WorkDirectory(const JobLease& lease) {
  const std::string directory = DirectoryOf(Of(lease.tenant), lease.number);
  METAEKF_RETURN_IF_ERROR(MakeDirectory(directory));
  return directory;
}

}  // namespace metaekf::store
