#include "server/store/sessions.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Not;

class SessionsTest : public StoreTest {
 protected:
  SessionStore sessions() { return Mine().sessions(); }
  NewSession Create() { return sessions().Create("models/m/versions/1", "settings").value(); }
};

TEST_F(SessionsTest, ANewSessionIsClaimed) {
  const NewSession created = Create();
  EXPECT_EQ(created.session.number, 1);
  EXPECT_EQ(created.session.epoch, 1);
  EXPECT_EQ(created.token.size(), 64);
  Reopen();
  const auto session = sessions().Get(1);
  ASSERT_TRUE(session.ok()) << session.status();
  EXPECT_EQ(session->target, "models/m/versions/1");
  EXPECT_EQ(session->settings, "settings");
  EXPECT_EQ(session->epoch, 1);
  EXPECT_EQ(session->durable_seq, 0);
  EXPECT_EQ(session->checkpoint, "");
  EXPECT_EQ(session->create_time, now_);
}

TEST_F(SessionsTest, ClaimingGivesTheLastCheckpointAndTheNextEpoch) {
  const NewSession created = Create();
  const std::string checkpoint("\0\x01state", 7);
  ASSERT_THAT(store_->SaveCheckpoints({{kDefaultTenant, 1, 1, 40, checkpoint}}).value(), ElementsAre(true));
  Reopen();
  const auto claimed = sessions().Claim(1, created.token);
  ASSERT_TRUE(claimed.ok()) << claimed.status();
  EXPECT_EQ(claimed->epoch, 2);
  EXPECT_EQ(claimed->durable_seq, 40);
  EXPECT_EQ(claimed->checkpoint, checkpoint);
}

TEST_F(SessionsTest, WhoLostTheSessionWritesNothing) {
  const NewSession first = Create();
  Create();
  ASSERT_TRUE(sessions().Claim(1, first.token).ok());
  // One commit for both: the session that was taken over is told apart.
  const auto written = store_->SaveCheckpoints({{kDefaultTenant, 1, 1, 10, "old"}, {kDefaultTenant, 2, 1, 20, "mine"}});
  ASSERT_TRUE(written.ok()) << written.status();
  EXPECT_THAT(*written, ElementsAre(false, true));
  EXPECT_EQ(sessions().Get(1)->durable_seq, 0);
  EXPECT_EQ(sessions().Get(2)->durable_seq, 20);
}

TEST_F(SessionsTest, AWrongTokenLooksLikeNoSession) {
  const NewSession created = Create();
  const absl::Status wrong = sessions().Claim(1, "wrong").status();
  const absl::Status none = sessions().Claim(1000, created.token).status();
  EXPECT_EQ(wrong.code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(none.code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(wrong.message(), "there is no session 1 with this token");
  EXPECT_EQ(none.message(), "there is no session 1000 with this token");
  EXPECT_EQ(sessions().Get(1)->epoch, 1);
}

TEST_F(SessionsTest, TokensDifferAndAreNotStored) {
  const NewSession first = Create();
  EXPECT_NE(first.token, Create().token);
  store_.reset();
  EXPECT_THAT(ReadFile(directory_.path() + "/metaekf.db").value(), Not(HasSubstr(first.token)));
}

TEST_F(SessionsTest, ADeletedSessionIsGoneForGood) {
  const NewSession created = Create();
  ASSERT_TRUE(sessions().Delete(1).ok());
  EXPECT_EQ(sessions().Claim(1, created.token).status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(sessions().Get(1).status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(sessions().Delete(1).code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(store_->SaveCheckpoints({{kDefaultTenant, 1, 1, 10, "x"}}).value(), ElementsAre(false));
  EXPECT_EQ(Create().session.number, 2);
}

TEST_F(SessionsTest, ListsNewestFirstInPages) {
  for (int i = 0; i < 3; ++i) Create();
  const auto first = sessions().List({2, ""});
  ASSERT_TRUE(first.ok());
  const auto second = sessions().List({2, first->next_page_token});
  ASSERT_TRUE(second.ok());
  std::vector<int64_t> numbers;
  for (const auto* page : {&*first, &*second}) {
    for (const Session& session : page->items) numbers.push_back(session.number);
  }
  EXPECT_THAT(numbers, ElementsAre(3, 2, 1));
}

}  // namespace
}  // namespace metaekf::store
