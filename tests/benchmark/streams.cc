#include "tests/benchmark/streams.h"

#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <mutex>
#include <thread>

#include "metaekf/v1/estimation.pb.h"

namespace metaekf::benchmark {

using std::chrono::steady_clock;

namespace {

constexpr size_t kOutputs = 2;  // of the van der Pol model, which has no inputs and two states

}  // namespace

void Fail(const std::string& what) {
  std::fprintf(stderr, "service_benchmark: %s\n", what.c_str());
  std::exit(1);
}

void Check(const client::Status& status, const std::string& what) {
  if (!status.ok()) Fail(what + ": " + status.message);
}

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

std::vector<double> LatenciesAt100Hz(int count, const std::function<void()>& round_trip) {
  std::vector<double> latencies;
  steady_clock::time_point next = steady_clock::now();
  for (int i = 0; i < count; ++i) {
    next += std::chrono::milliseconds(10);
    std::this_thread::sleep_until(next);
    const steady_clock::time_point begin = steady_clock::now();
    round_trip();
    latencies.push_back(std::chrono::duration<double, std::micro>(steady_clock::now() - begin).count());
  }
  return latencies;
}

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

std::shared_ptr<grpc::Channel> ConnectionTo(const std::string& address) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  return grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(), arguments);
}

EchoStream::EchoStream(const std::string& address, const Sizes& sizes)
    : EchoStream(grpc::CreateChannel(address, grpc::InsecureChannelCredentials()), sizes) {}

EchoStream::EchoStream(const std::shared_ptr<grpc::Channel>& channel, const Sizes& sizes)
    : stub_(Echo::NewStub(channel)), stream_(stub_->Stream(&context_)) {
  // A payload's tag and length take two bytes up to 127, and as many the number of bytes in the reply.
  request_.mutable_payload()->resize(sizes.request > 4 ? sizes.request - 4 : 0);
  request_.set_reply_bytes(static_cast<uint32_t>(sizes.response - 2));
}

EchoStream::~EchoStream() {
  context_.TryCancel();
  stream_->Finish();
}

void EchoStream::Send() {
  if (!stream_->Write(request_)) Fail("the echo has ended");
}

void EchoStream::Receive() {
  if (!stream_->Read(&reply_)) Fail("the echo has ended");
}

EstimateStream::EstimateStream(client::Client* client, int samples_per_message, const std::string& model) {
  client::EstimationOptions options;
  options.target.model = model;
  auto session = client->OpenEstimation(options);
  Check(session.status(), "opening a session");
  session_ = std::move(*session);
  samples_.samples = static_cast<size_t>(samples_per_message);
  samples_.outputs.assign(samples_.samples * kOutputs, 0);
}

void EstimateStream::Send() {
  for (size_t i = 0; i < samples_.samples; ++i, ++time_) {
    samples_.outputs[kOutputs * i] = 2 * std::sin(0.01 * time_);
    samples_.outputs[kOutputs * i + 1] = 2 * std::cos(0.01 * time_);
  }
  Check(session_->Send(samples_).status(), "sending");
}

void EstimateStream::Receive() { Check(session_->Receive().status(), "receiving"); }

}  // namespace metaekf::benchmark
