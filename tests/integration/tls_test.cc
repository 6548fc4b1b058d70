// The client library and the server, encrypted.

#include <atomic>
#include <thread>

#include "metaekf/client.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/support/certificates.h"

namespace metaekf::server {
namespace {

using metaekf::testing::Authority;
using metaekf::testing::Certificate;
using ::testing::HasSubstr;

constexpr char kLoopback[] = "DNS:localhost,IP:127.0.0.1";

class TlsTest : public ServerTest {
 protected:
  TlsTest() {
    Place(authority_.Sign("server", kLoopback));
    options_.security.certificate_file = Path("server.pem");
    options_.security.key_file = Path("server.key");
  }

  std::string Path(const std::string& name) { return files_.path() + "/" + name; }
  /// As a careful operator replaces a file.
  void Write(const std::string& name, const std::string& text) {
    std::ofstream(Path("new")) << text;
    std::filesystem::rename(Path("new"), Path(name));
  }
  void Place(const Certificate& pair) {
    Write("server.pem", pair.certificate);
    Write("server.key", pair.key);
  }

  client::Client Connect(const std::optional<client::Tls>& tls, const std::string& token = "") {
    return client::Client({.server = server_->address(), .timeout_s = 20, .token = token, .tls = tls});
  }
  client::Status Call(const std::optional<client::Tls>& tls, const std::string& token = "") {
    return Connect(tls, token).ListModels().status();
  }
  client::Tls Trusting(const Authority& authority) { return {.authorities = authority.certificate()}; }

  store::TempDirectory files_;
  Authority authority_{"authority"};
};

TEST_F(TlsTest, AClientThatTrustsTheAuthorityIsServed) {
  const client::Status status = Call(Trusting(authority_));
  EXPECT_TRUE(status.ok()) << status.message;
}

TEST_F(TlsTest, NoOtherConnectionComesAbout) {
  EXPECT_EQ(Call(std::nullopt).code, client::Code::kUnavailable);
  const client::Status status = Call(Trusting(Authority("another")));
  EXPECT_EQ(status.code, client::Code::kUnavailable);
  EXPECT_EQ(status.reason, "NO_CONNECTION") << status.message;
}

TEST_F(TlsTest, AServerUnderAnotherNameIsNotTrusted) {
  Stop();
  Place(authority_.Sign("server", "DNS:elsewhere.example"));
  Start();
  EXPECT_EQ(Call(Trusting(authority_)).code, client::Code::kUnavailable);
}

TEST_F(TlsTest, FilesThatAreNotFitStopTheStart) {
  Stop();
  Write("server.key", authority_.Sign("other").key);
  const auto server = Server::Start(options_);
  EXPECT_EQ(server.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(server.status().message()), HasSubstr("server.key is not the key"));
}

// Calls over new connections all the while, and one stream that began before.
TEST_F(TlsTest, CertificatesAreReplacedWithoutACallThatFails) {
  Authority next("next authority");
  const client::Tls either{.authorities = authority_.certificate() + next.certificate()};
  client::Client streaming = Connect(either);
  ASSERT_TRUE(streaming.ImportModel("robot", nssm::WriteModelFile(TinyBundle())).ok());
  client::EstimationOptions options;
  options.target.model = "robot";
  const auto stream = streaming.OpenEstimation(options);
  ASSERT_TRUE(stream.ok()) << stream.status().message;
  const auto estimate = [&] {
    ASSERT_TRUE((*stream)->Send({.samples = 1, .inputs = {0.5}, .outputs = {0.1}}).ok());
    const auto batch = (*stream)->Receive();
    ASSERT_TRUE(batch.ok()) << batch.status().message;
  };
  estimate();

  std::atomic<bool> done{false};
  std::atomic<int> calls{0};
  std::thread caller([&] {
    while (!done) {
      const client::Status status = Call(either);
      EXPECT_TRUE(status.ok()) << status.message;
      ++calls;
    }
  });
  const auto wait_for_calls = [&](int more) {
    for (const int until = calls + more; calls < until;) std::this_thread::yield();
  };
  wait_for_calls(5);
  const Certificate pair = next.Sign("server", kLoopback);
  Write("server.pem", pair.certificate);
  // Long enough for the server to look at a pair that does not fit.
  for (const absl::Time until = absl::Now() + absl::Milliseconds(1200); absl::Now() < until;) wait_for_calls(1);
  EXPECT_FALSE(Call(Trusting(next)).ok());
  Write("server.key", pair.key);
  const absl::Time deadline = absl::Now() + absl::Seconds(20);
  while (!Call(Trusting(next)).ok() && absl::Now() < deadline) {
  }
  EXPECT_TRUE(Call(Trusting(next)).ok());
  EXPECT_FALSE(Call(Trusting(authority_)).ok());
  wait_for_calls(5);
  done = true;
  caller.join();
  estimate();
}

class MutualTlsTest : public TlsTest {
 protected:
  MutualTlsTest() {
    Write("clients.pem", clients_.certificate());
    options_.security.client_ca_file = Path("clients.pem");
    options_.security.clients = {{"press-7.plant.example", "plant", store::Scope::kWrite},
                                 {"press-8.works.example", "works", store::Scope::kRead}};
    options_.listen = "0.0.0.0:0";  // which this is enough for
  }

  std::string address() const { return absl::StrCat("127.0.0.1:", server_->port()); }
  client::Client As(const Certificate& own, const std::string& token = "") {
    const client::Tls tls{.authorities = authority_.certificate(), .certificate = own.certificate, .key = own.key};
    return client::Client({.server = address(), .timeout_s = 20, .token = token, .tls = tls});
  }

  Authority clients_{"authority of clients"};
};

TEST_F(MutualTlsTest, ACertificateSaysWhoCalls) {
  client::Client press7 = As(clients_.Sign("anything", "DNS:press-7.plant.example"));
  ASSERT_TRUE(press7.ImportModel("robot", nssm::WriteModelFile(TinyBundle())).ok());
  EXPECT_EQ(press7.ListModels()->size(), 1u);

  // Of another tenant; its name stands where certificates without alternative names have it.
  client::Client press8 = As(clients_.Sign("press-8.works.example"));
  EXPECT_EQ(press8.ListModels()->size(), 0u);
  const client::Status refused = press8.ImportModel("robot", nssm::WriteModelFile(TinyBundle())).status();
  EXPECT_EQ(refused.code, client::Code::kPermissionDenied);
  EXPECT_THAT(refused.message, HasSubstr("certificate press-8.works.example has scope read"));
}

TEST_F(MutualTlsTest, ANameThatIsNotListedIsRefused) {
  for (const Certificate& own : {clients_.Sign("stranger"), clients_.Sign("press-7.plant.example", "DNS:stranger")}) {
    const client::Status status = As(own).ListModels().status();
    EXPECT_EQ(status.code, client::Code::kUnauthenticated);
    EXPECT_THAT(status.message, HasSubstr("stranger"));
  }
}

TEST_F(MutualTlsTest, NoConnectionComesAboutWithoutACertificateOfTheAuthority) {
  Authority another("another");
  for (const Certificate& own : {Certificate{}, another.Sign("press-7.plant.example"),
                                 clients_.Sign("press-7.plant.example", "", -60)}) {
    EXPECT_EQ(As(own).ListModels().status().code, client::Code::kUnavailable);
  }
}

}  // namespace
}  // namespace metaekf::server
