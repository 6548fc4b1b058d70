// See README.md beside this file.

#include <grpcpp/grpcpp.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "echo.grpc.pb.h"
#include "metaekf/client.h"
#include "metaekf/v1/estimation.pb.h"
#include "server/training/worker_process.h"
#include "tests/benchmark/report.h"

namespace metaekf::benchmark {
namespace {

using std::chrono::steady_clock;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr size_t kOutputs = 2;         // of the van der Pol model, which has no inputs and two states
constexpr int kMessagesInFlight = 8;
constexpr int kRounds = 5;
constexpr int kBatch = 64;
constexpr double kSecondsPerRound = 1;
constexpr int kSamplesAt100Hz = 300;   // of a round

[[noreturn]] void Fail(const std::string& what) {
  std::fprintf(stderr, "service_benchmark: %s\n", what.c_str());
  std::exit(1);
}

void Check(const client::Status& status, const std::string& what) {
  if (!status.ok()) Fail(what + ": " + status.message);
}

/// A server of its own process.
class Server {
 public:
  Server(const std::string& binary, const std::vector<std::string>& arguments)
      : process_(server::WorkerProcess::Start(binary, arguments).value()) {
    const std::string prefix = "listening on ";
    const auto line = process_.ReadLine(absl::Seconds(30), /*wake_fd=*/-1);
    if (!line || line->rfind(prefix, 0) != 0) Fail(binary + " does not start");
    address_ = line->substr(prefix.size());
  }
  ~Server() {
    process_.Signal(SIGTERM);
    process_.Wait();
  }
  const std::string& address() const { return address_; }

 private:
  server::WorkerProcess process_;
  std::string address_;
};

/// A message there and one back, at most `in_flight` of them at a time. @return messages per second.
/// @param send  the next message. @param receive  waits for one.
double MessagesPerSecond(int in_flight, double seconds, const std::function<void()>& send, const std::function<void()>& receive) {
  std::mutex mutex;
  std::condition_variable changed;
  int64_t sent = 0, received = 0;
  bool stop = false;
  std::thread sender([&] {
    while (true) {
      {
        std::unique_lock lock(mutex);
        changed.wait(lock, [&] { return stop || sent - received < in_flight; });
        if (stop) return;
        ++sent;
      }
      send();
    }
  });
  const auto take = [&] {
    receive();
    std::lock_guard lock(mutex);
    ++received;
    changed.notify_one();
  };
  for (int i = 0; i < 200; ++i) take();  // until everything is warm
  const steady_clock::time_point begin = steady_clock::now();
  int64_t count = 0;
  double elapsed = 0;
  for (; elapsed < seconds; ++count) {
    take();
    if (count % 32 == 0) elapsed = std::chrono::duration<double>(steady_clock::now() - begin).count();
  }
  elapsed = std::chrono::duration<double>(steady_clock::now() - begin).count();
  int64_t left;
  {
    std::lock_guard lock(mutex);
    stop = true;
    changed.notify_one();
  }
  sender.join();
  for (left = sent - received; left > 0; --left) receive();
  return static_cast<double>(count) / elapsed;
}

/// Round trips at 100 Hz. @return of each, in µs.
std::vector<double> LatenciesAt100Hz(const std::function<void()>& round_trip) {
  std::vector<double> latencies;
  steady_clock::time_point next = steady_clock::now();
  for (int i = 0; i < kSamplesAt100Hz; ++i) {
    next += std::chrono::milliseconds(10);
    std::this_thread::sleep_until(next);
    const steady_clock::time_point begin = steady_clock::now();
    round_trip();
    latencies.push_back(std::chrono::duration<double, std::micro>(steady_clock::now() - begin).count());
  }
  return latencies;
}

/// Sizes of messages on the wire.
struct Sizes {
  size_t request, response;
};

Sizes SizesOf(int samples) {
  v1::EstimateRequest request;
  request.mutable_samples()->set_first_seq(100'000);
  v1::EstimateResponse response;
  v1::EstimateBatch* batch = response.mutable_estimates();
  batch->set_first_seq(100'000);
  batch->set_durable_seq(100'000);
  for (int i = 0; i < samples; ++i) {
    for (size_t k = 0; k < kOutputs; ++k) {
      request.mutable_samples()->add_outputs(0.1);
      batch->add_means(0.1);
      batch->add_covariances(0.1);
    }
    batch->add_times_s(0.1);
    batch->add_nis(0.1);
    batch->add_health(v1::EstimateBatch::CONSISTENT);
    batch->add_flags(0);
  }
  return {request.ByteSizeLong(), response.ByteSizeLong()};
}

class EchoStream {
 public:
  EchoStream(const std::string& address, const Sizes& sizes)
      : stub_(Echo::NewStub(grpc::CreateChannel(address, grpc::InsecureChannelCredentials()))), stream_(stub_->Stream(&context_)) {
    // A payload's tag and length take two bytes up to 127, and as many the number of bytes in the reply.
    request_.mutable_payload()->resize(sizes.request > 4 ? sizes.request - 4 : 0);
    request_.set_reply_bytes(static_cast<uint32_t>(sizes.response - 2));
  }
  ~EchoStream() {
    context_.TryCancel();
    stream_->Finish();
  }
  void Send() {
    if (!stream_->Write(request_)) Fail("the echo has ended");
  }
  void Receive() {
    if (!stream_->Read(&reply_)) Fail("the echo has ended");
  }

 private:
  std::unique_ptr<Echo::Stub> stub_;
  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<EchoRequest, EchoReply>> stream_;
  EchoRequest request_;
  EchoReply reply_;
};

class EstimateStream {
 public:
  EstimateStream(client::Client* client, int samples_per_message) {
    client::EstimationOptions options;
    options.target.model = "van-der-pol";
    auto session = client->OpenEstimation(options);
    Check(session.status(), "opening a session");
    session_ = std::move(*session);
    samples_.samples = static_cast<size_t>(samples_per_message);
    samples_.outputs.assign(samples_.samples * kOutputs, 0);
  }
  void Send() {
    for (size_t i = 0; i < samples_.samples; ++i, ++time_) {
      samples_.outputs[kOutputs * i] = 2 * std::sin(0.01 * time_);
      samples_.outputs[kOutputs * i + 1] = 2 * std::cos(0.01 * time_);
    }
    Check(session_->Send(samples_).status(), "sending");
  }
  void Receive() {
    const auto batch = session_->Receive();
    Check(batch.status(), "receiving");
  }

 private:
  std::unique_ptr<client::EstimationSession> session_;
  client::SampleBatch samples_;
  double time_ = 0;
};

template <class Stream>
double Rate(Stream* stream) {
  return MessagesPerSecond(kMessagesInFlight, kSecondsPerRound, [&] { stream->Send(); }, [&] { stream->Receive(); });
}

std::vector<Row> Throughput(client::Client* client, const std::string& echo) {
  std::vector<double> echoed, single, batched;
  for (int round = 0; round < kRounds; ++round) {
    EchoStream peer(echo, SizesOf(1));
    echoed.push_back(Rate(&peer));
    EstimateStream one(client, 1);
    single.push_back(Rate(&one));
    EstimateStream many(client, kBatch);
    batched.push_back(kBatch * Rate(&many));
  }
  const double messages = Median(echoed), estimates = Median(single), samples = Median(batched);
  return {{"one stream, one sample a message", "1/s", estimates, messages, estimates / messages, "stream_echo"},
          {"one stream, 64 samples a message, samples", "1/s", samples, messages, samples / messages, "stream_batch"}};
}

std::vector<Row> Latency(client::Client* client, const std::string& echo) {
  std::vector<double> echoed, estimated;
  for (int round = 0; round < kRounds; ++round) {
    EchoStream peer(echo, SizesOf(1));
    EstimateStream stream(client, 1);
    const auto add = [](const std::vector<double>& from, std::vector<double>* to) { to->insert(to->end(), from.begin(), from.end()); };
    add(LatenciesAt100Hz([&] { peer.Send(), peer.Receive(); }), &echoed);
    add(LatenciesAt100Hz([&] { stream.Send(), stream.Receive(); }), &estimated);
  }
  std::vector<Row> rows;
  for (const auto& [name, share] : {std::pair{"p50", 0.5}, {"p99", 0.99}}) {
    rows.push_back({std::string("one stream at 100 Hz, ") + name, "µs", Quantile(estimated, share), Quantile(echoed, share), kNaN, ""});
  }
  return rows;
}

std::string Contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) Fail(path + " cannot be read");
  std::ostringstream bytes;
  bytes << file.rdbuf();
  return bytes.str();
}

int Main(const std::string& json) {
  const std::filesystem::path data = std::filesystem::temp_directory_path() / ("metaekf-benchmark-" + std::to_string(getpid()));
  std::vector<Row> all;
  {
    const Server ours(METAEKFD_BINARY, {"--data-dir", data.string(), "--listen", "127.0.0.1:0"}), echo(METAEKF_ECHO_BINARY, {});
    client::Client client({.server = ours.address()});
    Check(client.ImportModel("van-der-pol", Contents(METAEKF_SOURCE_DIR "/deploy/zoo/van-der-pol.safetensors")).status(), "importing");
    for (const auto& [title, measure] : {std::pair{"Streams", &Throughput}, {"Latency", &Latency}}) {
      const std::vector<Row> rows = measure(&client, echo.address());
      Print(title, rows);
      all.insert(all.end(), rows.begin(), rows.end());
    }
  }
  std::filesystem::remove_all(data);
  if (!json.empty() && !AddToJson(json, all)) Fail(json + " cannot be written");
  return 0;
}

}  // namespace
}  // namespace metaekf::benchmark

int main(int argc, char** argv) {
  const bool with_json = argc == 3 && std::string(argv[1]) == "--json";
  if (argc != 1 && !with_json) {
    std::fprintf(stderr, "usage: %s [--json FILE]\n", argv[0]);
    return 2;
  }
  return metaekf::benchmark::Main(with_json ? argv[2] : "");
}
