#include "server/access/access_control.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;
using store::Scope;

class AccessControlTest : public store::StoreTest {
 protected:
  store::NewToken Make(Scope scope, absl::Duration lifetime = absl::InfiniteDuration()) {
    const store::NewToken made = store_->Tokens().Create("plant", scope, lifetime, "").value();
    EXPECT_TRUE(access().Reload().ok());
    return made;
  }
  AccessControl& access() {
    if (!access_) access_.emplace(*store_, [this] { return now_; }, security_);
    return *access_;
  }
  absl::StatusOr<Caller> Admit(const std::string& authorization, Scope needed = Scope::kRead) {
    return access().Admit({authorization}, needed);
  }
  void ExpectRefused(const absl::Status& status, absl::StatusCode code, const std::string& reason) {
    EXPECT_EQ(status.code(), code) << status;
    EXPECT_THAT(std::string(status.message()), HasSubstr(reason));
  }

  ServerOptions::Security security_{.require_tokens = true};
  std::optional<AccessControl> access_;
};

TEST_F(AccessControlTest, WithoutTokensEveryoneIsTheMachinesOwner) {
  AccessControl open(*store_, [this] { return now_; }, {});
  const Caller caller = open.Admit({}, Scope::kAdmin).value();
  EXPECT_EQ(caller.tenant, store::kDefaultTenant);
  EXPECT_EQ(caller.identity, "local");
}

TEST_F(AccessControlTest, ATokenSaysWhoCalls) {
  const store::NewToken made = Make(Scope::kWrite);
  const Caller caller = Admit("Bearer " + made.secret, Scope::kWrite).value();
  EXPECT_EQ(caller.tenant, "plant");
  EXPECT_EQ(caller.identity, "token t1");
}

TEST_F(AccessControlTest, WhoeverShowsNoTokenThatIsValidIsRefused) {
  const store::NewToken made = Make(Scope::kAdmin, absl::Hours(1));
  constexpr auto kUnauthenticated = absl::StatusCode::kUnauthenticated;
  ExpectRefused(access().Admit({}, Scope::kRead).status(), kUnauthenticated, "wants a token");
  ExpectRefused(Admit("").status(), kUnauthenticated, "must be 'Bearer TOKEN'");
  ExpectRefused(Admit(made.secret).status(), kUnauthenticated, "must be 'Bearer TOKEN'");
  ExpectRefused(Admit("Bearer " + made.secret + "0").status(), kUnauthenticated, "not known");
  // The digest is what is stored: it must not do.
  ExpectRefused(Admit("Bearer " + made.token.digest).status(), kUnauthenticated, "not known");
  EXPECT_TRUE(Admit("Bearer " + made.secret).ok());
  now_ += absl::Hours(1);
  ExpectRefused(Admit("Bearer " + made.secret).status(), kUnauthenticated, "token t1 expired at");
}

TEST_F(AccessControlTest, ARevokedTokenIsRefusedAtOnce) {
  const store::NewToken made = Make(Scope::kAdmin);
  ASSERT_TRUE(store_->Tokens().Revoke("t1").ok());
  ASSERT_TRUE(access().Reload().ok());
  ExpectRefused(Admit("Bearer " + made.secret).status(), absl::StatusCode::kUnauthenticated,
                "has been revoked");
}

TEST_F(AccessControlTest, EachScopeReachesAsFarAsItSays) {
  constexpr Scope kScopes[] = {Scope::kRead, Scope::kStream, Scope::kWrite, Scope::kAdmin};
  for (const Scope scope : kScopes) {
    const store::NewToken made = Make(scope);
    for (const Scope needed : kScopes) {
      const absl::StatusOr<Caller> caller = Admit("Bearer " + made.secret, needed);
      EXPECT_EQ(caller.ok(), needed <= scope) << store::ScopeName(scope);
      if (caller.ok()) continue;
      ExpectRefused(caller.status(), absl::StatusCode::kPermissionDenied,
                    absl::StrCat("needs scope ", store::ScopeName(needed)));
    }
  }
}

class CertificateTest : public AccessControlTest {
 protected:
  CertificateTest() {
    security_ = {.client_ca_file = "clients.pem",
                 .clients = {{"press-7", "plant", Scope::kStream}, {"ops", "plant", Scope::kAdmin}}};
  }
};

TEST_F(CertificateTest, AListedNameSaysWhoCalls) {
  const Caller caller = access().Admit({.certificate_names = {"other", "press-7"}}, Scope::kStream).value();
  EXPECT_EQ(caller.tenant, "plant");
  EXPECT_EQ(caller.identity, "certificate press-7");
  ExpectRefused(access().Admit({.certificate_names = {"press-7"}}, Scope::kWrite).status(),
                absl::StatusCode::kPermissionDenied, "certificate press-7 has scope stream");
}

TEST_F(CertificateTest, NoOtherNameDoes) {
  for (const std::vector<std::string>& names : std::vector<std::vector<std::string>>{{}, {"press-70"}, {""}}) {
    ExpectRefused(access().Admit({.certificate_names = names}, Scope::kRead).status(),
                  absl::StatusCode::kUnauthenticated, "security.clients");
  }
}

TEST_F(CertificateTest, ATokenGoesBeforeTheCertificate) {
  const store::NewToken made = Make(Scope::kRead);
  Credentials both{.authorization = "Bearer " + made.secret, .certificate_names = {"ops"}};
  EXPECT_EQ(access().Admit(both, Scope::kRead)->identity, "token t1");
  EXPECT_FALSE(access().Admit(both, Scope::kAdmin).ok());
  both.authorization = "Bearer wrong";
  ExpectRefused(access().Admit(both, Scope::kRead).status(), absl::StatusCode::kUnauthenticated, "not known");
}

TEST_F(CertificateTest, WhereTokensAreRequiredACertificateAloneIsNotEnough) {
  security_.require_tokens = true;
  ExpectRefused(access().Admit({.certificate_names = {"ops"}}, Scope::kRead).status(),
                absl::StatusCode::kUnauthenticated, "wants a token");
}

TEST_F(AccessControlTest, CallsThatDoNotComeThroughANamedProxyAreRefused) {
  security_.proxies = {"10.0.0.5", "2001:DB8:0::5"};
  const std::string authorization = "Bearer " + Make(Scope::kAdmin).secret;
  for (const char* peer : {"10.0.0.5", "2001:db8::5"}) {
    EXPECT_TRUE(access().Admit({.authorization = authorization, .peer_host = peer}, Scope::kRead).ok()) << peer;
  }
  for (const char* peer : {"10.0.0.6", "2001:db8::6", "127.0.0.1", ""}) {
    ExpectRefused(access().Admit({.authorization = authorization, .peer_host = peer}, Scope::kRead).status(),
                  absl::StatusCode::kPermissionDenied, "proxies");
  }
}

}  // namespace
}  // namespace metaekf::server
