// See README.md beside this file.

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "core/base/executor.h"
#include "core/nssm/model_file.h"
#include "core/sim/simulate.h"
#include "tests/benchmark/networks.h"
#include "tests/benchmark/report.h"
#include "tests/benchmark/streams.h"
#include "tests/server/support/server_process.h"
#include "tests/support/bundles.h"

namespace metaekf::benchmark {
namespace {

using server::ServerProcess;
using std::chrono::steady_clock;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr int kMessagesInFlight = 8;
constexpr int kRounds = 5;
constexpr int kBatch = 64;
constexpr double kSecondsPerRound = 1;
constexpr int kSamplesAt100Hz = 300;  // of a round
constexpr int kModels = 1000;         // of a large registry
constexpr size_t kSessionsPerConnection = 100;
constexpr size_t kSessions[] = {10, 100, 1000, 5000};
constexpr uint32_t kContext = 400;

std::string Contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) Fail(path + " cannot be read");
  std::ostringstream bytes;
  bytes << file.rdbuf();
  return bytes.str();
}

std::string ZooModel() { return Contents(METAEKF_SOURCE_DIR "/deploy/zoo/van-der-pol.safetensors"); }

/// The same model with a last number of its own, so that no two files are the same.
std::string ZooModel(int number) {
  std::string file = ZooModel();
  const double weight = 1e-3 * (number + 1);
  std::memcpy(file.data() + file.size() - sizeof(weight), &weight, sizeof(weight));
  return file;
}

double SecondsSince(steady_clock::time_point begin) { return std::chrono::duration<double>(steady_clock::now() - begin).count(); }

/// Does something again and again in a thread of its own for as long as it lives.
class Beside {
 public:
  Beside(std::chrono::milliseconds pause, std::function<void()> work)
      : thread_([this, pause, work = std::move(work)] {
          for (auto next = steady_clock::now(); !stop_; std::this_thread::sleep_until(next)) {
            next += pause;
            work();
            ++done_;
          }
        }) {}
  ~Beside() {
    stop_ = true;
    thread_.join();
  }
  int done() const { return done_; }

 private:
  std::atomic<bool> stop_ = false;
  std::atomic<int> done_ = 0;
  std::thread thread_;
};

template <class Stream>
double Rate(Stream* stream) {
  return MessagesPerSecond(kMessagesInFlight, kSecondsPerRound, [&] { stream->Send(); }, [&] { stream->Receive(); });
}

std::vector<Row> Throughput(client::Client* client, const std::string& echo) {
  std::vector<double> echoed, single, batched;
  // Each alone: threads that wait for another stream take their turns at gRPC's polling.
  const auto rate = [](auto&& stream) { return Rate(&stream); };
  for (int round = 0; round < kRounds; ++round) {
    echoed.push_back(rate(EchoStream(echo, SizesOf(1))));
    single.push_back(rate(EstimateStream(client, 1)));
    batched.push_back(kBatch * rate(EstimateStream(client, kBatch)));
  }
  const double messages = Median(echoed), estimates = Median(single), samples = Median(batched);
  return {{"one stream, one sample a message", "1/s", estimates, messages, estimates / messages, "stream_echo"},
          {"one stream, 64 samples a message, samples", "1/s", samples, messages, samples / messages, "stream_batch"}};
}

/// What it costs to write down what streams have taught.
std::vector<Row> Checkpoints(client::Client* with, client::Client* without) {
  std::vector<Row> rows;
  for (const int batch : {1, kBatch}) {
    std::vector<double> rates, rates_without;
    for (int round = 0; round < kRounds; ++round) {
      for (const auto& [client, into] : {std::pair(with, &rates), std::pair(without, &rates_without)}) {
        EstimateStream stream(client, batch);
        into->push_back(batch * Rate(&stream));
      }
    }
    const double ours = Median(rates), peer = Median(rates_without);
    rows.push_back({"samples, " + std::to_string(batch) + " a message, beside checkpoints off", "1/s", ours, peer, ours / peer, ""});
  }
  return rows;
}

template <class Stream>
void AddLatencies(Stream* stream, std::vector<double>* latencies) {
  const std::vector<double> round = LatenciesAt100Hz(kSamplesAt100Hz, [&] { stream->Send(), stream->Receive(); });
  latencies->insert(latencies->end(), round.begin(), round.end());
}

/// A fleet of van der Pol oscillators as the client sends it.
std::vector<client::Trajectory> Oscillators(int64_t systems, int64_t steps) {
  const auto executor = base::MakeThreadExecutor(1);
  const auto fleet = sim::Simulate(
      {.system = "van-der-pol", .systems = systems, .seed = 1, .steps = steps, .settings = {{"noise_std", "0.005"}}}, *executor);
  if (!fleet.ok()) Fail(std::string(fleet.status().message()));
  std::vector<client::Trajectory> result;
  for (const data::Trajectory& from : fleet->dataset.trajectories) {
    client::Trajectory to{.name = from.name, .sample_period_s = from.sample_period_s, .samples = static_cast<size_t>(from.outputs.cols())};
    to.outputs.assign(from.outputs.data(), from.outputs.data() + from.outputs.size());
    to.states.assign(from.states.data(), from.states.data() + from.states.size());
    result.push_back(std::move(to));
  }
  return result;
}

/// Of a stream and of the echo: alone, while a training runs and adaptations follow each other, and while a model is loaded every second.
std::vector<Row> Latency(client::Client* client, const std::string& echo) {
  std::vector<double> alone, busy, loading, echo_alone, echo_busy, echo_loading;
  client::TrainingRequest training{.model = "beside", .spec = Contents(METAEKF_SOURCE_DIR "/deploy/specs/van-der-pol.textproto"),
                                   .channels = {.outputs = {{"y1", ""}, {"y2", ""}}, .states = {{"x1", ""}, {"x2", ""}}},
                                   .fleet = Oscillators(50, 1000)};
  client::AdaptationRequest adaptation;
  adaptation.model = "van-der-pol";
  adaptation.context = Oscillators(1, kContext)[0];
  int adaptations = 0, loads = 0;
  for (int round = 0; round < kRounds; ++round) {
    EchoStream peer(echo, SizesOf(1));
    EstimateStream stream(client, 1);
    AddLatencies(&peer, &echo_alone);
    AddLatencies(&stream, &alone);
    {
      const auto job = client->CreateTrainingJob(training);
      Check(job.status(), "training");
      Check(client->WatchJob(job->id, [](const client::Job& now) { return now.state == client::JobState::kQueued; }).status(), "watching");
      const Beside adapting(std::chrono::milliseconds(0), [&] { Check(client->Adapt(adaptation).status(), "adapting"); });
      AddLatencies(&peer, &echo_busy);
      AddLatencies(&stream, &busy);
      adaptations += adapting.done();
      const auto cancelled = client->CancelJob(job->id);
      Check(cancelled.status(), "cancelling");
    }
    {
      const Beside loader(std::chrono::seconds(1), [&] {
        const std::string name = "loaded-" + std::to_string(loads++);
        Check(client->ImportModel(name, ZooModel(loads)).status(), "importing");
        { EstimateStream loaded(client, 1, name); }
        Check(client->DeleteModelVersion(name + "@1"), "deleting");
      });
      AddLatencies(&peer, &echo_loading);
      AddLatencies(&stream, &loading);
    }
  }
  std::vector<Row> rows;
  const auto add = [&rows](const std::string& what, const std::vector<double>& ours, const std::vector<double>& theirs) {
    for (const auto& [name, share] : {std::pair{", p50", 0.5}, {", p99", 0.99}}) {
      rows.push_back({what + name, "µs", Quantile(ours, share), Quantile(theirs, share), kNaN, ""});
    }
  };
  add("one stream at 100 Hz", alone, echo_alone);
  add("  beside a training and " + std::to_string(adaptations / kRounds) + " adaptations", busy, echo_busy);
  add("  beside a model loaded every second", loading, echo_loading);
  return rows;
}

double ResidentKib(pid_t pid) {
  std::ifstream status("/proc/" + std::to_string(pid) + "/status");
  for (std::string line; std::getline(status, line);) {
    if (line.rfind("VmRSS:", 0) == 0) return std::stod(line.substr(6));
  }
  Fail("the server's memory cannot be read");
}

/// Of streams that take turns, as many messages in flight as ever.
template <class Stream>
double RateOfTurns(const std::vector<std::unique_ptr<Stream>>& streams) {
  size_t out = 0, in = 0;
  return MessagesPerSecond(kMessagesInFlight, kSecondsPerRound, [&] { streams[out++ % streams.size()]->Send(); },
                           [&] { streams[in++ % streams.size()]->Receive(); });
}

/// A server with so many sessions, and an echo server with as many streams.
class GrownServer {
 public:
  GrownServer(const std::string& data_directory, size_t sessions)
      : server_(ServerProcess::Metaekfd(data_directory)), echo_(METAEKF_ECHO_BINARY, {}) {
    Check(client::Client({.server = server_.address()}).ImportModel("van-der-pol", ZooModel()).status(), "importing");
    std::vector<double> opening_ms;
    while (streams_.size() < sessions) {
      if (streams_.size() % kSessionsPerConnection == 0) {
        connections_.push_back(std::make_unique<client::Client>(client::Options{.server = server_.address()}));
        (void)connections_.back()->GetServerInfo();  // connected
      }
      const steady_clock::time_point begin = steady_clock::now();
      streams_.push_back(std::make_unique<EstimateStream>(connections_.back().get(), 1));
      opening_ms.push_back(1e3 * SecondsSince(begin));
    }
    opening_ms_ = Median(opening_ms);
    std::shared_ptr<grpc::Channel> connection;
    for (; echo_streams_.size() < sessions; echo_streams_.push_back(std::make_unique<EchoStream>(connection, SizesOf(1)))) {
      if (echo_streams_.size() % kSessionsPerConnection == 0) connection = ConnectionTo(echo_.address());
    }
    for (const auto& stream : streams_) stream->Send(), stream->Receive();  // until everything is warm
    for (const auto& stream : echo_streams_) stream->Send(), stream->Receive();
  }

  void Measure() {
    rates_.push_back(RateOfTurns(streams_));
    echo_rates_.push_back(RateOfTurns(echo_streams_));
  }

  size_t sessions() const { return streams_.size(); }
  double opening_ms() const { return opening_ms_; }
  double rate() const { return Median(rates_); }
  double echo_rate() const { return Median(echo_rates_); }
  double resident_kib() const { return ResidentKib(server_.pid()); }

 private:
  ServerProcess server_, echo_;
  std::vector<std::unique_ptr<client::Client>> connections_;
  std::vector<std::unique_ptr<EstimateStream>> streams_;
  std::vector<std::unique_ptr<EchoStream>> echo_streams_;
  double opening_ms_ = 0;
  std::vector<double> rates_, echo_rates_;
};

/// More and more sessions, and as many streams of the echo. Measured in turns: what a host does meanwhile changes more than what sets them apart.
std::vector<Row> Growth(const std::filesystem::path& data) {
  std::vector<std::unique_ptr<GrownServer>> servers;
  for (const size_t sessions : kSessions) {
    servers.push_back(std::make_unique<GrownServer>((data / ("growth-" + std::to_string(sessions))).string(), sessions));
  }
  for (int round = 0; round < kRounds; ++round) {
    for (const auto& server : servers) server->Measure();
  }
  std::vector<Row> rows;
  double before_kib = 0;
  size_t before = 0;
  for (const auto& server : servers) {
    const std::string of = std::to_string(server->sessions()) + " sessions, ";
    const double kib = server->resident_kib();
    rows.push_back({of + "estimates", "1/s", server->rate(), server->echo_rate(), server->rate() / server->echo_rate(), ""});
    rows.push_back({of + "opening one", "ms", server->opening_ms(), kNaN, kNaN, ""});
    rows.push_back({of + "server memory of each more", "KiB",
                    before > 0 ? (kib - before_kib) / static_cast<double>(server->sessions() - before) : kNaN, kNaN, kNaN, ""});
    before = server->sessions();
    before_kib = kib;
  }
  return rows;
}

/// A model of some 600,000 parameters with the channels of the oscillator.
std::string LargeModel() {
  nssm::ModelSpec spec = LocalisationSpec();
  spec.input_size = 0;
  spec.state_size = 2;
  spec.curl_free_positions.clear();
  nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(spec));
  bundle.parameters = bundle.model.InitialParameters(1);
  nssm::RoundToPrecision(spec.precision, &bundle.parameters);
  return nssm::WriteModelFile(bundle);
}

/// Sessions of a large model, each with one message in flight: waiting samples are applied together.
std::vector<Row> Large(client::Client* client) {
  std::vector<Row> rows;
  std::vector<std::unique_ptr<EstimateStream>> streams;
  for (const size_t sessions : {1, 4, 16}) {
    while (streams.size() < sessions) streams.push_back(std::make_unique<EstimateStream>(client, 1, "large"));
    std::vector<double> rates;
    for (int round = 0; round < kRounds; ++round) {
      size_t out = 0, in = 0;
      rates.push_back(MessagesPerSecond(static_cast<int>(sessions), kSecondsPerRound, [&] { streams[out++ % sessions]->Send(); },
                                        [&] { streams[in++ % sessions]->Receive(); }));
    }
    rows.push_back({std::to_string(sessions) + " sessions of one large model, estimates", "1/s", Median(rates), kNaN, kNaN, ""});
  }
  return rows;
}

/// From the start of the program to "listening on", with many models in the registry.
std::vector<Row> Start(const std::string& data) {
  {
    ServerProcess server = ServerProcess::Metaekfd(data);
    client::Client client({.server = server.address()});
    for (int i = 0; i < kModels; ++i) Check(client.ImportModel("model-" + std::to_string(i), ZooModel(i)).status(), "importing");
    server.End(SIGTERM);
  }
  std::vector<double> seconds;
  for (int round = 0; round < kRounds; ++round) {
    const steady_clock::time_point begin = steady_clock::now();
    ServerProcess server = ServerProcess::Metaekfd(data);
    seconds.push_back(SecondsSince(begin));
    if (server.address().empty()) Fail("the server does not start");
    server.End(SIGTERM);
  }
  return {{"start with " + std::to_string(kModels) + " models", "s", Median(seconds), kNaN, kNaN, ""}};
}

/// @param only  the one table to make; empty: all.
int Main(const std::string& only, const std::string& json) {
  const std::filesystem::path data = std::filesystem::temp_directory_path() / ("metaekf-benchmark-" + std::to_string(getpid()));
  std::filesystem::create_directories(data);
  std::vector<Row> all;
  const auto report = [&](const std::string& title, const std::function<std::vector<Row>()>& measure) {
    if (!only.empty() && only != title) return;
    const std::vector<Row> rows = measure();
    Print(title, rows);
    all.insert(all.end(), rows.begin(), rows.end());
  };
  {
    ServerProcess ours = ServerProcess::Metaekfd((data / "streams").string()), echo(METAEKF_ECHO_BINARY, {});
    if (ours.address().empty() || echo.address().empty()) Fail("a server does not start");
    client::Client client({.server = ours.address()});
    Check(client.ImportModel("van-der-pol", ZooModel()).status(), "importing");
    report("Streams", [&] { return Throughput(&client, echo.address()); });
    report("Latency", [&] { return Latency(&client, echo.address()); });
    Check(client.ImportModel("large", LargeModel()).status(), "importing");
    report("Large", [&] { return Large(&client); });
    ours.End(SIGTERM);
    echo.End(SIGTERM);
  }
  report("Checkpoints", [&] {
    const std::string off = (data / "off.textproto").string();
    std::ofstream(off) << "sessions { checkpoint_period_s: 0 }";
    ServerProcess server = ServerProcess::Metaekfd((data / "on").string()), server_off = ServerProcess::Metaekfd((data / "off").string(), off);
    client::Client with({.server = server.address()}), without({.server = server_off.address()});
    for (client::Client* client : {&with, &without}) Check(client->ImportModel("van-der-pol", ZooModel()).status(), "importing");
    std::vector<Row> rows = Checkpoints(&with, &without);
    server.End(SIGTERM);
    server_off.End(SIGTERM);
    return rows;
  });
  report("Growth", [&] { return Growth(data); });
  report("Start", [&] { return Start((data / "start").string()); });
  std::filesystem::remove_all(data);
  if (all.empty()) Fail("there is no table " + only + "; there are Streams, Latency, Large, Checkpoints, Growth and Start");
  if (!json.empty() && !AddToJson(json, all)) Fail(json + " cannot be written");
  return 0;
}

}  // namespace
}  // namespace metaekf::benchmark

int main(int argc, char** argv) {
  std::map<std::string, std::string> options = {{"--only", ""}, {"--json", ""}};
  for (int i = 1; i + 1 < argc; i += 2) {
    if (const auto option = options.find(argv[i]); option != options.end()) option->second = argv[i + 1];
  }
  if (argc % 2 == 0 || argc > 5 || (argc > 1 && options["--only"].empty() && options["--json"].empty())) {
    std::fprintf(stderr, "usage: %s [--only TABLE] [--json FILE]\n", argv[0]);
    return 2;
  }
  return metaekf::benchmark::Main(options["--only"], options["--json"]);
}
