#include "server/store/tokens.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;
using ::testing::Field;
using ::testing::Not;
using ::testing::StartsWith;

using TokensTest = StoreTest;

TEST_F(TokensTest, ASecretIsShownOnceAndFoundAgain) {
  const NewToken made =
      store_->Tokens().Create("plant", Scope::kWrite, absl::Hours(1), "line 3").value();
  EXPECT_THAT(made.secret, StartsWith("metaekf_"));
  EXPECT_EQ(made.secret.size(), 8 + 64);
  Reopen();
  const Token found = store_->Tokens().List()->at(0);
  EXPECT_EQ(found.id, "t1");
  EXPECT_EQ(found.digest, Sha256Hex(made.secret));
  EXPECT_EQ(found.tenant, "plant");
  EXPECT_EQ(found.scope, Scope::kWrite);
  EXPECT_EQ(found.note, "line 3");
  EXPECT_EQ(found.create_time, now_);
  EXPECT_EQ(found.expire_time, now_ + absl::Hours(1));
  EXPECT_EQ(found.revoke_time, absl::InfiniteFuture());
}

TEST_F(TokensTest, TheDirectoryDoesNotHoldSecrets) {
  const NewToken made =
      store_->Tokens().Create("plant", Scope::kRead, absl::InfiniteDuration(), "").value();
  store_.reset();
  for (const auto& entry : std::filesystem::recursive_directory_iterator(directory_.path())) {
    if (!entry.is_regular_file()) continue;
    EXPECT_THAT(ReadFile(entry.path()).value(), Not(::testing::HasSubstr(made.secret.substr(8))))
        << entry.path();
  }
}

TEST_F(TokensTest, RevokedTokensStayListed) {
  store_->Tokens().Create("plant", Scope::kRead, absl::InfiniteDuration(), "").value();
  store_->Tokens().Create("other", Scope::kAdmin, absl::InfiniteDuration(), "").value();
  now_ += absl::Seconds(5);
  EXPECT_EQ(store_->Tokens().Revoke("t1")->revoke_time, now_);
  now_ += absl::Seconds(5);
  EXPECT_EQ(store_->Tokens().Revoke("t1")->revoke_time, now_ - absl::Seconds(5))
      << "again: no change";
  EXPECT_THAT(*store_->Tokens().List(),
              ElementsAre(Field(&Token::id, "t1"), Field(&Token::id, "t2")));
  EXPECT_EQ(store_->Tokens().Revoke("t9").status().code(), absl::StatusCode::kNotFound);
}

TEST_F(TokensTest, BadRequestsAreRefused) {
  EXPECT_EQ(store_->Tokens().Create("../x", Scope::kRead, absl::Hours(1), "").status().code(),
            absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(
      store_->Tokens().Create("plant", Scope::kRead, absl::ZeroDuration(), "").status().code(),
      absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(ScopeNamed("root").status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(*ScopeNamed("admin"), Scope::kAdmin);
}

}  // namespace
}  // namespace metaekf::store
