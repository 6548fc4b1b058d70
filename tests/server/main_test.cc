// What metaekfd answers on its command line.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"
#include "tests/server/support/server_process.h"

namespace metaekf::server {
namespace {

int ExitStatus(const std::vector<std::string>& arguments) {
  return WorkerProcess::Start(METAEKFD_BINARY, arguments)->Wait().code;
}

TEST(MetaekfdTest, ExitStatusTellsWrongUsageFromFailure) {
  store::TempDirectory directory;
  EXPECT_EQ(ExitStatus({"--help"}), 0);
  EXPECT_EQ(ExitStatus({"--speed", "3"}), 2);
  EXPECT_EQ(ExitStatus({}), 2);  // no data directory
  EXPECT_EQ(ExitStatus({"--data-dir", directory.path(), "--listen", "nowhere"}), 2);
  EXPECT_EQ(ExitStatus({"--data-dir", directory.path(), "--listen", "0.0.0.0:0"}), 2);
  EXPECT_EQ(ExitStatus({"--data-dir", directory.path(), "--config", "/nowhere"}), 1);
  EXPECT_EQ(ExitStatus({"--data-dir", "/proc/metaekf", "--listen", "127.0.0.1:0"}), 1);
}

TEST(MetaekfdTest, ADirectoryIsServedByOne) {
  store::TempDirectory directory;
  ServerProcess server = ServerProcess::Metaekfd(directory.path());
  EXPECT_NE(server.address(), "");
  EXPECT_EQ(ExitStatus({"--data-dir", directory.path(), "--listen", "127.0.0.1:0"}), 1);
  EXPECT_EQ(server.End(SIGTERM).code, 0);
}

TEST(MetaekfdTest, AWorkerWithoutItsServerDoesNothing) {
  // Process 1 is not our parent.
  EXPECT_EQ(ExitStatus({"worker", "--dataset", "/nowhere", "--work-directory", "/nowhere",
                        "--threads", "1", "--checkpoint-period-s", "1", "--server", "1"}),
            75);
}

}  // namespace
}  // namespace metaekf::server
