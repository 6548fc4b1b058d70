#include <errno.h>
#include <malloc.h>
#include <signal.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <filesystem>
#include <iostream>
#include <optional>
#include <string>
#include <system_error>
#include <thread>

#include "absl/time/clock.h"
#include "server/config/read_config.h"
#include "server/server.h"
#include "server/store/store.h"
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
  bool require_tokens = false;
};

/// Of the first token of a directory: there is nobody yet who could ask a server for one.
struct NewTokenFlags {
  std::string data_directory;
  std::string tenant = metaekf::store::kDefaultTenant;
  std::string scope;
  std::string note;
};

int Fail(const absl::Status& status) {
  std::cerr << "metaekfd: " << std::string(status.message()) << "\n";
  return absl::IsInvalidArgument(status) ? kWrongUsage : kFailed;
}

/// Begins again with smaller caches of freed memory, one of which each thread has. What lies in them keeps the pages around it: with two
/// dozen threads a server's memory would grow for hours of the same work. glibc takes their size from the environment only, before
/// anything else; what is set there already stays.
void LimitThreadCaches(char** argv) {
  if (getenv("GLIBC_TUNABLES") != nullptr) return;
  std::error_code unknown;
  const std::string self = std::filesystem::read_symlink("/proc/self/exe", unknown);
  if (unknown) return;
  setenv("GLIBC_TUNABLES", "glibc.malloc.tcache_max=128", /*overwrite=*/1);
  execv(self.c_str(), argv);  // or goes on as it is
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

/// Waits for one of the signals, and meanwhile gives pages that lie free between others back to the system, which takes 0.2 ms beside 200
/// streams. Left alone, the allocator does so at the ends of its heaps only: these would become sparser for hours of the same work.
int WaitTidying(const sigset_t& signals) {
  constexpr timespec kPeriod = {.tv_sec = 30, .tv_nsec = 0};
  while (true) {
    const int signal = sigtimedwait(&signals, nullptr, &kPeriod);
    if (signal > 0) return signal;
    if (errno == EAGAIN) malloc_trim(/*pad=*/0);
  }
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
  if (flags.require_tokens) options.security.require_tokens = true;
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

  const int signal = WaitTidying(stop_signals);
  spdlog::info("signal={} draining", signal);
  (*server)->Drain(options.drain_timeout);
  spdlog::info("stopped");
  return 0;
}

int CreateToken(const NewTokenFlags& flags) {
  using metaekf::store::Store;
  const auto scope = metaekf::store::ScopeNamed(flags.scope);
  if (!scope.ok()) return Fail(scope.status());
  const auto store = Store::Open(flags.data_directory, [] { return absl::Now(); });
  if (!store.ok()) return Fail(store.status());
  const auto made = (*store)->Tokens("metaekfd create-token")
                        .Create(flags.tenant, *scope, absl::InfiniteDuration(), flags.note);
  if (!made.ok()) return Fail(made.status());
  std::cerr << "token " << made->token.id << " of tenant " << made->token.tenant << ", scope "
            << flags.scope << "; the secret is not kept, this is the only time that it is shown:\n";
  std::cout << made->secret << std::endl;
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  LimitThreadCaches(argv);
  spdlog::set_default_logger(spdlog::stderr_color_mt("metaekfd"));
  spdlog::set_pattern("%Y-%m-%dT%H:%M:%S.%f%z level=%l pid=%P %v");
  // Eight heaps per processor, as the allocator has them, keep what one thread frees from the others.
  mallopt(M_ARENA_MAX, static_cast<int>(std::max(1U, std::thread::hardware_concurrency())));
  // A reader that went away is an error of the write, not the end of the server.
  signal(SIGPIPE, SIG_IGN);
  // Nor is a limit on the size of files.
  signal(SIGXFSZ, SIG_IGN);

  CLI::App app("metaekfd: meta-learned state-space models and EKF estimates as a gRPC service");
  Flags flags;
  app.add_option("--data-dir", flags.data_directory, "where everything is kept; made if missing");
  app.add_option("--listen", flags.listen, "HOST:PORT; port 0 picks one (default 127.0.0.1:50051)");
  app.add_option("--config", flags.config, "configuration (see deploy/metaekfd.textproto)");
  app.add_flag("--insecure", flags.insecure, "allow an address beyond loopback, unencrypted");
  app.add_flag("--require-tokens", flags.require_tokens,
               "every call must show a bearer token (create-token makes the first)");

  NewTokenFlags new_token;
  CLI::App* token_command =
      app.add_subcommand("create-token", "make a bearer token while no server runs on the directory");
  token_command->add_option("--data-dir", new_token.data_directory, "the server's")->required();
  token_command->add_option("--tenant", new_token.tenant, "whose things its holder works with")
      ->capture_default_str();
  token_command->add_option("--scope", new_token.scope, "read, stream, write or admin")->required();
  token_command->add_option("--note", new_token.note, "for whom it is");

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
  if (token_command->parsed()) return CreateToken(new_token);
  return Serve(flags);
}
