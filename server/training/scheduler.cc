#include "server/training/scheduler.h"

#include <spdlog/spdlog.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <filesystem>
#include <optional>

#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "absl/time/clock.h"
#include "core/base/status.h"
#include "core/nssm/model_file.h"
#include "server/convert/models.h"
#include "server/names/resource_names.h"
#include "server/training/worker.h"

namespace metaekf::server {
namespace {

constexpr absl::Duration kLease = absl::Seconds(30);
constexpr absl::Duration kLookPeriod = absl::Seconds(1);
// When the store fails, say because the disk is full.
constexpr absl::Duration kRetryPeriod = absl::Seconds(2);

/// A worker's name: unique, also among those of earlier servers.
std::string NewWorkerName() {
  static std::atomic<int64_t> count = 0;
  return absl::StrCat("worker-", getpid(), "-", absl::GetCurrentTimeNanos(), "-", ++count);
}

std::string Describe(const WorkerProcess::Exit& exit, const std::string& error) {
  std::string text = exit.signal != 0
                         ? absl::StrCat("its worker was killed by signal ", exit.signal)
                         : absl::StrCat("its worker ended with status ", exit.code);
  if (!error.empty()) absl::StrAppend(&text, ": ", error);
  return text;
}

}  // namespace

class TrainingScheduler::Slot {
 public:
  explicit Slot(TrainingScheduler& scheduler)
      : scheduler_(scheduler), wake_fd_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {}

  void Begin() {
    thread_ = std::thread([this] { Run(); });
  }
  void Join() {
    if (thread_.joinable()) thread_.join();
  }
  void Interrupt() { eventfd_write(wake_fd_.get(), 1); }

 private:
  /// What a worker has said.
  struct Told {
    std::string progress_json;
    std::string error;
    absl::Time last_word;
  };

  void Run() {
    while (!scheduler_.stopping_) {
      const uint64_t seen = Queued();
      const auto claimed = jobs().Claim(NewWorkerName(), kLease);
      if (!claimed.ok()) spdlog::error("cannot take up a job: {}", claimed.status().ToString());
      if (claimed.ok() && *claimed) {
        lease_ = (*claimed)->lease;
        RunAttempt((*claimed)->job);
      } else {
        WaitForWork(seen, claimed.ok() ? absl::InfiniteDuration() : kRetryPeriod);
      }
    }
  }

  uint64_t Queued() {
    std::lock_guard lock(scheduler_.mutex_);
    return scheduler_.queued_;
  }

  void WaitForWork(uint64_t seen, absl::Duration timeout) {
    std::unique_lock lock(scheduler_.mutex_);
    const auto woken = [&] { return scheduler_.stopping_ || scheduler_.queued_ != seen; };
    if (timeout == absl::InfiniteDuration()) {
      scheduler_.wake_.wait(lock, woken);
    } else {
      scheduler_.wake_.wait_for(lock, absl::ToChronoMilliseconds(timeout), woken);
    }
  }

  void RunAttempt(const store::Job& job) {
    spdlog::info("tenant={} job={} attempt={} model={} training begins", lease_.tenant, job.number,
                 job.attempt, job.model);
    Notify();
    const absl::Status status = TryAttempt(job);
    if (absl::IsAborted(status) || absl::IsNotFound(status)) {
      RemoveWorkDirectory();
    } else if (!status.ok()) {
      spdlog::error("job={} attempt={} {}", job.number, job.attempt, status.ToString());
      jobs().Lose(lease_, std::string(status.message())).IgnoreError();
      WaitForWork(Queued(), kRetryPeriod);
    }
    Notify();
  }

  /// Errors: Aborted if the job was cancelled; what keeps a worker from starting.
  absl::Status TryAttempt(const store::Job& job) {
    METAEKF_ASSIGN_OR_RETURN(const std::string directory, jobs().WorkDirectory(lease_));
    METAEKF_ASSIGN_OR_RETURN(WorkerProcess worker,
                             WorkerProcess::Start(scheduler_.options_.training.worker_binary,
                                                  Arguments(job, directory)));
    Told told{.progress_json = job.progress_json, .error = "", .last_word = absl::Now()};
    const absl::Status followed = Follow(worker, &told);
    const WorkerProcess::Exit exit = worker.Wait();
    METAEKF_RETURN_IF_ERROR(followed);
    return Conclude(job, directory, exit, told.error);
  }

  std::vector<std::string> Arguments(const store::Job& job, const std::string& directory) const {
    const ServerOptions::Training& training = scheduler_.options_.training;
    const size_t cores = std::max(1U, std::thread::hardware_concurrency());
    return {"worker",
            "--dataset",
            scheduler_.store_.blobs().Path(job.dataset_digest),
            "--work-directory",
            directory,
            "--threads",
            absl::StrCat(training.threads_per_job > 0 ? training.threads_per_job : cores),
            "--checkpoint-period-s",
            absl::StrCat(absl::ToDoubleSeconds(training.checkpoint_period)),
            "--server",
            absl::StrCat(getpid())};
  }

  /// Passes on what the worker says until it ends. Errors: Aborted if the job is no longer ours;
  /// the worker is stopped then.
  absl::Status Follow(WorkerProcess& worker, Told* told) {
    absl::Status lost;
    absl::Time kill_time = absl::InfiniteFuture();
    const auto stop = [&] {
      if (kill_time != absl::InfiniteFuture()) return;
      worker.Signal(SIGTERM);
      kill_time = absl::Now() + scheduler_.options_.drain_timeout;
    };
    while (!worker.ended()) {
      const auto line = worker.ReadLine(kLookPeriod, wake_fd_.get());
      eventfd_t ignored;
      const bool woken = eventfd_read(wake_fd_.get(), &ignored) == 0;
      if (lost.ok() && (line || woken)) lost = Report(line.value_or(""), told);
      if (scheduler_.stopping_ || !lost.ok()) stop();
      if (absl::Now() > std::min(kill_time, told->last_word + kLease)) worker.Signal(SIGKILL);
    }
    return lost;
  }

  absl::Status Report(const std::string& line, Told* told) {
    absl::string_view rest = line;
    if (!line.empty()) told->last_word = absl::Now();
    const bool checkpointed = line == "checkpoint";
    if (absl::ConsumePrefix(&rest, "error ")) told->error = std::string(rest);
    if (absl::ConsumePrefix(&rest, "progress ")) told->progress_json = std::string(rest);
    const absl::Status renewed = jobs().Renew(lease_, kLease, told->progress_json, checkpointed);
    Notify();
    if (renewed.ok() || absl::IsAborted(renewed)) return renewed;
    // The next word may find the store well again.
    spdlog::error("job={} cannot keep its progress: {}", lease_.number, renewed.ToString());
    return absl::OkStatus();
  }

  absl::Status Conclude(const store::Job& job, const std::string& directory,
                        const WorkerProcess::Exit& exit, const std::string& error) {
    if (exit.signal == 0 && exit.code == kWorkerDone) return Publish(job, directory);
    if (exit.signal == 0 && exit.code == kWorkerFailed) {
      spdlog::warn("job={} failed: {}", job.number, error);
      return jobs().Fail(lease_, error);
    }
    if (scheduler_.stopping_ || (exit.signal == 0 && exit.code == kWorkerStopped)) {
      return jobs().GiveBack(lease_);
    }
    const std::string reason = Describe(exit, error);
    spdlog::warn("job={} attempt={} lost: {}", job.number, job.attempt, reason);
    return jobs().Lose(lease_, reason);
  }

  absl::Status Publish(const store::Job& job, const std::string& directory) {
    METAEKF_ASSIGN_OR_RETURN(const std::string file,
                             store::ReadFile(absl::StrCat(directory, "/", kModelFile)));
    METAEKF_ASSIGN_OR_RETURN(const nssm::Bundle bundle, nssm::ReadModelFile(file));
    METAEKF_ASSIGN_OR_RETURN(store::StagedBlob blob, scheduler_.store_.blobs().Stage(file));
    METAEKF_ASSIGN_OR_RETURN(
        const store::ModelVersion version,
        jobs().Publish(lease_, std::move(blob), VersionMetadata(bundle, JobName(job.number))));
    spdlog::info("job={} published {}", job.number, VersionName(version.model, version.version));
    return absl::OkStatus();
  }

  /// Of a cancelled job: its worker may have written into it after the store removed it.
  void RemoveWorkDirectory() {
    const auto directory = jobs().WorkDirectory(lease_);
    if (!directory.ok()) return;
    std::error_code ignored;  // the next start tries again
    std::filesystem::remove_all(*directory, ignored);
  }

  void Notify() { scheduler_.feed_.Notify({lease_.tenant, lease_.number}); }

  store::JobQueue& jobs() { return scheduler_.store_.job_queue(); }

  TrainingScheduler& scheduler_;
  const store::UniqueFd wake_fd_;
  store::JobLease lease_;
  std::thread thread_;
};

TrainingScheduler::TrainingScheduler(store::Store& store, JobFeed& feed,
                                     const ServerOptions& options)
    : store_(store), feed_(feed), options_(options) {
  for (size_t i = 0; i < options.training.concurrent_jobs; ++i) {
    slots_.push_back(std::make_unique<Slot>(*this));
  }
}

TrainingScheduler::~TrainingScheduler() { Stop(); }

absl::Status TrainingScheduler::Start() {
  METAEKF_RETURN_IF_ERROR(store_.job_queue().GiveBackAll());
  for (const auto& slot : slots_) slot->Begin();
  return absl::OkStatus();
}

void TrainingScheduler::Wake() {
  {
    std::lock_guard lock(mutex_);
    ++queued_;
  }
  wake_.notify_all();
}

void TrainingScheduler::CheckJobs() {
  for (const auto& slot : slots_) slot->Interrupt();
}

void TrainingScheduler::Stop() {
  {
    std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  wake_.notify_all();
  CheckJobs();
  for (const auto& slot : slots_) slot->Join();
}

}  // namespace metaekf::server
