// What clients see of a server that goes and comes back.

#include <chrono>
#include <thread>

#include "metaekf/client.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/support/sanitized.h"
#include "tests/support/stream_signal.h"

namespace metaekf::server {
namespace {

using std::chrono::steady_clock;

constexpr int kThreads = 8;       // each with a connection of its own
constexpr int kPerThread = 125;

class RestartTest : public ::testing::Test {
 protected:
  using Sessions = std::vector<std::unique_ptr<client::EstimationSession>>;

  /// Runs `work` for all threads at a time.
  static void ForEachThread(const std::function<void(int thread)>& work) {
    std::vector<std::thread> threads;
    for (int t = 0; t < kThreads; ++t) threads.emplace_back(work, t);
    for (std::thread& thread : threads) thread.join();
  }

  store::TempDirectory directory_;
};

TEST_F(RestartTest, TheNextCallReachesTheNewServer) {
  auto server = std::make_unique<ServerProcess>(ServerProcess::Metaekfd(directory_.path()));
  const std::string address = server->address();
  client::Client client(client::Options{.server = address});
  for (const int signal : {SIGTERM, SIGKILL, SIGTERM, SIGKILL}) {
    ASSERT_TRUE(client.GetServerInfo().ok());
    server->End(signal);
    server = std::make_unique<ServerProcess>(ServerProcess::Metaekfd(directory_.path(), /*config=*/"", address));
    ASSERT_EQ(server->address(), address);
    const auto info = client.GetServerInfo();
    EXPECT_TRUE(info.ok()) << signal << ": " << info.status().message;
  }
}

TEST_F(RestartTest, AStopEndsAThousandStreamsSoThatNoneLosesASampleAndARestartServesAllWithinSeconds) {
  auto server = std::make_unique<ServerProcess>(ServerProcess::Metaekfd(directory_.path()));
  const std::string address = server->address();
  ASSERT_NE(address, "");
  ASSERT_TRUE(Client(address).Import(ImportRequests("robot", nssm::WriteModelFile(TinyStateBundle()))).ok());
  std::vector<client::Client> clients;
  for (int t = 0; t < kThreads; ++t) clients.emplace_back(client::Options{.server = address});
  std::vector<Sessions> sessions(kThreads);
  constexpr uint64_t kSamples = 5;
  ForEachThread([&](int t) {
    for (int s = 0; s < kPerThread; ++s) {
      client::EstimationOptions options;
      options.target.model = "robot";
      options.reconnect_for_s = 0;
      auto session = clients[static_cast<size_t>(t)].OpenEstimation(options);
      ASSERT_TRUE(session.ok()) << session.status().message;
      for (uint64_t seq = 1; seq <= kSamples; ++seq) {
        ASSERT_TRUE((*session)->Send(metaekf::testing::SignalSamples(s, seq, 1)).ok());
        ASSERT_TRUE((*session)->Receive().ok());
      }
      sessions[static_cast<size_t>(t)].push_back(std::move(*session));
    }
  });
  ASSERT_FALSE(HasFatalFailure());

  const auto stop = steady_clock::now();
  std::thread reader([&] {
    ForEachThread([&](int t) {
      for (const auto& session : sessions[static_cast<size_t>(t)]) {
        const client::Status status = session->Receive().status();
        EXPECT_EQ(status.code, client::Code::kUnavailable) << status.message;
        EXPECT_EQ(status.reason, "DRAINING") << status.message;
        EXPECT_EQ(status.metadata.count("durable_seq"), 1u);
      }
    });
  });
  EXPECT_EQ(server->End(SIGTERM).code, 0);
  reader.join();
  const double stopped = std::chrono::duration<double>(steady_clock::now() - stop).count();
  EXPECT_LT(stopped, 10);

  const auto start = steady_clock::now();
  server = std::make_unique<ServerProcess>(ServerProcess::Metaekfd(directory_.path(), /*config=*/"", address));
  ASSERT_EQ(server->address(), address);
  ForEachThread([&](int t) {
    for (int s = 0; s < kPerThread; ++s) {
      const auto& session = sessions[static_cast<size_t>(t)][static_cast<size_t>(s)];
      client::Status resumed = session->Resume();
      // The first of a connection may find out only now that it was lost.
      while (resumed.code == client::Code::kUnavailable && steady_clock::now() - start < std::chrono::seconds(10)) {
        resumed = session->Resume();
      }
      ASSERT_TRUE(resumed.ok()) << resumed.message;
      ASSERT_TRUE(session->Send(metaekf::testing::SignalSamples(s, kSamples + 1, 1)).ok());
      // What the server could not know to have arrived comes again first.
      uint64_t received = 0;
      while (received < kSamples + 1) {
        const auto batch = session->Receive();
        ASSERT_TRUE(batch.ok()) << batch.status().message;
        ASSERT_TRUE(received == 0 || (*batch)->first_seq == received + 1) << received;
        received = (*batch)->first_seq;
      }
      ASSERT_EQ(received, kSamples + 1);
    }
  });
  const double seconds = std::chrono::duration<double>(steady_clock::now() - start).count();
  std::printf("%d sessions: stopped in %.2f s, estimate again %.2f s after the start\n", kThreads * kPerThread, stopped, seconds);
  if (!METAEKF_SANITIZED) {
    EXPECT_LT(seconds, 2);
  }
}

}  // namespace
}  // namespace metaekf::server
