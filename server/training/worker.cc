#include "server/training/worker.h"

#include <fcntl.h>
#include <signal.h>
#include <spdlog/spdlog.h>
#include <sys/prctl.h>
#include <unistd.h>

#include <cerrno>
#include <cmath>
#include <filesystem>
#include <optional>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/status.h"
#include "core/meta/train.h"
#include "core/nssm/model_file.h"
#include "server/executor/give_way.h"
#include "server/store/blob_store.h"
#include "server/store/files.h"
#include "server/training/dataset_file.h"
#include "server/training/progress_reporter.h"

namespace metaekf::server {
namespace {

volatile sig_atomic_t stop_requested = 0;

/// False if the server is gone already.
bool TieToServer(pid_t server) {
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  return getppid() == server;
}

void StopOnSigterm() {
  struct sigaction action {};
  action.sa_handler = [](int) { stop_requested = 1; };
  sigaction(SIGTERM, &action, nullptr);
  // An interrupt at the terminal goes to the whole group; the server decides what becomes of us.
  signal(SIGINT, SIG_IGN);
}

/// All of the file or what was there before, also after a power failure.
absl::Status WriteFileAtomically(const std::string& directory, const std::string& name,
                                 const std::string& bytes) {
  const std::string temporary = absl::StrCat(directory, "/", name, ".", getpid());
  {
    const store::UniqueFd file(open(temporary.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600));
    if (!file.valid()) return store::ErrnoStatus(errno, "cannot write a checkpoint");
    METAEKF_RETURN_IF_ERROR(store::WriteAll(file.get(), bytes));
    if (fsync(file.get()) != 0) return store::ErrnoStatus(errno, "cannot write a checkpoint");
  }
  if (rename(temporary.c_str(), absl::StrCat(directory, "/", name).c_str()) != 0) {
    return store::ErrnoStatus(errno, "cannot write a checkpoint");
  }
  return store::SyncDirectory(directory);
}

/// One attempt at a job.
class Attempt {
 public:
  Attempt(const WorkerOptions& options, ProgressReporter& reporter)
      : options_(options),
        reporter_(reporter),
        digest_(std::filesystem::path(options.dataset).filename().string()) {}

  absl::Status Run() {
    Tell("reading the data");
    METAEKF_ASSIGN_OR_RETURN(const std::string bytes, store::ReadBlob(options_.dataset));
    METAEKF_ASSIGN_OR_RETURN(const TrainingInput input, ReadDatasetFile(bytes));
    const std::optional<meta::TrainingState> resumed = ReadCheckpoint();
    const auto executor = base::MakeThreadExecutor(options_.threads);
    last_checkpoint_ = absl::Now();
    METAEKF_ASSIGN_OR_RETURN(
        const nssm::Bundle bundle,
        meta::Train(input.spec, input.fleet, resumed ? &*resumed : nullptr, executor.get(),
                    [this](const meta::TrainingProgress& progress) { return OnStep(progress); }));
    Tell("writing the model");
    return WriteFileAtomically(options_.work_directory, kModelFile, nssm::WriteModelFile(bundle));
  }

 private:
  std::optional<meta::TrainingState> ReadCheckpoint() {
    const std::string path = absl::StrCat(options_.work_directory, "/", kCheckpointFile);
    const auto bytes = store::ReadFile(path);
    if (!bytes.ok()) return std::nullopt;
    auto state = meta::ReadCheckpoint(*bytes, digest_);
    if (!state.ok()) {
      spdlog::warn("starting anew: {}", state.status().ToString());
      return std::nullopt;
    }
    spdlog::info("resuming after iteration {}", state->iteration);
    return *std::move(state);
  }

  bool OnStep(const meta::TrainingProgress& progress) {
    const bool stop = stop_requested != 0;
    const bool last = progress.state.iteration == progress.iterations;
    Report(progress, last ? "measuring the noise" : "meta-training");
    const absl::Duration period = absl::Seconds(options_.checkpoint_period_s);
    const bool due = absl::Now() - last_checkpoint_ >= period;
    if (stop || last || due || progress.diverged) WriteCheckpoint(progress.state);
    return !stop;
  }

  void WriteCheckpoint(const meta::TrainingState& state) {
    const absl::Status written = WriteFileAtomically(options_.work_directory, kCheckpointFile,
                                                     meta::WriteCheckpoint(state, digest_));
    last_checkpoint_ = absl::Now();
    if (written.ok()) return reporter_.Checkpointed();
    // The training can still end well without one.
    spdlog::warn("no checkpoint: {}", written.ToString());
  }

  void Report(const meta::TrainingProgress& progress, const std::string& message) {
    const meta::TrainingState& state = progress.state;
    const absl::Time now = absl::Now();
    if (first_iteration_ < 0) {
      first_iteration_ = state.iteration;
      first_time_ = now;
    }
    v1::TrainingProgress& told = progress_;
    told.set_iteration(static_cast<uint32_t>(state.iteration));
    told.set_iterations(static_cast<uint32_t>(progress.iterations));
    told.set_training_loss(state.training_loss);
    if (std::isfinite(state.validation_loss)) told.set_validation_loss(state.validation_loss);
    if (std::isfinite(state.best_validation_loss)) {
      told.set_best_validation_loss(state.best_validation_loss);
    }
    if (state.iteration > first_iteration_) {
      const double per_step =
          absl::ToDoubleSeconds(now - first_time_) / (state.iteration - first_iteration_);
      told.set_time_left_s(per_step * (progress.iterations - state.iteration));
    }
    Tell(message);
  }

  void Tell(const std::string& message) {
    progress_.set_message(message);
    reporter_.Progress(progress_);
  }

  const WorkerOptions& options_;
  ProgressReporter& reporter_;
  const std::string digest_;  // of specification and data: what a checkpoint belongs to
  v1::TrainingProgress progress_;
  absl::Time last_checkpoint_;
  absl::Time first_time_;
  int32_t first_iteration_ = -1;
};

}  // namespace

int RunWorker(const WorkerOptions& options) {
  if (!TieToServer(options.server)) return kWorkerStopped;
  StopOnSigterm();
  GiveWay();
  ProgressReporter reporter;
  const absl::Status status = Attempt(options, reporter).Run();
  if (status.ok()) return kWorkerDone;
  // The work directory goes with a job that is cancelled.
  if (absl::IsCancelled(status) || (stop_requested && absl::IsNotFound(status))) return kWorkerStopped;
  spdlog::error("{}", status.ToString());
  reporter.Error(std::string(status.message()));
  // What the machine lacks now it may have later.
  const bool may_go_better = absl::IsResourceExhausted(status) || absl::IsInternal(status);
  return may_go_better ? EXIT_FAILURE : kWorkerFailed;
}

}  // namespace metaekf::server
