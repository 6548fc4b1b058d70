#include "server/access/exposure.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

ServerOptions Listening(const std::string& address, const ServerOptions::Security& security = {}) {
  ServerOptions options;
  options.listen = address;
  options.security = security;
  return options;
}

std::string Refusal(const ServerOptions& options) {
  const absl::Status status = CheckExposure(options).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << options.listen;
  return std::string(status.message());
}

const ServerOptions::Security kTls{.certificate_file = "a.pem", .key_file = "a.key"};

TEST(ExposureTest, LoopbackWantsNothing) {
  for (const char* address : {"127.0.0.1:1", "127.8.0.1:1", "localhost:1", "[::1]:1"}) {
    EXPECT_TRUE(CheckExposure(Listening(address)).ok()) << address;
  }
  EXPECT_EQ(CheckExposure(Listening("[::1]:50051"))->host, "[::1]");
  EXPECT_EQ(CheckExposure(Listening("[::1]:50051"))->port, 50051);
}

TEST(ExposureTest, ElsewhereStrangersMustBeKeptOut) {
  for (const char* address : {"0.0.0.0:1", "[::]:1", "10.0.0.1:1", "127.example.com:1", "localhost.example:1"}) {
    EXPECT_THAT(Refusal(Listening(address)), HasSubstr("--insecure")) << address;
  }
  ServerOptions::Security security = kTls;
  EXPECT_THAT(Refusal(Listening("0.0.0.0:1", security)), HasSubstr("mutual TLS"));
  security.require_tokens = true;  // without a proxy, gRPC itself is open to strangers
  EXPECT_THAT(Refusal(Listening("0.0.0.0:1", security)), HasSubstr("proxies"));
  security.proxies = {"10.0.0.5"};
  EXPECT_TRUE(CheckExposure(Listening("0.0.0.0:1", security)).ok());
  security.certificate_file = security.key_file = "";  // tokens for everyone to read
  EXPECT_THAT(Refusal(Listening("0.0.0.0:1", security)), HasSubstr("refusing"));

  security = kTls;
  security.client_ca_file = "ca.pem";
  security.require_tokens = true;
  EXPECT_TRUE(CheckExposure(Listening("0.0.0.0:1", security)).ok());

  ServerOptions insecure = Listening("0.0.0.0:1");
  insecure.insecure = true;
  EXPECT_TRUE(CheckExposure(insecure).ok());
}

TEST(ExposureTest, SettingsThatDoNotGoTogetherAreNamed) {
  const auto refusal = [](const ServerOptions::Security& security) {
    return Refusal(Listening("127.0.0.1:1", security));
  };
  EXPECT_THAT(refusal({.certificate_file = "a.pem"}), HasSubstr("security.key_file"));
  EXPECT_THAT(refusal({.key_file = "a.key"}), HasSubstr("security.certificate_file"));
  EXPECT_THAT(refusal({.client_ca_file = "ca.pem"}), HasSubstr("takes security.certificate_file"));
  ServerOptions::Security security = kTls;
  security.clients = {{"press", "plant", store::Scope::kRead}};
  EXPECT_THAT(refusal(security), HasSubstr("give security.client_ca_file"));
  security.clients.clear();
  security.client_ca_file = "ca.pem";
  EXPECT_THAT(refusal(security), HasSubstr("list them as security.clients"));
  EXPECT_THAT(refusal({.proxies = {"haproxy.example"}}), HasSubstr("'haproxy.example' is no IPv4"));
}

TEST(ExposureTest, PeersAreReadAsGrpcWritesThem) {
  EXPECT_EQ(PeerHost("ipv4:10.0.0.5:4711"), "10.0.0.5");
  EXPECT_EQ(PeerHost("ipv6:%5B2001:db8::5%5D:4711"), "2001:db8::5");
  EXPECT_EQ(PeerHost("ipv6:[::1]:4711"), "::1");
  EXPECT_EQ(PeerHost("ipv6:%5B::ffff:10.0.0.5%5D:4711"), "10.0.0.5");
  EXPECT_EQ(PeerHost("inproc:1"), "");
  EXPECT_EQ(PeerHost("ipv4:"), "");
  EXPECT_EQ(PeerHost(""), "");
  EXPECT_EQ(CanonicalAddress("2001:DB8:0:0::5"), "2001:db8::5");
  EXPECT_EQ(CanonicalAddress("10.0.0"), "");
}

}  // namespace
}  // namespace metaekf::server
