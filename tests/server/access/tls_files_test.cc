#include "server/access/tls_files.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "absl/time/clock.h"
#include "tests/server/store/test_store.h"
#include "tests/support/certificates.h"

namespace metaekf::server {
namespace {

using metaekf::testing::Authority;
using metaekf::testing::Certificate;
using ::testing::HasSubstr;

class TlsFilesTest : public ::testing::Test {
 protected:
  TlsFilesTest() { Place(authority_.Sign("server")); }

  void Place(const Certificate& pair) {
    Write(paths_.certificate, pair.certificate);
    Write(paths_.key, pair.key);
  }
  static void Write(const std::string& path, const std::string& text) { std::ofstream(path) << text; }
  std::string Error(absl::StatusCode code = absl::StatusCode::kInvalidArgument) {
    const absl::Status status = ReadTlsFiles(paths_, absl::Now()).status();
    EXPECT_EQ(status.code(), code) << status;
    return std::string(status.message());
  }

  store::TempDirectory directory_;
  TlsPaths paths_{directory_.path() + "/server.pem", directory_.path() + "/server.key", ""};
  Authority authority_{"authority"};
};

TEST_F(TlsFilesTest, AreReadAsTheyStand) {
  const Certificate pair = authority_.Sign("server");
  Place(pair);
  paths_.client_ca = directory_.path() + "/ca.pem";
  Write(paths_.client_ca, authority_.certificate());
  const TlsFiles files = ReadTlsFiles(paths_, absl::Now()).value();
  EXPECT_EQ(files.certificate, pair.certificate);
  EXPECT_EQ(files.key, pair.key);
  EXPECT_EQ(files.client_ca, authority_.certificate());
}

TEST_F(TlsFilesTest, WhatIsWrongIsSaidWithTheFile) {
  Write(paths_.key, authority_.Sign("other").key);
  EXPECT_THAT(Error(), HasSubstr(paths_.key + " is not the key of the certificate in " + paths_.certificate));
  Write(paths_.key, "nothing");
  EXPECT_THAT(Error(), HasSubstr(paths_.key + " holds no private key"));
  Place(authority_.Sign("server", "", -60));
  EXPECT_THAT(Error(), HasSubstr(paths_.certificate + ": the certificate expired at 20"));
  Write(paths_.certificate, "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n");
  EXPECT_THAT(Error(), HasSubstr(paths_.certificate + " holds no certificate"));
  Place(authority_.Sign("server"));
  paths_.client_ca = directory_.path() + "/ca.pem";
  EXPECT_THAT(Error(absl::StatusCode::kNotFound), HasSubstr(paths_.client_ca));
  Write(paths_.client_ca, "");
  EXPECT_THAT(Error(), HasSubstr(paths_.client_ca + " holds no certificate"));
}

TEST_F(TlsFilesTest, AKeyWithAPassphraseIsRefusedInsteadOfAskingForIt) {
  Write(paths_.key,
        "-----BEGIN ENCRYPTED PRIVATE KEY-----\nMIGjMF8GCSqGSIb3DQEFDTBSMDEGCSqGSIb3DQEFDDAkBBDu\n"
        "-----END ENCRYPTED PRIVATE KEY-----\n");
  EXPECT_THAT(Error(), HasSubstr("without a passphrase"));
}

TEST_F(TlsFilesTest, APairIsTakenOnceItIsComplete) {
  TlsFileWatch watch(paths_, ReadTlsFiles(paths_, absl::Now()).value());
  EXPECT_FALSE(watch.Changed(absl::Now()));
  const std::string before = watch.current().certificate;

  const Certificate next = authority_.Sign("server");
  Write(paths_.certificate, next.certificate);
  EXPECT_FALSE(watch.Changed(absl::Now()));  // the key is still that of the one before
  EXPECT_EQ(watch.current().certificate, before);
  Write(paths_.key, next.key);
  const auto changed = watch.Changed(absl::Now());
  ASSERT_TRUE(changed);
  EXPECT_EQ(changed->certificate, next.certificate);
  EXPECT_EQ(changed->key, next.key);
  EXPECT_FALSE(watch.Changed(absl::Now()));

  std::filesystem::remove(paths_.certificate);
  EXPECT_FALSE(watch.Changed(absl::Now()));
  EXPECT_EQ(watch.current().certificate, next.certificate);
}

}  // namespace
}  // namespace metaekf::server
