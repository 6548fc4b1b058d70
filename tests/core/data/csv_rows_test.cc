#include "core/data/csv_rows.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <sstream>
#include <streambuf>
#include <string>

namespace metaekf::data {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

TEST(CsvRowsTest, GivesOneRowAtATime) {
  std::istringstream stream("trajectory,t,u1,y1,y2\na,0,1,2,\na,0.5,3,4,5\nb,7,6,nan,8\n");
  auto reader = CsvRowReader::Open(stream, "rows", {.allow_missing_outputs = true});
  ASSERT_TRUE(reader.ok()) << reader.status();
  EXPECT_THAT(reader->input_names(), ElementsAre("u1"));
  EXPECT_THAT(reader->output_names(), ElementsAre("y1", "y2"));
  EXPECT_TRUE(reader->state_names().empty());

  CsvRow row;
  ASSERT_EQ(reader->Next(row).value(), true);
  EXPECT_EQ(row.line, 2);
  EXPECT_EQ(row.trajectory, "a");
  EXPECT_TRUE(row.starts_trajectory);
  EXPECT_EQ(row.time_s, 0);
  EXPECT_EQ(row.inputs[0], 1);
  EXPECT_EQ(row.outputs[0], 2);
  EXPECT_TRUE(std::isnan(row.outputs[1]));
  EXPECT_EQ(reader->time().PeriodS(), 0);

  ASSERT_EQ(reader->Next(row).value(), true);
  EXPECT_FALSE(row.starts_trajectory);
  EXPECT_EQ(row.outputs[1], 5);
  EXPECT_EQ(reader->time().PeriodS(), 0.5);

  ASSERT_EQ(reader->Next(row).value(), true);
  EXPECT_EQ(row.line, 4);
  EXPECT_EQ(row.trajectory, "b");
  EXPECT_TRUE(row.starts_trajectory);
  EXPECT_EQ(row.time_s, 7);
  EXPECT_EQ(reader->Next(row).value(), false);
  EXPECT_EQ(reader->Next(row).value(), false);
}

TEST(CsvRowsTest, WithoutTimeAndTrajectoryTheirPlacesSaySo) {
  std::istringstream stream("y1\n5\n");
  auto reader = CsvRowReader::Open(stream, "rows");
  ASSERT_TRUE(reader.ok());
  CsvRow row;
  ASSERT_EQ(reader->Next(row).value(), true);
  EXPECT_EQ(row.trajectory, "0");
  EXPECT_TRUE(row.starts_trajectory);
  EXPECT_TRUE(std::isnan(row.time_s));
}

/// Hands out one line whenever the reader has used up the last, and counts them: a pipe whose
/// writer waits.
class LineByLine : public std::streambuf {
 public:
  int lines_given = 0;

 protected:
  int_type underflow() override {
    static constexpr const char* kLines[] = {"y1\n", "1\n", "2\n", "3\n"};
    if (lines_given == 4) return traits_type::eof();
    line_ = kLines[lines_given++];
    setg(line_.data(), line_.data(), line_.data() + line_.size());
    return traits_type::to_int_type(line_[0]);
  }

 private:
  std::string line_;
};

TEST(CsvRowsTest, ReadsNoFurtherThanTheRowAskedFor) {
  LineByLine lines;
  std::istream stream(&lines);
  auto reader = CsvRowReader::Open(stream, "pipe");
  ASSERT_TRUE(reader.ok());
  EXPECT_EQ(lines.lines_given, 1);
  CsvRow row;
  ASSERT_EQ(reader->Next(row).value(), true);
  EXPECT_EQ(lines.lines_given, 2);
  ASSERT_EQ(reader->Next(row).value(), true);
  EXPECT_EQ(lines.lines_given, 3);
}

/// A stream whose device fails after the first line.
class Failing : public std::streambuf {
 protected:
  int_type underflow() override {
    if (given_) throw std::ios_base::failure("device gone");
    given_ = true;
    setg(line_, line_, line_ + 5);
    return traits_type::to_int_type(line_[0]);
  }

 private:
  bool given_ = false;
  char line_[6] = "y1\n1\n";
};

TEST(CsvRowsTest, AFailingStreamIsNotTheEndOfTheFile) {
  Failing device;
  std::istream stream(&device);
  auto reader = CsvRowReader::Open(stream, "device");
  ASSERT_TRUE(reader.ok());
  CsvRow row;
  ASSERT_EQ(reader->Next(row).value(), true);
  const auto next = reader->Next(row);
  EXPECT_EQ(next.status().code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(next.status().message()),
              HasSubstr("device: reading failed after line 2"));
}

}  // namespace
}  // namespace metaekf::data
