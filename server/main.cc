#include <signal.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>
#include <stdlib.h>

#include <CLI/CLI.hpp>
#include <iostream>
#include <optional>
#include <string>

#include "server/config/read_config.h"
#include "server/server.h"
#include "server/training/worker.h"

namespace {

using metaekf::server::ServerOptions;
using metaekf::server::WorkerOptions;

constexpr int kFailed = 1;
constexpr int kWrongUsage = 2;

struct Flags {
  std::string config;
  std::optional<std::string> data_directory;
  std::optional<std::string> listen;
  bool insecure = false;
};

int Fail(const absl::Status& status) {
  std::cerr << "metaekfd: " << std::string(status.message()) << "\n";
  return absl::IsInvalidArgument(status) ? kWrongUsage : kFailed;
}

/// SIGTERM and SIGINT, kept from all threads that start later.
sigset_t BlockStopSignals() {
  sigset_t signals;
  sigemptyset(&signals);
  sigaddset(&signals, SIGTERM);
  sigaddset(&signals, SIGINT);
  pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  return signals;
}

int Serve(const Flags& flags) {
  ServerOptions options;
  if (!flags.config.empty()) {
    const absl::Status read = metaekf::server::ReadConfigFile(flags.config, &options);
    if (!read.ok()) return Fail(read);
  }
  if (flags.data_directory) options.data_directory = *flags.data_directory;
  if (flags.listen) options.listen = *flags.listen;
  options.insecure = flags.insecure;
  if (options.data_directory.empty()) {
    return Fail(absl::InvalidArgumentError(
        "where to keep the data is not said: give --data-dir DIR, or data_directory in the "
        "configuration"));
  }
  // gRPC's own log repeats errors that are reported here, in many more words.
  setenv("GRPC_VERBOSITY", "NONE", /*overwrite=*/0);
  const sigset_t stop_signals = BlockStopSignals();
  auto server = metaekf::server::Server::Start(options);
  if (!server.ok()) return Fail(server.status());
  std::cout << "listening on " << (*server)->address() << std::endl;
  spdlog::info("listening on {} data_directory={}", (*server)->address(), options.data_directory);

  int signal = 0;
  sigwait(&stop_signals, &signal);
  spdlog::info("signal={} draining", signal);
  (*server)->Drain(options.drain_timeout);
  spdlog::info("stopped");
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  spdlog::set_default_logger(spdlog::stderr_color_mt("metaekfd"));
  spdlog::set_pattern("%Y-%m-%dT%H:%M:%S.%f%z level=%l pid=%P %v");
  // A reader that went away is an error of the write, not the end of the server.
  signal(SIGPIPE, SIG_IGN);

  CLI::App app("metaekfd: meta-learned state-space models and EKF estimates as a gRPC service");
  Flags flags;
  app.add_option("--data-dir", flags.data_directory, "where everything is kept; made if missing");
  app.add_option("--listen", flags.listen, "HOST:PORT; port 0 picks one (default 127.0.0.1:50051)");
  app.add_option("--config", flags.config, "configuration (see deploy/metaekfd.textproto)");
  app.add_flag("--insecure", flags.insecure, "allow an address beyond loopback, unencrypted");

  WorkerOptions worker;
  CLI::App* worker_command = app.add_subcommand("worker")->group("");  // for the server itself
  worker_command->add_option("--dataset", worker.dataset)->required();
  worker_command->add_option("--work-directory", worker.work_directory)->required();
  worker_command->add_option("--threads", worker.threads)->required();
  worker_command->add_option("--checkpoint-period-s", worker.checkpoint_period_s)->required();
  worker_command->add_option("--server", worker.server)->required();

  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kWrongUsage;
  }
  if (worker_command->parsed()) {
    signal(SIGPIPE, SIG_DFL);
    return metaekf::server::RunWorker(worker);
  }
  return Serve(flags);
}
