#include "server/store/database.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <functional>
#include <iterator>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

class DatabaseTest : public testing::Test {
 protected:
  void SetUp() override {
    database_ = Database::Open(path_).value();
    ASSERT_TRUE(Write("CREATE TABLE t (n INTEGER, b BLOB)").ok());
  }
  absl::Status Write(const std::string& sql, std::initializer_list<Value> parameters = {}) {
    return database_->Write([&](Connection& c) { return c.Execute(sql, parameters); });
  }
  int64_t Count() {
    int64_t count = -1;
    const auto counted = database_->Read([&](Connection& c) {
      return c.Execute("SELECT count(*) FROM t", {}, [&](const Row& row) { count = row.Int(0); });
    });
    EXPECT_TRUE(counted.ok()) << counted;
    return count;
  }

  TempDirectory directory_;
  const std::string path_ = directory_.path() + "/test.db";
  std::unique_ptr<Database> database_;
};

TEST_F(DatabaseTest, ValuesComeBackAsTheyWere) {
  const std::string bytes("\0\xFFx", 3);
  ASSERT_TRUE(Write("INSERT INTO t VALUES (?1, ?2), (?3, ?4)",
                    {int64_t{1} << 62, Bytes{bytes}, nullptr, "text"})
                  .ok());
  std::vector<std::pair<int64_t, std::string>> rows;
  const auto read = database_->Read([&](Connection& c) {
    return c.Execute("SELECT n, b FROM t ORDER BY rowid", {},
                     [&](const Row& row) { rows.emplace_back(row.Int(0), row.Text(1)); });
  });
  ASSERT_TRUE(read.ok()) << read;
  EXPECT_EQ(rows,
            (std::vector<std::pair<int64_t, std::string>>{{int64_t{1} << 62, bytes}, {0, "text"}}));
}

TEST_F(DatabaseTest, FourReadersAtATimeLeaveNoMoreFilesOpen) {
  const auto open_files = [] {
    const std::filesystem::directory_iterator all("/proc/self/fd");
    return std::distance(begin(all), end(all));
  };
  const auto before = open_files();
  const std::function<void(int)> read_within = [&](int more) {
    EXPECT_TRUE(database_->Read([&](Connection& c) {
      if (more > 0) read_within(more - 1);
      return c.Execute("SELECT count(*) FROM t");
    }).ok());
  };
  read_within(3);
  EXPECT_EQ(open_files(), before);
}

TEST_F(DatabaseTest, AnErrorUndoesTheWholeTransaction) {
  const absl::Status status = database_->Write([&](Connection& c) -> absl::Status {
    EXPECT_TRUE(c.Execute("INSERT INTO t VALUES (1, NULL)").ok());
    return absl::AbortedError("changed my mind");
  });
  EXPECT_EQ(status, absl::AbortedError("changed my mind"));
  EXPECT_EQ(Count(), 0);
}

TEST_F(DatabaseTest, ReadersSeeTheLastCommitWithoutWaiting) {
  ASSERT_TRUE(Write("INSERT INTO t VALUES (1, NULL)").ok());
  const absl::Status status = database_->Write([&](Connection& c) -> absl::Status {
    EXPECT_TRUE(c.Execute("INSERT INTO t VALUES (2, NULL)").ok());
    EXPECT_EQ(c.changes(), 1);
    EXPECT_EQ(Count(), 1);
    return absl::OkStatus();
  });
  ASSERT_TRUE(status.ok()) << status;
  EXPECT_EQ(Count(), 2);
}

TEST_F(DatabaseTest, ReadersCannotWrite) {
  const absl::Status status =
      database_->Read([&](Connection& c) { return c.Execute("INSERT INTO t VALUES (1, NULL)"); });
  EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition) << status;
  EXPECT_EQ(Count(), 0);
}

TEST_F(DatabaseTest, AWrongStatementIsInternal) {
  EXPECT_EQ(Write("SELEKT").code(), absl::StatusCode::kInternal);
}

TEST_F(DatabaseTest, AFullDiskIsResourceExhaustedAndPasses) {
  const std::string big(1 << 20, 'x');
  {
    FileSizeLimit limit(100'000);
    const absl::Status status = Write("INSERT INTO t VALUES (1, ?1)", {Bytes{big}});
    EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted) << status;
  }
  EXPECT_EQ(Count(), 0);
  ASSERT_TRUE(Write("PRAGMA max_page_count = 10").ok());
  EXPECT_EQ(Write("INSERT INTO t VALUES (1, ?1)", {Bytes{big}}).code(),
            absl::StatusCode::kResourceExhausted);
  ASSERT_TRUE(Write("PRAGMA max_page_count = 1000000").ok());
  EXPECT_TRUE(Write("INSERT INTO t VALUES (1, ?1)", {Bytes{big}}).ok());
  EXPECT_EQ(Count(), 1);
}

TEST_F(DatabaseTest, ADamagedFileIsDataLoss) {
  for (int64_t n = 0; n < 500; ++n) {
    ASSERT_TRUE(Write("INSERT INTO t VALUES (?1, ?2)", {n, Bytes{std::string(100, 'x')}}).ok());
  }
  database_.reset();
  {
    std::fstream file(path_, std::ios::in | std::ios::out);
    file.seekp(4096 * 3);  // the fourth page: one of the table's
    file << std::string(4096, 'z');
  }
  EXPECT_EQ(Database::Open(path_).status().code(), absl::StatusCode::kDataLoss);
  std::ofstream(path_) << std::string(8192, 'z');
  EXPECT_EQ(Database::Open(path_).status().code(), absl::StatusCode::kDataLoss);
}

TEST_F(DatabaseTest, AFileThatCannotBeOpenedIsFailedPrecondition) {
  EXPECT_EQ(Database::Open(directory_.path() + "/no/such/place.db").status().code(),
            absl::StatusCode::kFailedPrecondition);
}

}  // namespace
}  // namespace metaekf::store
