#include "server/executor/give_way.h"

#include <gtest/gtest.h>
#include <sched.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <future>
#include <memory>
#include <thread>

namespace metaekf::server {
namespace {

/// How many processors a thread may use. @param thread  0: the calling one.
int Processors(pid_t thread) {
  cpu_set_t processors;
  return sched_getaffinity(thread, sizeof(processors), &processors) == 0 ? CPU_COUNT(&processors) : -1;
}

class FreeProcessorTest : public ::testing::Test {
 protected:
  void SetUp() override {
    if (all_ < 2) GTEST_SKIP() << "there is one processor";
  }
  const int all_ = Processors(0);
};

TEST_F(FreeProcessorTest, ThreadsThatGiveWayLeaveOneWhileItIsKept) {
  std::promise<pid_t> started;
  std::promise<void> stop;
  std::thread batch([&] {
    GiveWay();
    started.set_value(gettid());
    stop.get_future().wait();
  });
  const pid_t thread = started.get_future().get();
  EXPECT_EQ(Processors(thread), all_);
  {
    const FreeProcessor one;
    auto another = std::make_unique<FreeProcessor>();
    EXPECT_EQ(Processors(thread), all_ - 1);
    EXPECT_EQ(Processors(0), all_);
    another.reset();
    EXPECT_EQ(Processors(thread), all_ - 1);
    std::thread([&] {
      GiveWay();
      EXPECT_EQ(Processors(0), all_ - 1) << "one that begins meanwhile";
      EXPECT_EQ(UsableProcessors(), static_cast<unsigned>(all_ - 1));
    }).join();
  }
  EXPECT_EQ(Processors(thread), all_);
  stop.set_value();
  batch.join();
}

TEST_F(FreeProcessorTest, ProcessesDoAsTheyAreTold) {
  const auto start = [] {
    const pid_t process = fork();
    if (process == 0) {
      while (true) pause();
    }
    return process;
  };
  const pid_t early = start();
  AddBatchProcess(early);
  auto kept = std::make_unique<FreeProcessor>();
  EXPECT_EQ(Processors(early), all_ - 1);
  const pid_t late = start();
  AddBatchProcess(late);
  EXPECT_EQ(Processors(late), all_ - 1);
  RemoveBatchProcess(late);
  kept.reset();
  EXPECT_EQ(Processors(early), all_);
  EXPECT_EQ(Processors(late), all_ - 1);
  RemoveBatchProcess(early);
  for (const pid_t process : {early, late}) {
    kill(process, SIGKILL);
    waitpid(process, nullptr, 0);
  }
}

}  // namespace
}  // namespace metaekf::server
