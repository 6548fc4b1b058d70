// A disk that is full for a while, and one that gives back other bytes than it was given, under a running server.

#include <sys/resource.h>

#include <chrono>
#include <csignal>
#include <functional>
#include <thread>

#include "metaekf/client.h"
#include "server/store/database.h"
#include "tests/server/support/metric.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/support/stream_signal.h"

namespace metaekf::server {
namespace {

using client::Code;
using ::testing::HasSubstr;

class DiskTest : public ::testing::Test {
 protected:
  void SetUp() override {
    StartServer();
    ASSERT_TRUE(Connect().ImportModel("robot", model_).ok());
  }

  /// On the address of the first, as a supervisor would start it again.
  void StartServer() {
    server_ = std::make_unique<ServerProcess>(
        ServerProcess::Metaekfd(directory_.path(), /*config=*/"", address_.empty() ? "127.0.0.1:0" : address_));
    ASSERT_NE(server_->address(), "");
    address_ = server_->address();
  }
  client::Client Connect() const { return client::Client({.server = address_}); }

  /// What a full disk looks like to a writer.
  void SetFull(bool full) {
    const rlimit limit{full ? 1000 : RLIM_INFINITY, RLIM_INFINITY};
    ASSERT_EQ(prlimit(server_->pid(), RLIMIT_FSIZE, &limit, nullptr), 0);
  }

  /// A session, and what has come of it.
  struct Stream {
    std::unique_ptr<client::EstimationSession> session;
    uint64_t next = 1;
    metaekf::testing::EstimateDigest digest;
  };

  Stream Open(client::Client& client, size_t max_kept = client::EstimationOptions().max_kept) {
    client::EstimationOptions options;
    options.max_kept = max_kept;
    options.target.model = "robot";
    options.covariance = client::CovarianceFormat::kLowerTriangle;
    auto session = client.OpenEstimation(options);
    EXPECT_TRUE(session.ok()) << session.status().message;
    return {.session = session.ok() ? std::move(*session) : nullptr};
  }

  /// Sends sample by sample while `more` says so of each answer.
  static void Send(Stream& stream, const std::function<bool(const client::EstimateBatch&)>& more) {
    ASSERT_NE(stream.session, nullptr);
    while (true) {
      ASSERT_TRUE(stream.session->Send(metaekf::testing::SignalSamples(0, stream.next, 1)).ok());
      const auto batch = stream.session->Receive();
      ASSERT_TRUE(batch.ok() && batch->has_value()) << batch.status().message;
      ASSERT_EQ((*batch)->first_seq, stream.next);
      stream.digest.Add(**batch);
      ++stream.next;
      if (!more(**batch)) return;
    }
  }
  static void SendUpTo(uint64_t end, Stream& stream) {
    Send(stream, [&](const auto&) { return stream.next < end; });
  }
  static void SendUntilSomethingIsDurable(Stream& stream) {
    Send(stream, [](const auto& batch) { return batch.durable_seq == 0; });
  }

  /// How long the oldest sample has waited to become durable.
  double CheckpointLag() const { return Metric(address_, "metaekf_checkpoint_lag_seconds"); }
  /// Calls that the server has refused for want of room.
  double Refused() const { return Metric(address_, "metaekf_calls_total", {{"code", "RESOURCE_EXHAUSTED"}}); }

  void ExpectUndisturbed(const Stream& stream) {
    client::Client client = Connect();
    Stream undisturbed = Open(client);
    SendUpTo(stream.next, undisturbed);
    EXPECT_EQ(stream.digest.value(), undisturbed.digest.value()) << "before sample " << stream.next;
  }

  store::TempDirectory directory_;
  const std::string model_ = nssm::WriteModelFile(TinyStateBundle());
  std::string address_;
  std::unique_ptr<ServerProcess> server_;
};

TEST_F(DiskTest, AFullDiskStopsNoStreamAndPasses) {
  client::Client client = Connect();
  Stream stream = Open(client);
  SendUntilSomethingIsDurable(stream);

  SetFull(true);
  const uint64_t full_since = stream.next;
  uint64_t durable = 0;
  Send(stream, [&](const auto& batch) {
    durable = batch.durable_seq;
    return stream.next % 100 != 0 || CheckpointLag() < 0.3;  // several commits have failed
  });
  EXPECT_LT(durable, full_since) << "nothing is durable that is not on the disk";
  const auto refused = Connect().ImportModel("robot", model_);
  ASSERT_FALSE(refused.ok());
  EXPECT_EQ(refused.status().code, Code::kResourceExhausted);
  EXPECT_THAT(refused.status().message, HasSubstr("make room on the data directory's disk"));
  EXPECT_TRUE(Connect().ListModels().ok()) << "what is there is served";

  SetFull(false);
  Send(stream, [&](const auto& batch) { return batch.durable_seq < full_since; });
  ExpectUndisturbed(stream);
  EXPECT_EQ(server_->End(SIGTERM).code, 0);
}

TEST_F(DiskTest, AStreamWhoseServerComesBackToAFullDiskWaitsForRoom) {
  client::Client client = Connect();
  Stream stream = Open(client);
  SendUntilSomethingIsDurable(stream);
  server_->End(SIGKILL);
  StartServer();
  SetFull(true);
  std::thread operator_([this] {
    while (Refused() == 0 && !HasFailure()) std::this_thread::yield();
    SetFull(false);
  });
  SendUpTo(stream.next + 100, stream);
  operator_.join();
  ExpectUndisturbed(stream);
}

TEST_F(DiskTest, AClientThatKeepsAsMuchAsItMaySendsOn) {
  client::Client client = Connect();
  Stream stream = Open(client, /*max_kept=*/256);
  SendUntilSomethingIsDurable(stream);
  SetFull(true);  // nothing becomes durable any more
  const uint64_t end = stream.next + 64 * 100;
  std::thread sender([&, seq = stream.next]() mutable {
    for (; seq < end; seq += 64) ASSERT_TRUE(stream.session->Send(metaekf::testing::SignalSamples(0, seq, 64)).ok());
  });
  while (stream.next < end) {
    const auto batch = stream.session->Receive();
    ASSERT_TRUE(batch.ok() && batch->has_value()) << batch.status().message;
    stream.digest.Add(**batch);
    stream.next += (*batch)->samples;
  }
  sender.join();
  SetFull(false);
  ExpectUndisturbed(stream);
}

TEST_F(DiskTest, AServerKilledOnAFullDiskLosesNothing) {
  client::Client client = Connect();
  Stream stream = Open(client);
  for (int round = 0; round < 3; ++round) {
    SendUntilSomethingIsDurable(stream);
    SetFull(true);
    SendUpTo(stream.next + 300, stream);
    server_->End(SIGKILL);
    StartServer();
  }
  SendUpTo(stream.next + 100, stream);
  ExpectUndisturbed(stream);
}

TEST_F(DiskTest, ADamagedCheckpointIsToldAndTheOtherSessionsGoOn) {
  client::Client client = Connect();
  std::vector<client::SessionInfo> infos;
  for (size_t s = 0; s < 4; ++s) {
    Stream stream = Open(client);
    SendUpTo(21, stream);
    infos.push_back(stream.session->info());
    stream.session->FinishSending();
    ASSERT_TRUE(stream.session->Receive().ok());
  }
  ASSERT_EQ(server_->End(SIGTERM).code, 0);

  // Of the first a byte is another, of the second the end is missing, of the third everything.
  const auto spoil = [](size_t session, std::string checkpoint) {
    if (session == 0) checkpoint[checkpoint.size() / 2] ^= 1;
    if (session == 1) checkpoint.resize(checkpoint.size() - 8);
    if (session == 2) checkpoint = "x";
    return checkpoint;
  };
  {
    const auto database = store::Database::Open(directory_.path() + "/metaekf.db");
    ASSERT_TRUE(database.ok()) << database.status();
    const absl::Status spoiled = (*database)->Write([&](store::Connection& connection) -> absl::Status {
      for (size_t s = 0; s < 3; ++s) {
        const int64_t number = std::stoll(infos[s].session);
        std::string checkpoint;
        absl::Status status = connection.Execute("SELECT checkpoint FROM sessions WHERE number = ?1", {number},
                                                 [&](const store::Row& row) { checkpoint = row.Text(0); });
        EXPECT_FALSE(checkpoint.empty());
        checkpoint = spoil(s, checkpoint);
        status.Update(connection.Execute("UPDATE sessions SET checkpoint = ?2 WHERE number = ?1",
                                         {number, store::Bytes{checkpoint}}));
        if (!status.ok()) return status;
      }
      return absl::OkStatus();
    });
    ASSERT_TRUE(spoiled.ok()) << spoiled;
  }
  StartServer();
  client = Connect();  // the connection is gone
  for (size_t s = 0; s < 3; ++s) {
    const auto resumed = client.ResumeEstimation(infos[s].session, infos[s].token);
    ASSERT_FALSE(resumed.ok()) << s;
    EXPECT_EQ(resumed.status().code, Code::kDataLoss) << resumed.status().message;
    EXPECT_THAT(resumed.status().message, HasSubstr("checkpoint is damaged"));
  }
  const auto intact = client.ResumeEstimation(infos[3].session, infos[3].token);
  ASSERT_TRUE(intact.ok()) << intact.status().message;
  EXPECT_EQ((*intact)->durable_seq(), 20u);
}

}  // namespace
}  // namespace metaekf::server
