// What happens to the server under streams, at seeded moments: the client library goes on by itself; no estimate is missed, none
// comes twice, and all are those of a stream that nobody disturbed, bit for bit.
//
// METAEKF_FAULTS=long: 1,000 times instead of 50.

#include <atomic>
#include <functional>
#include <optional>
#include <thread>

#include "core/base/rng.h"
#include "metaekf/client.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/support/faults.h"
#include "tests/support/stream_signal.h"

namespace metaekf::server {
namespace {

constexpr int kStreams = 6;
constexpr size_t kLargestBatch = 8;

/// Means and covariances of all samples, one after the other.
using Estimates = std::vector<double>;

class StreamKillTest : public ::testing::Test {
 protected:
  void SetUp() override {
    ServerProcess server = ServerProcess::Metaekfd(directory_.path());
    ASSERT_NE(server.address(), "");
    address_ = server.address();
    Client client(address_);
    ASSERT_TRUE(client.Import(ImportRequests("robot", nssm::WriteModelFile(TinyStateBundle()))).ok());
    server.End(SIGKILL);
  }

  /// On the address of the first, as a supervisor would start it again.
  ServerProcess StartServer() {
    ServerProcess server = ServerProcess::Metaekfd(directory_.path(), /*config=*/"", address_);
    EXPECT_EQ(server.address(), address_);
    return server;
  }

  std::unique_ptr<client::EstimationSession> Open(client::Client& client) {
    client::EstimationOptions options;
    options.target.model = "robot";
    options.covariance = client::CovarianceFormat::kLowerTriangle;
    auto session = client.OpenEstimation(options);
    EXPECT_TRUE(session.ok()) << session.status().message;
    return session.ok() ? std::move(*session) : nullptr;
  }

  /// Sends and receives, batch by batch, until `stop`; or so many samples.
  void Stream(client::EstimationSession& session, int stream, uint64_t samples, Estimates* estimates) {
    base::Rng rng(static_cast<uint64_t>(stream) + 1);
    for (uint64_t next = 1; samples > 0 ? next <= samples : !stop_;) {
      size_t count = 1 + rng.Index(kLargestBatch);
      if (samples > 0) count = std::min<size_t>(count, samples - next + 1);
      ASSERT_TRUE(session.Send(metaekf::testing::SignalSamples(stream, next, count)).ok()) << "stream " << stream << " sample " << next;
      for (size_t received = 0; received < count;) {
        const auto batch = session.Receive();
        ASSERT_TRUE(batch.ok() && batch->has_value()) << batch.status().message;
        ASSERT_EQ((*batch)->first_seq, next + received) << "stream " << stream;
        estimates->insert(estimates->end(), (*batch)->means.begin(), (*batch)->means.end());
        estimates->insert(estimates->end(), (*batch)->covariances.begin(), (*batch)->covariances.end());
        received += (*batch)->samples;
      }
      next += count;
      received_ += count;
    }
  }

  /// Streams to a server that is disturbed so often, and compares with what a server says that is not.
  void CheckUnder(int times, const std::function<void()>& disturb) {
    std::vector<Estimates> estimates(kStreams);
    server_.emplace(StartServer());
    {
      std::vector<client::Client> clients;
      std::vector<std::unique_ptr<client::EstimationSession>> sessions;
      for (int s = 0; s < kStreams; ++s) {
        clients.emplace_back(client::Options{.server = address_});
        sessions.push_back(Open(clients.back()));
        ASSERT_NE(sessions.back(), nullptr);
      }
      std::vector<std::thread> threads;
      for (int s = 0; s < kStreams; ++s) {
        threads.emplace_back([&, s] { Stream(*sessions[static_cast<size_t>(s)], s, 0, &estimates[static_cast<size_t>(s)]); });
      }
      for (int time = 0; time < times && !HasFailure(); ++time) {
        // Some before a stream has got anywhere, some in the midst of checkpoints.
        const uint64_t until = received_ + rng_.Index(2) * (1 + rng_.Index(3000)) + rng_.Index(20);
        while (received_ < until && !HasFailure()) std::this_thread::yield();
        disturb();
      }
      stop_ = true;
      for (std::thread& thread : threads) thread.join();
    }
    server_->End(SIGKILL);

    server_.emplace(StartServer());
    client::Client client({.server = address_});
    for (int s = 0; s < kStreams && !HasFailure(); ++s) {
      const Estimates& disturbed = estimates[static_cast<size_t>(s)];
      const auto session = Open(client);
      ASSERT_NE(session, nullptr);
      const size_t per_sample = session->info().estimate_size * (session->info().estimate_size + 3) / 2;
      ASSERT_GT(disturbed.size(), 0u);
      Estimates reference;
      Stream(*session, s, disturbed.size() / per_sample, &reference);
      ASSERT_EQ(reference.size(), disturbed.size());
      for (size_t i = 0; i < reference.size(); ++i) {
        ASSERT_EQ(reference[i], disturbed[i]) << "stream " << s << " sample " << i / per_sample + 1;
      }
    }
    RecordProperty("samples", std::to_string(received_));
  }

  store::TempDirectory directory_;
  std::string address_;
  base::Rng rng_{11};
  std::optional<ServerProcess> server_;
  std::atomic<bool> stop_ = false;
  std::atomic<uint64_t> received_ = 0;
};

TEST_F(StreamKillTest, NoSampleIsLostOrAppliedTwice) {
  CheckUnder(metaekf::testing::LongFaults() ? 1000 : 50, [this] {
    EXPECT_EQ(server_->End(SIGKILL).signal, SIGKILL);
    server_.emplace(StartServer());
  });
}

// One that stands still may go on at any time, and would then write beside the other.
TEST_F(StreamKillTest, AServerThatStandsStillIsTakenOverFromOnceItIsDead) {
  int round = 0;
  CheckUnder(6, [&] {
    kill(server_->pid(), SIGSTOP);
    EXPECT_EQ(ServerProcess::Metaekfd(directory_.path()).address(), "") << "a second server on the directory";
    if (++round % 2 == 0) {
      kill(server_->pid(), SIGCONT);
      return;
    }
    EXPECT_EQ(server_->End(SIGKILL).signal, SIGKILL);
    server_.emplace(StartServer());
  });
}

}  // namespace
}  // namespace metaekf::server
