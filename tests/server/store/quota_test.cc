#include "server/store/quota.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::HasSubstr;

class QuotaTest : public StoreTest {
 protected:
  void SetUp() override {
    quotas_.by_tenant["plant"] = {
        .sessions = 2, .adaptations = 1, .stored_bytes = 100, .queued_jobs = 2, .running_jobs = 1};
    Reopen();
  }
  void Reopen() {
    store_.reset();
    store_ = Store::Open(directory_.path(), [this] { return now_; }, quotas_).value();
  }

  TenantStore Plant() { return store_->Of("plant"); }
  absl::Status Session() { return Plant().sessions().Create("models/m/versions/1", "").status(); }
  absl::Status Version(TenantStore tenant, size_t bytes) {
    return tenant.models().AddVersion("m", Blob(std::string(bytes, next_++)), "{}").status();
  }
  absl::Status Adaptation() { return Plant().adaptations().Create({"", "m", 1, Blob("a"), "{}", {}}).status(); }
  absl::Status Job(TenantStore tenant, const std::string& data = "d") {
    return tenant.jobs().Create({"m", "{}", Blob(data), {}}).status();
  }
  void ExpectExhausted(const absl::Status& status, const std::string& what) {
    EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted) << status;
    EXPECT_THAT(std::string(status.message()), HasSubstr(what));
  }

  Quotas quotas_;
  char next_ = 'A';  // no two files are the same
};

TEST_F(QuotaTest, SessionsAreCounted) {
  ASSERT_TRUE(Session().ok());
  ASSERT_TRUE(Session().ok());
  ExpectExhausted(Session(), "tenant 'plant' has 2 sessions, and its quota is 2");
  ASSERT_TRUE(store_->Of("works").sessions().Create("models/m/versions/1", "").ok());
  ASSERT_TRUE(Plant().sessions().Delete(1).ok());
  EXPECT_TRUE(Session().ok());
  Reopen();
  ExpectExhausted(Session(), "quota");
}

TEST_F(QuotaTest, AdaptationsAreCounted) {
  ASSERT_TRUE(Version(Plant(), 10).ok());
  ASSERT_TRUE(Adaptation().ok());
  ExpectExhausted(Adaptation(), "1 adaptations");
}

TEST_F(QuotaTest, BytesOfAllKindsAreCountedTogether) {
  ASSERT_TRUE(Version(Plant(), 40).ok());
  ASSERT_TRUE(Adaptation().ok());                           // 1 byte
  ASSERT_TRUE(Job(Plant(), std::string(50, 'j')).ok());     // 91 so far
  ExpectExhausted(Version(Plant(), 10), "has 91 bytes stored, this would add 10");
  ExpectExhausted(Job(Plant(), std::string(10, 'k')), "91 bytes");
  EXPECT_TRUE(Version(Plant(), 9).ok());
  ASSERT_TRUE(Plant().jobs().Cancel(1).ok());  // whose data goes
  EXPECT_TRUE(Version(Plant(), 50).ok());
  EXPECT_TRUE(Version(store_->Of("works"), 1000).ok());
}

TEST_F(QuotaTest, JobsThatWaitAreCounted) {
  ASSERT_TRUE(Job(Plant()).ok());
  ASSERT_TRUE(Job(Plant()).ok());
  ExpectExhausted(Job(Plant()), "2 jobs that wait");
  ASSERT_TRUE(store_->job_queue().Claim("w", absl::Seconds(30)).value());
  EXPECT_TRUE(Job(Plant()).ok());
}

TEST_F(QuotaTest, JobsBeyondThoseThatMayRunWait) {
  ASSERT_TRUE(Job(Plant()).ok());
  ASSERT_TRUE(Job(Plant()).ok());
  ASSERT_TRUE(Job(store_->Of("works")).ok());
  const auto claim = [this] { return store_->job_queue().Claim("w", absl::Seconds(30)).value(); };
  const auto first = claim();
  EXPECT_EQ(first->lease.tenant, "plant");
  EXPECT_EQ(claim()->lease.tenant, "works");
  EXPECT_FALSE(claim());
  ASSERT_TRUE(store_->job_queue().Fail(first->lease, "over").ok());
  EXPECT_EQ(claim()->lease.number, 2);
}

TEST_F(QuotaTest, ARequestThatIsRepeatedIsNotCountedTwice) {
  ASSERT_TRUE(Version(Plant(), 40).ok());
  const RequestId request{"again", "same"};
  const auto adapt = [&] { return Plant().adaptations().Create({"", "m", 1, Blob("a"), "{}", request}); };
  ASSERT_TRUE(adapt().ok());
  EXPECT_TRUE(adapt().ok());
}

TEST_F(QuotaTest, TenantsThatAreNotNamedShareALimitNotACount) {
  quotas_.others.sessions = 1;
  Reopen();
  for (const char* tenant : {"a", "b"}) {
    EXPECT_TRUE(store_->Of(tenant).sessions().Create("models/m/versions/1", "").ok());
    ExpectExhausted(store_->Of(tenant).sessions().Create("models/m/versions/1", "").status(), tenant);
  }
  EXPECT_TRUE(Session().ok());  // which has a quota of its own
  EXPECT_TRUE(Session().ok());
}

}  // namespace
}  // namespace metaekf::store
