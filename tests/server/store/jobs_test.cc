#include "server/store/jobs.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

constexpr absl::Duration kLease = absl::Seconds(30);

class JobsTest : public StoreTest {
 protected:
  JobStore jobs() { return Mine().jobs(); }
  JobQueue& queue() { return store_->job_queue(); }
  absl::StatusOr<Job> Create(const std::string& dataset = "data", const RequestId& request = {}) {
    return jobs().Create({"robot", R"({"iterations": 9})", Blob(dataset), request});
  }
  /// The lease of the job that the worker gets; there must be one.
  JobLease Claim(const std::string& worker = "w") {
    return queue().Claim(worker, kLease).value().value().lease;
  }
  Job Get(int64_t number) { return jobs().Get(number).value(); }
};

TEST_F(JobsTest, ANewJobWaits) {
  ASSERT_TRUE(Create().ok());
  Reopen();
  const Job job = Get(1);
  EXPECT_EQ(job.model, "robot");
  EXPECT_EQ(job.spec_json, R"({"iterations": 9})");
  EXPECT_EQ(job.dataset_digest, Sha256Hex("data"));
  EXPECT_EQ(job.state, JobState::kQueued);
  EXPECT_EQ(job.attempt, 0);
  EXPECT_EQ(job.create_time, now_);
  EXPECT_EQ(job.end_time, absl::UnixEpoch());
  EXPECT_TRUE(BlobExists(job.dataset_digest));
}

TEST_F(JobsTest, TheOldestWaitingJobIsClaimedFirst) {
  Create().value();
  Create().value();
  now_ += absl::Seconds(5);
  const auto claimed = queue().Claim("host-1", kLease).value();
  ASSERT_TRUE(claimed.has_value());
  const Job* job = &claimed->job;
  EXPECT_EQ(job->number, 1);
  EXPECT_EQ(job->state, JobState::kRunning);
  EXPECT_EQ(job->attempt, 1);
  EXPECT_EQ(job->worker, "host-1");
  EXPECT_EQ(job->start_time, now_);
  EXPECT_EQ(job->lease_end, now_ + kLease);
  EXPECT_EQ(queue().Claim("host-2", kLease).value()->lease.number, 2);
  EXPECT_FALSE(queue().Claim("host-3", kLease).value().has_value());
}

TEST_F(JobsTest, PublishingEndsTheJobWithAVersion) {
  const auto created = Create();
  const JobLease lease = Claim();
  ASSERT_TRUE(queue().Renew(lease, kLease, R"({"iteration": 9})", true).ok());
  const std::string work = queue().WorkDirectory({kDefaultTenant, 1, 1}).value();
  std::ofstream(work + "/checkpoint") << "half";
  now_ += absl::Seconds(9);
  const auto version = queue().Publish(lease, Blob("weights"), R"({"loss": 1})");
  ASSERT_TRUE(version.ok()) << version.status();
  const Job job = Get(1);
  EXPECT_EQ(job.state, JobState::kSucceeded);
  EXPECT_EQ(job.result_version, version->version);
  EXPECT_EQ(job.progress_json, R"({"iteration": 9})");
  EXPECT_EQ(job.end_time, now_);
  EXPECT_EQ(Mine().models().GetVersion("robot", 1)->metadata_json, R"({"loss": 1})");
  EXPECT_FALSE(BlobExists(created->dataset_digest));
  EXPECT_FALSE(std::filesystem::exists(work));
}

TEST_F(JobsTest, AWorkerThatLostItsJobHasNoEffect) {
  Create().value();
  const JobLease old = Claim("old");
  ASSERT_TRUE(queue().Lose(old, "killed").ok());
  const JobLease current = Claim("new");
  EXPECT_EQ(current.attempt, 2);
  for (const absl::Status& status :
       {queue().Renew(old, kLease, "late", true), queue().Publish(old, Blob("late"), "{}").status(),
        queue().Fail(old, "late"), queue().Lose(old, "late"), queue().GiveBack(old)}) {
    EXPECT_EQ(status.code(), absl::StatusCode::kAborted) << status;
  }
  EXPECT_EQ(Mine().models().Get("robot").status().code(), absl::StatusCode::kNotFound);
  EXPECT_FALSE(BlobExists(Sha256Hex("late")));
  EXPECT_EQ(Get(1).worker, "new");
  EXPECT_EQ(Get(1).progress_json, "");
  ASSERT_TRUE(queue().Publish(current, Blob("weights"), "{}").ok());
  // Nor twice.
  EXPECT_EQ(queue().Publish(current, Blob("weights"), "{}").status().code(),
            absl::StatusCode::kAborted);
  EXPECT_EQ(Mine().models().Get("robot")->version_count, 1);
}

TEST_F(JobsTest, AJobThatGetsNowhereFailsAfterItsAttempts) {
  Create().value();
  for (int64_t attempt = 1; attempt < JobQueue::kMaxFailures; ++attempt) {
    ASSERT_TRUE(queue().Lose(Claim(), "killed by signal 9").ok());
    EXPECT_EQ(Get(1).state, JobState::kQueued);
  }
  ASSERT_TRUE(queue().Lose(Claim(), "killed by signal 9").ok());
  const Job job = Get(1);
  EXPECT_EQ(job.state, JobState::kFailed);
  EXPECT_EQ(job.error,
            "attempt 3: killed by signal 9; given up after 3 attempts in a row without a new "
            "checkpoint");
  EXPECT_EQ(job.end_time, now_);
}

TEST_F(JobsTest, ACheckpointStartsTheCountOfFailuresAnew) {
  Create().value();
  for (int attempt = 0; attempt < 20; ++attempt) {
    const JobLease lease = Claim();
    ASSERT_TRUE(queue().Renew(lease, kLease, "{}", true).ok());
    ASSERT_TRUE(queue().Lose(lease, "killed").ok());
  }
  EXPECT_EQ(Get(1).state, JobState::kQueued);
  EXPECT_EQ(Get(1).attempt, 20);
}

TEST_F(JobsTest, RestartsDoNotUseAttemptsUp) {
  Create().value();
  for (int restart = 0; restart < 20; ++restart) {
    if (restart % 2 == 0) {
      Claim();
      Reopen();
      ASSERT_TRUE(queue().GiveBackAll().ok());
    } else {
      ASSERT_TRUE(queue().GiveBack(Claim()).ok());
    }
  }
  EXPECT_EQ(Get(1).state, JobState::kQueued);
  EXPECT_EQ(Get(1).failures, 0);
}

TEST_F(JobsTest, AJobWhoseWorkerFallsSilentIsTakenFromIt) {
  Create().value();
  const JobLease lease = Claim("w1");
  now_ += kLease;
  ASSERT_TRUE(queue().Renew(lease, kLease, "{}", false).ok());
  now_ += kLease;
  ASSERT_TRUE(queue().LoseExpired().ok());
  EXPECT_EQ(Get(1).state, JobState::kRunning);  // the lease ends now, it has not ended
  now_ += absl::Microseconds(1);
  ASSERT_TRUE(queue().LoseExpired().ok());
  EXPECT_EQ(Get(1).state, JobState::kQueued);
  EXPECT_EQ(Get(1).error, "attempt 1: worker w1 stopped reporting");
  EXPECT_EQ(queue().Renew(lease, kLease, "{}", false).code(), absl::StatusCode::kAborted);
}

TEST_F(JobsTest, AnErrorOfTheJobItselfIsFinal) {
  Create().value();
  ASSERT_TRUE(queue().Fail(Claim(), "loss is not finite").ok());
  EXPECT_EQ(Get(1).state, JobState::kFailed);
  EXPECT_EQ(Get(1).error, "loss is not finite");
  EXPECT_FALSE(BlobExists(Sha256Hex("data")));
}

TEST_F(JobsTest, CancellingStopsWaitingAndRunningJobs) {
  Create("one").value();
  Create("two").value();
  const JobLease lease = Claim();
  EXPECT_EQ(jobs().Cancel(1)->state, JobState::kCancelled);
  EXPECT_EQ(jobs().Cancel(2)->state, JobState::kCancelled);
  EXPECT_EQ(queue().Renew(lease, kLease, "{}", true).code(), absl::StatusCode::kAborted);
  EXPECT_FALSE(queue().Claim("w", kLease).value().has_value());
  EXPECT_FALSE(BlobExists(Sha256Hex("one")));
  now_ += absl::Hours(1);
  EXPECT_EQ(jobs().Cancel(1)->end_time, now_ - absl::Hours(1));  // again: no change
}

TEST_F(JobsTest, WhatHasEndedCannotBeCancelled) {
  Create().value();
  ASSERT_TRUE(queue().Publish(Claim(), Blob("w"), "{}").ok());
  const absl::Status status = jobs().Cancel(1).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(status.message()), HasSubstr("SUCCEEDED"));
}

TEST_F(JobsTest, DataThatTwoJobsShareStaysForTheSecond) {
  Create("same").value();
  Create("same").value();
  ASSERT_TRUE(jobs().Cancel(1).ok());
  EXPECT_TRUE(BlobExists(Sha256Hex("same")));
  ASSERT_TRUE(jobs().Cancel(2).ok());
  EXPECT_FALSE(BlobExists(Sha256Hex("same")));
}

TEST_F(JobsTest, TheSameRequestMakesOneJob) {
  EXPECT_EQ(Create("data", {"id-1", "print"})->number, 1);
  EXPECT_EQ(Create("data", {"id-1", "print"})->number, 1);
  EXPECT_EQ(Create("data", {"id-1", "other"}).status().code(), absl::StatusCode::kAlreadyExists);
  EXPECT_EQ(Create("data", {"id-2", "print"})->number, 2);
}

TEST_F(JobsTest, ListsNewestFirstInPages) {
  for (int i = 0; i < 3; ++i) Create().value();
  const auto first = jobs().List({2, ""});
  ASSERT_TRUE(first.ok());
  Create().value();  // newer than where the next page begins: not on it
  const auto second = jobs().List({2, first->next_page_token});
  ASSERT_TRUE(second.ok());
  std::vector<int64_t> numbers;
  for (const auto* page : {&*first, &*second}) {
    for (const Job& job : page->items) numbers.push_back(job.number);
  }
  EXPECT_THAT(numbers, ElementsAre(3, 2, 1));
}

TEST_F(JobsTest, TheWorkDirectorySurvivesARestartWhileTheJobIsAlive) {
  Create().value();
  const std::string work = queue().WorkDirectory({kDefaultTenant, 1, 1}).value();
  std::ofstream(work + "/checkpoint") << "half";
  EXPECT_EQ(queue().WorkDirectory({kDefaultTenant, 1, 1}).value(), work);
  Reopen();
  EXPECT_TRUE(std::filesystem::exists(work + "/checkpoint"));
}

TEST_F(JobsTest, WhatIsNotThereIsNotFound) {
  for (const absl::Status& status :
       {jobs().Get(7).status(), jobs().Cancel(7).status(), queue().Fail({kDefaultTenant, 7, 1}, "x")}) {
    EXPECT_EQ(status.code(), absl::StatusCode::kNotFound) << status;
  }
}

TEST_F(JobsTest, ABadModelNameIsInvalid) {
  EXPECT_EQ(jobs().Create({"../x", "{}", Blob("d"), {}}).status().code(),
            absl::StatusCode::kInvalidArgument);
}

TEST_F(JobsTest, ATenantWithManyJobsDoesNotKeepAnotherWaiting) {
  for (int i = 0; i < 5; ++i) Create().value();
  now_ += absl::Seconds(1);
  const auto theirs = store_->Of("other").jobs().Create({"robot", "{}", Blob("theirs"), {}});
  ASSERT_TRUE(theirs.ok()) << theirs.status();
  EXPECT_EQ(Claim().tenant, kDefaultTenant);
  const JobLease lease = Claim();
  EXPECT_EQ(lease.tenant, "other");
  EXPECT_EQ(lease.number, 1) << "every tenant counts for itself";
  EXPECT_EQ(Claim().tenant, kDefaultTenant);
  // What comes of it is theirs.
  ASSERT_TRUE(queue().Publish(lease, Blob("weights"), "{}").ok());
  EXPECT_TRUE(store_->Of("other").models().GetLatest("robot").ok());
  EXPECT_EQ(Mine().models().GetLatest("robot").status().code(), absl::StatusCode::kNotFound);
}

}  // namespace
}  // namespace metaekf::store
