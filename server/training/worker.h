#pragma once

#include <sys/types.h>

#include <string>

#include "absl/time/time.h"

/// The process that trains: `metaekfd worker`. It reads the job's data by path, writes checkpoints
/// and the model into the job's work directory, and tells its progress in lines on standard output:
///
///   progress JSON   of TrainingProgress; also to say that it is alive
///   checkpoint      one was written
///   error TEXT      why the training cannot be done
namespace metaekf::server {

inline constexpr const char* kCheckpointFile = "checkpoint";
inline constexpr const char* kModelFile = "model.safetensors";

/// How a worker ends; any other way its attempt is lost.
enum WorkerExit : int {
  kWorkerDone = 0,      ///< the model file stands in the work directory
  kWorkerFailed = 65,   ///< another attempt would fail in the same way
  kWorkerStopped = 75,  ///< SIGTERM: a checkpoint has been written
};

struct WorkerOptions {
  std::string dataset;  ///< path of the blob
  std::string work_directory;
  size_t threads = 1;
  double checkpoint_period_s = 5;
  pid_t server = 0;  ///< its process; when it ends, the worker does
};

/// Trains, from the checkpoint if there is one, and returns the exit status.
int RunWorker(const WorkerOptions& options);

}  // namespace metaekf::server
