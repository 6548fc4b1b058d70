#include "client/cli/records.h"

#include <gtest/gtest.h>

#include <cmath>
#include <sstream>

namespace metaekf::cli {
namespace {

class RecordsTest : public ::testing::Test {
 protected:
  /// What `print` prints in a format.
  template <typename Print>
  std::string In(Format format, Print print) {
    std::istringstream in;
    std::ostringstream out, err;
    Console console(in, out, err, false);
    console.format = format;
    print(console);
    return out.str();
  }

  const std::vector<Record> list_ = {{{"name", "a"}, {"loss", 1.0 / 3}, {"count", 12}},
                                     {{"name", "b, \"c\""}, {"loss", nullptr}, {"count", 3}}};
};

TEST_F(RecordsTest, TablesHaveFourDigitsAndAlignedColumns) {
  EXPECT_EQ(In(Format::kTable,
               [&](Console& to) {
                 PrintRecords(to, {"name", "loss", "count"}, list_);
               }),
            "name      loss  count\n"
            "a       0.3333     12\n"
            "b, \"c\"              3\n");
}

TEST_F(RecordsTest, CsvAndJsonReadBackExactly) {
  // 0.333… with 16 digits is the shortest text of the double nearest to 1/3.
  EXPECT_EQ(In(Format::kCsv,
               [&](Console& to) {
                 PrintRecords(to, {"name", "loss", "count"}, list_);
               }),
            "name,loss,count\n"
            "a,0.3333333333333333,12\n"
            "\"b, \"\"c\"\"\",,3\n");
  const auto json =
      Record::parse(In(Format::kJson, [&](Console& to) { PrintRecords(to, {"name"}, list_); }));
  EXPECT_EQ(json[0]["loss"].get<double>(), 1.0 / 3);
  EXPECT_TRUE(json[1]["loss"].is_null());
}

TEST_F(RecordsTest, AnEmptyListIsStillAList) {
  const auto print = [](Console& to) { PrintRecords(to, {"name", "loss"}, {}); };
  EXPECT_EQ(In(Format::kTable, print), "name  loss\n");
  EXPECT_EQ(In(Format::kCsv, print), "name,loss\n");
  EXPECT_EQ(In(Format::kJson, print), "[]\n");
}

TEST_F(RecordsTest, OneRecordIsAFieldPerLine) {
  const Record record = {
      {"id", "7"}, {"error", ""}, {"nis", std::nan("")}, {"spec", "a: 1\nb: 2\n"}};
  const auto print = [&](Console& to) { PrintRecord(to, record); };
  EXPECT_EQ(In(Format::kTable, print),
            "id     7\n"
            "error\n"
            "nis    nan\n"
            "spec\n"
            "  a: 1\n"
            "  b: 2\n");
  EXPECT_TRUE(Record::parse(In(Format::kJson, print))["nis"].is_null());
}

TEST(TimeRecordTest, TimesAreUtc) {
  using std::chrono::system_clock;
  // 2000-02-29 12:34:56 UTC, by `date -u -d @951827696`.
  EXPECT_EQ(ToRecord(system_clock::from_time_t(951827696)), "2000-02-29T12:34:56Z");
  EXPECT_TRUE(ToRecord(system_clock::time_point()).is_null());
}

}  // namespace
}  // namespace metaekf::cli
