// What would fill a server's memory or take it from its neighbours: refused by name or held within bounds, and none of it
// stays. Memory is the process's own, read from outside.
//
// METAEKF_FAULTS=long: a million tiny messages instead of a hundred thousand.

#include <arpa/inet.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>
#include <sys/socket.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <fstream>
#include <thread>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "metaekf/client.h"
#include "metaekf/v1/estimation.grpc.pb.h"
#include "metaekf/v1/model.grpc.pb.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/support/faults.h"
#include "tests/support/stream_signal.h"

namespace metaekf::server {
namespace {

using std::chrono::steady_clock;

constexpr double kMostGrowthMb = 100;

class BombsTest : public ::testing::Test {
 protected:
  explicit BombsTest(double reconnect_for_s = 0)
      : server_(ServerProcess::Metaekfd(directory_.path())), reconnect_for_s_(reconnect_for_s) {}

  void SetUp() override {
    ASSERT_NE(server_.address(), "");
    ASSERT_TRUE(Client(server_.address()).Import(ImportRequests("robot", nssm::WriteModelFile(TinyStateBundle()))).ok());
    neighbour_ = std::thread([this] { BeNeighbour(); });
    while (latencies_ < 200 && !HasFailure()) std::this_thread::yield();
    std::ofstream(absl::StrCat("/proc/", server_.pid(), "/clear_refs")) << "5";  // the peak begins anew
    before_mb_ = PeakMb();
  }

  /// A neighbour has been served all the while, and the memory stayed within bounds.
  void TearDown() override {
    done_ = true;
    if (neighbour_.joinable()) neighbour_.join();
    const double growth_mb = PeakMb() - before_mb_;
    EXPECT_LT(growth_mb, kMostGrowthMb);
    std::printf("memory %.1f MB, at most %.1f MB more; the neighbour waited %.1f ms at most\n", before_mb_,
                growth_mb, 1e3 * slowest_s_);
    EXPECT_EQ(server_.End(SIGTERM).code, 0);
  }

  /// Of resident memory, as the kernel keeps it.
  double PeakMb() const {
    std::ifstream status(absl::StrCat("/proc/", server_.pid(), "/status"));
    for (std::string word; status >> word;) {
      double kb = 0;
      if (word == "VmHWM:" && status >> kb) return kb * 1024e-6;
    }
    ADD_FAILURE() << "no VmHWM";
    return 0;
  }

  void BeNeighbour() {
    client::Client client({.server = server_.address()});
    client::EstimationOptions options;
    options.target.model = "robot";
    options.reconnect_for_s = reconnect_for_s_;
    const auto session = client.OpenEstimation(options);
    ASSERT_TRUE(session.ok()) << session.status().message;
    for (uint64_t seq = 1; !done_; ++seq) {
      const auto start = steady_clock::now();
      ASSERT_TRUE((*session)->Send(metaekf::testing::SignalSamples(0, seq, 1)).ok());
      const auto batch = (*session)->Receive();
      ASSERT_TRUE(batch.ok()) << batch.status().message;
      slowest_s_ = std::max(slowest_s_.load(), std::chrono::duration<double>(steady_clock::now() - start).count());
      ++latencies_;
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
  }

  std::shared_ptr<grpc::Channel> Channel() {
    grpc::ChannelArguments arguments;
    arguments.SetMaxSendMessageSize(-1);
    arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
    arguments.SetInt(GRPC_ARG_HTTP2_BDP_PROBE, 0);  // a reader that does not read takes 64 KiB, and no more
    return grpc::CreateCustomChannel(server_.address(), grpc::InsecureChannelCredentials(), arguments);
  }

  store::TempDirectory directory_;
  ServerProcess server_;
  const double reconnect_for_s_;  // 0: its connection is not to be lost either
  std::thread neighbour_;
  std::atomic<bool> done_ = false;
  std::atomic<int> latencies_ = 0;
  std::atomic<double> slowest_s_ = 0;
  double before_mb_ = 0;
};

TEST_F(BombsTest, ACompressedMessageIsNotInflated) {
  const auto stub = v1::ModelService::NewStub(Channel());
  grpc::ClientContext context;
  context.set_compression_algorithm(GRPC_COMPRESS_GZIP);
  v1::ListModelsRequest request;
  request.set_page_token(std::string(size_t{256} << 20, 'x'));
  v1::ListModelsResponse response;
  const grpc::Status status = stub->ListModels(&context, request, &response);
  EXPECT_EQ(status.error_code(), grpc::StatusCode::UNIMPLEMENTED) << status.error_message();
}

/// gRPC 1.51 takes a message whole before it looks at its size. What its buffers may hold in all bounds that; near the bound
/// it ends connections, its neighbours' perhaps, which the client library opens again.
class LargeMessageTest : public BombsTest {
 protected:
  LargeMessageTest() : BombsTest(60) {}
};

TEST_F(LargeMessageTest, OneOf512MegabytesIsRefusedWithinTheBoundOfAllBuffers) {
  const auto stub = v1::ModelService::NewStub(Channel());
  grpc::ClientContext context;
  v1::ListModelsRequest request;
  request.set_page_token(std::string(size_t{512} << 20, 'x'));
  v1::ListModelsResponse response;
  const grpc::Status status = stub->ListModels(&context, request, &response);
  // By the size of one message, or of all buffers.
  EXPECT_TRUE(status.error_code() == grpc::StatusCode::RESOURCE_EXHAUSTED ||
              status.error_code() == grpc::StatusCode::UNAVAILABLE)
      << status.error_code() << ": " << status.error_message();
}

TEST_F(BombsTest, TinyMessagesAreTakenOneByOne) {
  const auto stub = v1::ModelService::NewStub(Channel());
  grpc::ClientContext context;
  v1::ModelVersion response;
  const auto writer = stub->ImportModelVersion(&context, &response);
  v1::ImportModelVersionRequest request;
  const int messages = metaekf::testing::LongFaults() ? 1'000'000 : 100'000;
  request.mutable_header()->set_parent("models/bytes");
  request.mutable_header()->set_size_bytes(static_cast<uint64_t>(messages));
  request.mutable_header()->set_sha256(std::string(64, '0'));
  ASSERT_TRUE(writer->Write(request));
  request.set_chunk("x");
  for (int m = 0; m < messages && writer->Write(request); ++m) continue;
  writer->WritesDone();
  EXPECT_EQ(writer->Finish().error_code(), grpc::StatusCode::DATA_LOSS);  // of another digest
}

TEST_F(BombsTest, AThousandReadersThatNeverReadAreCutOff) {
  constexpr int kReaders = 1000, kPerConnection = 100;
  struct Reader {
    bool writing = false;
    uint64_t requests = 0;
    grpc::ClientContext context;
    std::unique_ptr<grpc::ClientAsyncReaderWriter<v1::EstimateRequest, v1::EstimateResponse>> stream;
  };
  grpc::CompletionQueue queue;
  std::vector<std::unique_ptr<v1::EstimationService::Stub>> stubs;
  std::vector<std::unique_ptr<Reader>> readers;
  const auto wait = [&] {
    void* tag = nullptr;
    bool ok = false;
    EXPECT_TRUE(queue.Next(&tag, &ok));
    return ok;
  };
  v1::EstimateRequest open, samples;
  open.mutable_open()->set_target("models/robot");
  open.mutable_open()->set_covariance_format(v1::OpenSession::LOWER_TRIANGLE);
  constexpr int kRows = 64, kRequests = 40;  // whose answers are more than a stream takes that nobody reads
  for (int row = 0; row < kRows; ++row) {
    samples.mutable_samples()->add_inputs(0.1);
    samples.mutable_samples()->add_outputs(0.1);
  }
  for (int r = 0; r < kReaders; ++r) {
    if (r % kPerConnection == 0) stubs.push_back(v1::EstimationService::NewStub(Channel()));
    Reader& reader = *readers.emplace_back(std::make_unique<Reader>());
    reader.stream = stubs.back()->AsyncEstimate(&reader.context, &queue, nullptr);
    ASSERT_TRUE(wait());
    reader.stream->Write(open, nullptr);
    ASSERT_TRUE(wait());
  }
  // As many requests as each stream takes; one that finds no room stays under way.
  for (int request = 0; request < kRequests; ++request) {
    int writes = 0;
    for (const auto& reader : readers) {
      if (reader->writing) continue;
      reader->writing = true;
      samples.mutable_samples()->set_first_seq(1 + kRows * reader->requests++);
      reader->stream->Write(samples, reader.get());
      ++writes;
    }
    void* tag = nullptr;
    bool ok = false;
    for (; writes > 0 && queue.AsyncNext(&tag, &ok, std::chrono::system_clock::now() + std::chrono::milliseconds(200)) ==
                             grpc::CompletionQueue::GOT_EVENT;
         --writes) {
      static_cast<Reader*>(tag)->writing = false;
    }
  }
  const auto cut_off = [&] {
    double count = 0;
    const auto families = client::Client({.server = server_.address()}).GetMetrics();
    EXPECT_TRUE(families.ok()) << families.status().message;
    for (const client::MetricFamily& family : families.ok() ? *families : std::vector<client::MetricFamily>()) {
      for (const client::Metric& metric : family.metrics) {
        const bool exhausted = family.name == "metaekf_calls_total" && metric.labels.at("code") == "RESOURCE_EXHAUSTED";
        if (exhausted) count += metric.value;
      }
    }
    return count;
  };
  const auto deadline = steady_clock::now() + std::chrono::seconds(60);
  while (cut_off() < kReaders && steady_clock::now() < deadline && !HasFailure()) {
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
  }
  EXPECT_EQ(cut_off(), kReaders);
  for (const auto& reader : readers) reader->context.TryCancel();
  queue.Shutdown();
  void* tag = nullptr;
  bool ok = false;
  while (queue.Next(&tag, &ok)) continue;
}

TEST_F(BombsTest, ConnectionsThatNeverSayWhatTheyWantCostLittle) {
  const size_t colon = server_.address().rfind(':');
  int port = 0;
  ASSERT_TRUE(absl::SimpleAtoi(server_.address().substr(colon + 1), &port));
  sockaddr_in address{.sin_family = AF_INET, .sin_port = htons(static_cast<uint16_t>(port))};
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  std::vector<int> connections;
  const std::string preface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
  for (int c = 0; c < 500; ++c) {
    const int connection = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    ASSERT_EQ(connect(connection, reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
    // Half of them not even the whole greeting.
    const size_t bytes = c % 2 == 0 ? preface.size() : static_cast<size_t>(c) % preface.size();
    ASSERT_EQ(write(connection, preface.data(), bytes), static_cast<ssize_t>(bytes));
    connections.push_back(connection);
  }
  for (const int until = latencies_ + 1000; latencies_ < until && !HasFailure();) std::this_thread::yield();
  for (const int connection : connections) close(connection);
}

TEST_F(BombsTest, TenThousandSessionsWithoutASampleCostLittle) {
  const auto stub = v1::EstimationService::NewStub(Channel());
  v1::EstimateRequest open;
  open.mutable_open()->set_target("models/robot");
  for (int s = 0; s < 10'000; ++s) {
    grpc::ClientContext context;
    const auto stream = stub->Estimate(&context);
    v1::EstimateResponse response;
    ASSERT_TRUE(stream->Write(open) && stream->Read(&response)) << s;
    stream->WritesDone();
    ASSERT_TRUE(stream->Finish().ok());
  }
}

}  // namespace
}  // namespace metaekf::server
