#include <sys/resource.h>
#include <sys/socket.h>
#include <arpa/inet.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <map>
#include <mutex>
#include <set>
#include <thread>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/base/rng.h"
#include "core/nssm/model_file.h"
#include "metaekf/client.h"
#include "tests/server/support/client.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/tiny_models.h"
#include "tests/server/support/workers.h"
#include "tests/support/stream_signal.h"

namespace metaekf::server {
namespace {

using client::Code;
using std::chrono::milliseconds;
using std::chrono::seconds;
using std::chrono::steady_clock;

struct Flags {
  double minutes = 30;
  int streams = 200;
  uint64_t seed = 1;
  std::string directory;
};

/// What was wrong and how much was done; for all threads.
class Report {
 public:
  void Violation(const std::string& what) {
    std::lock_guard lock(mutex_);
    ++violations_;
    std::fprintf(stderr, "soak: VIOLATION: %s\n", what.c_str());
  }
  void Count(const std::string& what, int64_t by = 1) {
    std::lock_guard lock(mutex_);
    counts_[what] += by;
  }
  int violations() const { return violations_; }
  void Print() {
    std::lock_guard lock(mutex_);
    for (const auto& [what, count] : counts_) std::printf("  %-44s %lld\n", what.c_str(), static_cast<long long>(count));
  }

 private:
  std::mutex mutex_;
  std::map<std::string, int64_t> counts_;
  std::atomic<int> violations_ = 0;
};

/// What a server that is killed, stopped or short of disk may say.
bool MayPass(const client::Status& status) {
  return status.code == Code::kUnavailable || status.code == Code::kDeadlineExceeded ||
         status.code == Code::kResourceExhausted;
}

class Soak {
 public:
  explicit Soak(const Flags& flags) : flags_(flags), rng_(flags.seed) {}

  int Run();

 private:
  /// One stream's end: how much of it there was, and its digest.
  struct Ended {
    uint64_t samples = 0;
    uint64_t digest = 0;
  };

  void StartServer();
  client::Client Connect() const { return client::Client({.server = address_, .timeout_s = 60}); }
  /// Waits, but not longer than the soak lasts.
  void Pause(milliseconds time) {
    std::unique_lock lock(pause_mutex_);
    stopped_.wait_until(lock, std::min(steady_clock::now() + time, end_), [this] { return stop_.load(); });
  }
  void Stop() {
    {
      std::lock_guard lock(pause_mutex_);
      stop_ = true;
    }
    stopped_.notify_all();
  }
  bool running() const { return !stop_ && steady_clock::now() < end_; }

  std::unique_ptr<client::EstimationSession> Open(client::Client& client);
  void Stream(int stream);
  void Models();
  void Adaptations();
  void Jobs();
  void Fault();
  void Throw();  // what no client sends
  void LimitFiles(rlim_t bytes);
  void KillWorkers();
  void Verify(int first_stream, int step);

  const Flags flags_;
  base::Rng rng_;  // of faults
  Report report_;
  std::string address_;
  std::unique_ptr<ServerProcess> server_;
  steady_clock::time_point end_;
  std::atomic<bool> stop_ = false;
  std::mutex pause_mutex_;
  std::condition_variable stopped_;
  std::vector<Ended> ended_;
};

void Soak::StartServer() {
  const std::string listen = address_.empty() ? "127.0.0.1:0" : address_;
  server_ = std::make_unique<ServerProcess>(
      METAEKFD_BINARY, std::vector<std::string>{"--data-dir", flags_.directory + "/data", "--listen", listen, "--config",
                                                flags_.directory + "/metaekfd.textproto"});
  if (server_->address().empty()) report_.Violation("the server does not start");
  if (address_.empty()) address_ = server_->address();
}

std::unique_ptr<client::EstimationSession> Soak::Open(client::Client& client) {
  client::EstimationOptions options;
  options.target.model = "steady";
  options.covariance = client::CovarianceFormat::kLowerTriangle;
  options.reconnect_for_s = 120;
  while (running()) {
    auto session = client.OpenEstimation(options);
    if (session.ok()) return std::move(*session);
    if (!MayPass(session.status())) {
      report_.Violation("a session is not opened: " + session.status().message);
      return nullptr;
    }
    Pause(milliseconds(500));
  }
  return nullptr;
}

void Soak::Stream(int stream) {
  client::Client client = Connect();
  const auto session = Open(client);
  if (session == nullptr) return;
  base::Rng rng(flags_.seed * 1000 + static_cast<uint64_t>(stream));
  metaekf::testing::EstimateDigest digest;
  uint64_t next = 1;
  while (running()) {
    const size_t count = 1 + rng.Index(8);
    if (!session->Send(metaekf::testing::SignalSamples(stream, next, count)).ok()) {
      return report_.Violation(absl::StrCat("stream ", stream, " takes no samples"));
    }
    for (const uint64_t until = next + count; next < until;) {
      const auto batch = session->Receive();
      if (!batch.ok() || !*batch) {
        return report_.Violation(absl::StrCat("stream ", stream, " ends: ", batch.status().message));
      }
      if ((*batch)->first_seq != next) {
        return report_.Violation(absl::StrCat("stream ", stream, ": ", (*batch)->first_seq, " comes after ", next - 1));
      }
      digest.Add(**batch);
      next += (*batch)->samples;
    }
    report_.Count("samples", static_cast<int64_t>(count));
    Pause(milliseconds(20 + rng.Index(60)));  // a sensor's pace
  }
  ended_[static_cast<size_t>(stream)] = {next - 1, digest.value()};
}

/// Imports, exports and deletes versions: what was confirmed is there, byte for byte.
void Soak::Models() {
  client::Client client = Connect();
  std::map<uint32_t, std::string> confirmed;
  base::Rng rng(flags_.seed + 1);
  for (uint64_t seed = 1; running(); ++seed, Pause(milliseconds(200))) {
    const std::string file = nssm::WriteModelFile(TinyBundle(seed));
    const auto made = client.ImportModel("changing", file);
    if (made.ok()) {
      confirmed[made->version] = file;
      report_.Count("models imported");
    } else if (!MayPass(made.status())) {
      report_.Violation("import: " + made.status().message);
    }
    if (confirmed.empty()) continue;
    const auto pick = std::next(confirmed.begin(), static_cast<ptrdiff_t>(rng.Index(confirmed.size())));
    const std::string name = absl::StrCat("changing@", pick->first);
    const auto exported = client.ExportModel(name);
    if (exported.ok() ? *exported != pick->second : !MayPass(exported.status())) {
      report_.Violation(name + " is not what was imported: " + exported.status().message);
    }
    if (confirmed.size() < 20) continue;
    const client::Status deleted = client.DeleteModelVersion(name);
    if (!deleted.ok() && !MayPass(deleted) && deleted.code != Code::kNotFound) report_.Violation("delete: " + deleted.message);
    confirmed.erase(pick);  // which may have happened or not
  }
}

void Soak::Adaptations() {
  client::Client client = Connect();
  client::Trajectory context{.samples = 60};
  for (int t = 0; t < 60; ++t) {
    context.inputs.push_back(std::sin(0.3 * t));
    context.outputs.push_back(std::cos(0.3 * t));
  }
  std::set<std::string> confirmed;
  for (int number = 1; running(); ++number, Pause(milliseconds(300))) {
    client::AdaptationRequest request;
    request.model = "still";
    request.context = context;
    const auto made = client.Adapt(request);
    if (made.ok()) {
      confirmed.insert(made->id);
      report_.Count("adaptations");
    } else if (!MayPass(made.status())) {
      report_.Violation("adapt: " + made.status().message);
    }
    if (confirmed.empty()) continue;
    const std::string id = *confirmed.begin();
    const auto predicted = client.Predict({.target = {.adaptation = id}, .trajectories = {context}});
    if (!predicted.ok() && !MayPass(predicted.status())) report_.Violation(id + ": " + predicted.status().message);
    if (confirmed.size() < 20) continue;
    const client::Status deleted = client.DeleteAdaptation(id);
    if (!deleted.ok() && !MayPass(deleted) && deleted.code != Code::kNotFound) report_.Violation("delete: " + deleted.message);
    confirmed.erase(id);
  }
}

/// Jobs one after the other, each asked for until it is confirmed: each publishes one version, all with the same bits.
void Soak::Jobs() {
  client::Client client = Connect();
  Client fleet_client(address_);
  std::string digest;
  for (int number = 1; running(); ++number) {
    const std::string model = absl::StrCat("job", number);
    auto requests = TinyJob(model, 1500);
    requests[0].mutable_header()->set_request_id(model);
    Reply<v1::Job> job;
    do {
      job = fleet_client.CreateJob(requests);
      if (!job.ok()) Pause(milliseconds(500));
    } while (!job.ok() && running());
    const std::string id = job.value.name();
    while (running()) {
      const auto now = client.GetJob(id);
      if (now.ok() && now->ended()) {
        if (now->state != client::JobState::kSucceeded) report_.Violation(id + ": " + now->error_message);
        break;
      }
      if (!now.ok() && !MayPass(now.status())) report_.Violation(id + ": " + now.status().message);
      Pause(milliseconds(300));
    }
    if (!running()) return;
    const auto versions = client.ListModelVersions(model);
    if (!versions.ok()) continue;
    if (versions->size() != 1) report_.Violation(absl::StrCat(model, " has ", versions->size(), " versions"));
    if (!versions->empty() && digest.empty()) digest = versions->front().sha256;
    if (!versions->empty() && versions->front().sha256 != digest) report_.Violation(model + " has other weights");
    report_.Count("jobs");
  }
}

void Soak::LimitFiles(rlim_t bytes) {
  const rlimit limit{bytes, RLIM_INFINITY};
  prlimit(server_->pid(), RLIMIT_FSIZE, &limit, nullptr);
}

void Soak::KillWorkers() {
  for (const pid_t worker : WorkersOf(server_->pid())) kill(worker, SIGKILL);
}

void Soak::Throw() {
  const size_t colon = address_.rfind(':');
  int port = 0;
  if (!absl::SimpleAtoi(address_.substr(colon + 1), &port)) return;
  sockaddr_in address{.sin_family = AF_INET, .sin_port = htons(static_cast<uint16_t>(port))};
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  std::vector<int> connections;
  for (int c = 0; c < 100; ++c) {
    const int connection = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (connect(connection, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
      close(connection);
      break;
    }
    std::string bytes = c % 2 == 0 ? "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" : "";
    for (uint64_t i = rng_.Index(200); i > 0; --i) bytes.push_back(static_cast<char>(rng_.Index(256)));
    (void)!write(connection, bytes.data(), bytes.size());
    connections.push_back(connection);
  }
  Pause(seconds(2));  // open, and silent
  for (const int connection : connections) close(connection);
}

void Soak::Fault() {
  const uint64_t kind = rng_.Index(10);
  if (kind < 3) {
    report_.Count("kill -9 of the server");
    server_->End(SIGKILL);
    StartServer();
  } else if (kind < 5) {
    report_.Count("stops and restarts");
    if (server_->End(SIGTERM).code != 0) report_.Violation("a stopped server ends with an error");
    StartServer();
  } else if (kind < 6) {
    report_.Count("SIGSTOP for seconds");
    kill(server_->pid(), SIGSTOP);
    Pause(seconds(1 + rng_.Index(4)));
    kill(server_->pid(), SIGCONT);
  } else if (kind < 7) {
    report_.Count("full disk for seconds");
    LimitFiles(1000);
    Pause(seconds(1 + rng_.Index(3)));
    if (rng_.Index(2) == 0) {
      server_->End(SIGKILL);
      StartServer();
    } else {
      LimitFiles(RLIM_INFINITY);
      KillWorkers();  // who have the limit still
    }
  } else if (kind < 8) {
    report_.Count("kill -9 of workers");
    KillWorkers();
  } else {
    report_.Count("connections that send garbage or nothing");
    Throw();
  }
}

/// An undisturbed session has the same estimates.
void Soak::Verify(int first_stream, int step) {
  client::Client client = Connect();
  for (int stream = first_stream; stream < flags_.streams; stream += step) {
    const Ended& ended = ended_[static_cast<size_t>(stream)];
    if (ended.samples == 0) continue;  // told already
    client::EstimationOptions options;
    options.target.model = "steady";
    options.covariance = client::CovarianceFormat::kLowerTriangle;
    const auto session = client.OpenEstimation(options);
    if (!session.ok()) return report_.Violation("no session to compare with: " + session.status().message);
    metaekf::testing::EstimateDigest digest;
    std::thread sender([&] {
      for (uint64_t next = 1; next <= ended.samples;) {
        const size_t count = std::min<uint64_t>(64, ended.samples - next + 1);
        if (!(*session)->Send(metaekf::testing::SignalSamples(stream, next, count)).ok()) break;
        next += count;
      }
      (*session)->FinishSending();
    });
    uint64_t received = 0;
    while (true) {
      const auto batch = (*session)->Receive();
      if (!batch.ok() || !*batch) break;
      digest.Add(**batch);
      received += (*batch)->samples;
    }
    sender.join();
    if (received != ended.samples || digest.value() != ended.digest) {
      report_.Violation(absl::StrCat("stream ", stream, ": its ", ended.samples, " estimates are not those of an undisturbed one"));
    }
    report_.Count("streams compared bit by bit");
  }
}

struct Use {
  double resident_mb = 0;
  double open_files = 0;
};

Use UseOf(pid_t pid) {
  Use use;
  double total = 0;
  std::ifstream(absl::StrCat("/proc/", pid, "/statm")) >> total >> use.resident_mb;
  use.resident_mb *= static_cast<double>(sysconf(_SC_PAGESIZE)) / 1e6;
  std::error_code gone;
  for ([[maybe_unused]] const auto& entry : std::filesystem::directory_iterator(absl::StrCat("/proc/", pid, "/fd"), gone)) {
    ++use.open_files;
  }
  return use;
}

double Median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  return values.empty() ? 0 : values[values.size() / 2];
}

int Soak::Run() {
  std::filesystem::create_directories(flags_.directory);
  std::ofstream(flags_.directory + "/metaekfd.textproto")
      << "training { threads_per_job: 1 checkpoint_period_s: 0.1 }\n";
  StartServer();
  {
    client::Client client = Connect();
    if (!client.ImportModel("steady", nssm::WriteModelFile(TinyStateBundle())).ok() ||
        !client.ImportModel("still", nssm::WriteModelFile(TinyBundle())).ok()) {
      report_.Violation("models are not imported");
      return 1;
    }
  }
  ended_.resize(static_cast<size_t>(flags_.streams));
  const auto start = steady_clock::now();
  const auto length = std::chrono::duration_cast<steady_clock::duration>(std::chrono::duration<double>(60 * flags_.minutes));
  end_ = start + length;
  std::vector<std::thread> threads;
  for (int s = 0; s < flags_.streams; ++s) threads.emplace_back([this, s] { Stream(s); });
  threads.emplace_back([this] { Models(); });
  threads.emplace_back([this] { Adaptations(); });
  threads.emplace_back([this] { Jobs(); });

  const auto quiet_from = start + 2 * length / 3;
  while (steady_clock::now() < quiet_from && report_.violations() < 10) {
    Pause(milliseconds(1000 + rng_.Index(6000)));
    if (steady_clock::now() < quiet_from) Fault();
  }
  // What a restart makes grow at first is there after a tenth of the rest.
  Pause(std::chrono::duration_cast<milliseconds>(length / 30));
  std::vector<double> resident, files;
  while (running() && report_.violations() < 10) {
    const Use use = UseOf(server_->pid());
    resident.push_back(use.resident_mb);
    files.push_back(use.open_files);
    Pause(seconds(1));
  }
  if (report_.violations() >= 10) Stop();
  for (std::thread& thread : threads) thread.join();
  const auto fifth = [](const std::vector<double>& all, int which) {
    const auto size = static_cast<ptrdiff_t>(all.size() / 5), begin = which * size;
    return std::vector<double>(all.begin() + begin, all.begin() + begin + size);
  };
  const auto memory = [&](int which) { return Median(fifth(resident, which)); };
  const double drift = 100 * (memory(4) / std::max(1.0, memory(0)) - 1);
  // Jobs and calls open files and close them again: what stays is what is open at the quietest moment.
  const auto open_files = [&](int which) {
    const std::vector<double> some = fifth(files, which);
    return some.empty() ? 0 : *std::min_element(some.begin(), some.end());
  };
  const double file_drift = open_files(4) - open_files(0);

  std::fprintf(stderr, "soak: comparing %d streams with undisturbed ones\n", flags_.streams);
  end_ = steady_clock::now() + std::chrono::hours(1);
  std::thread other([this] { Verify(1, 2); });
  Verify(0, 2);
  other.join();

  std::printf("%.1f minutes, %d streams, seed %llu\n", flags_.minutes, flags_.streams, static_cast<unsigned long long>(flags_.seed));
  report_.Print();
  std::printf("  %-44s", "resident memory over the last third, MB");
  for (int which = 0; which < 5; ++which) std::printf(" %.1f", memory(which));
  std::printf(", drift %.2f %%\n", drift);
  std::printf("  %-44s %.0f, drift %.0f\n", "open files over the last third, at the least", open_files(4), file_drift);
  if (drift >= 2) report_.Violation(absl::StrCat("memory grows by ", drift, " %"));
  if (file_drift >= 1) report_.Violation("open files grow");
  std::printf("  %-44s %d\n", "violations", report_.violations());
  return report_.violations() == 0 ? 0 : 1;
}

}  // namespace
}  // namespace metaekf::server

int main(int argc, char** argv) {
  signal(SIGPIPE, SIG_IGN);
  metaekf::server::Flags flags;
  CLI::App app("soak: streams, models, adaptations, jobs and faults of all kinds against a server; 0 violations, or it fails");
  app.add_option("--minutes", flags.minutes, "how long; two thirds with faults")->check(CLI::PositiveNumber)->capture_default_str();
  app.add_option("--streams", flags.streams, "at a time")->check(CLI::PositiveNumber)->capture_default_str();
  app.add_option("--seed", flags.seed, "of the faults")->capture_default_str();
  app.add_option("--directory", flags.directory, "new; the server's data are left there")->required();
  CLI11_PARSE(app, argc, argv);
  return metaekf::server::Soak(flags).Run();
}
