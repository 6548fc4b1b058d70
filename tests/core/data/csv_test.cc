#include "core/data/csv.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <sstream>

#include "core/base/rng.h"

namespace metaekf::data {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

absl::StatusOr<Dataset> Read(const std::string& text, const CsvOptions& options = {}) {
  std::istringstream stream(text);
  return ReadCsv(stream, "data.csv", options);
}

std::string ErrorOf(const std::string& text, const CsvOptions& options = {}) {
  const auto dataset = Read(text, options);
  if (dataset.ok()) return "no error";
  EXPECT_EQ(dataset.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(dataset.status().message());
}

/// Equal bit for bit, but any NaN equals any other.
void ExpectSame(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  ASSERT_EQ(a.rows(), b.rows());
  ASSERT_EQ(a.cols(), b.cols());
  for (Eigen::Index i = 0; i < a.size(); ++i) {
    const double left = a.data()[i], right = b.data()[i];
    if (std::isnan(left) && std::isnan(right)) continue;
    EXPECT_EQ(left, right);
    EXPECT_EQ(std::signbit(left), std::signbit(right));
  }
}

void ExpectSame(const Dataset& a, const Dataset& b) {
  EXPECT_EQ(a.input_names, b.input_names);
  EXPECT_EQ(a.output_names, b.output_names);
  EXPECT_EQ(a.state_names, b.state_names);
  ASSERT_EQ(a.trajectories.size(), b.trajectories.size());
  for (size_t i = 0; i < a.trajectories.size(); ++i) {
    EXPECT_EQ(a.trajectories[i].name, b.trajectories[i].name);
    EXPECT_EQ(a.trajectories[i].start_s, b.trajectories[i].start_s);
    EXPECT_EQ(a.trajectories[i].sample_period_s, b.trajectories[i].sample_period_s);
    ExpectSame(a.trajectories[i].inputs, b.trajectories[i].inputs);
    ExpectSame(a.trajectories[i].outputs, b.trajectories[i].outputs);
    ExpectSame(a.trajectories[i].states, b.trajectories[i].states);
  }
}

/// Two trajectories of awkward numbers: tiny, huge, negative zero, many digits.
Dataset Awkward() {
  base::Rng rng(11);
  Dataset dataset{{"u1"}, {"y1", "y2"}, {"x1"}, {}};
  for (const char* name : {"first", "second, with a \"comma\""}) {
    Trajectory& trajectory = dataset.trajectories.emplace_back();
    trajectory.name = name;
    trajectory.sample_period_s = 1.0 / 750;
    const auto random = [&rng](Eigen::Index rows) {
      return Eigen::MatrixXd(Eigen::MatrixXd::NullaryExpr(
          rows, 500, [&rng] { return rng.Normal() * std::pow(10.0, rng.Uniform(-300, 300)); }));
    };
    trajectory.inputs = random(1);
    trajectory.outputs = random(2);
    trajectory.states = random(1);
    trajectory.inputs(0, 3) = -0.0;
    trajectory.inputs(0, 4) = std::numeric_limits<double>::denorm_min();
    trajectory.states(0, 5) = std::numeric_limits<double>::max();
  }
  return dataset;
}

TEST(CsvTest, ReadsSignalsByTheNumberInTheirNames) {
  // By hand: the columns stand out of order on purpose.
  const auto dataset = Read("t,y2,u1,y1,x1\n0,20,1,10,7\n0.5,21,2,11,8\n1,22,3,12,9\n");
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_THAT(dataset->input_names, ElementsAre("u1"));
  EXPECT_THAT(dataset->output_names, ElementsAre("y1", "y2"));
  EXPECT_THAT(dataset->state_names, ElementsAre("x1"));
  ASSERT_EQ(dataset->trajectories.size(), 1u);
  const Trajectory& trajectory = dataset->trajectories[0];
  EXPECT_EQ(trajectory.name, "0");
  EXPECT_EQ(trajectory.start_s, 0);
  EXPECT_EQ(trajectory.sample_period_s, 0.5);
  EXPECT_EQ(trajectory.inputs, (Eigen::MatrixXd(1, 3) << 1, 2, 3).finished());
  EXPECT_EQ(trajectory.outputs, (Eigen::MatrixXd(2, 3) << 10, 11, 12, 20, 21, 22).finished());
  EXPECT_EQ(trajectory.states, (Eigen::MatrixXd(1, 3) << 7, 8, 9).finished());
}

TEST(CsvTest, TenChannelsAreInNumericOrder) {
  const auto dataset = Read("y10,y1,y2,y3,y4,y5,y6,y7,y8,y9\n10,1,2,3,4,5,6,7,8,9\n");
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_EQ(dataset->trajectories[0].outputs, Eigen::VectorXd::LinSpaced(10, 1, 10));
}

TEST(CsvTest, WrittenDataReadsBackExactly) {
  const Dataset dataset = Awkward();
  std::ostringstream text;
  ASSERT_TRUE(WriteCsv(dataset, text).ok());
  const auto back = Read(text.str());
  ASSERT_TRUE(back.ok()) << back.status();
  ExpectSame(*back, dataset);
}

TEST(CsvTest, MissingOutputsReadBackWhereTheyAreAllowed) {
  Dataset dataset{{}, {"y1"}, {}, {Trajectory{"0", 0, 0, {}, {}, {}}}};
  Trajectory& trajectory = dataset.trajectories[0];
  trajectory.inputs.resize(0, 3);
  trajectory.states.resize(0, 3);
  trajectory.outputs = (Eigen::MatrixXd(1, 3) << 1, kNan, 3).finished();
  std::ostringstream text;
  ASSERT_TRUE(WriteCsv(dataset, text).ok());
  EXPECT_EQ(text.str(), "y1\n1\nnan\n3\n");
  const auto back = Read(text.str(), {.allow_missing_outputs = true});
  ASSERT_TRUE(back.ok()) << back.status();
  ExpectSame(*back, dataset);
}

TEST(CsvTest, AFileReadsBackExactlyAndAnInputOnlyFileIsLegal) {
  Dataset dataset{{"u1"}, {}, {}, {Trajectory{"0", 1.5, 0.01, {}, {}, {}}}};
  dataset.trajectories[0].inputs = Eigen::RowVectorXd::LinSpaced(400, -1, 1);
  dataset.trajectories[0].outputs.resize(0, 400);
  dataset.trajectories[0].states.resize(0, 400);
  const std::string path = testing::TempDir() + "/input_only.csv";
  ASSERT_TRUE(WriteCsvFile(dataset, path).ok());
  const auto back = ReadCsvFile(path);
  ASSERT_TRUE(back.ok()) << back.status();
  ExpectSame(*back, dataset);
  std::filesystem::remove(path);
}

TEST(CsvTest, ToleratesWhatSpreadsheetsWrite) {
  // Byte order mark, CRLF, quotes, blanks, empty lines at the end, no newline at the end.
  const auto dataset = Read(
      "\xEF\xBB\xBF\"trajectory\", \"u1\" ,y1\r\n\"a,\"\"b\"\"\", 1 ,2\r\n"
      "\"a,\"\"b\"\"\",3,4\r\nc,5,6\r\n\r\n");
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  ASSERT_EQ(dataset->trajectories.size(), 2u);
  EXPECT_EQ(dataset->trajectories[0].name, "a,\"b\"");
  EXPECT_EQ(dataset->trajectories[0].inputs, (Eigen::MatrixXd(1, 2) << 1, 3).finished());
  EXPECT_EQ(dataset->trajectories[1].outputs, (Eigen::MatrixXd(1, 1) << 6).finished());

  const auto without_newline = Read("y1\n1\n2");
  ASSERT_TRUE(without_newline.ok()) << without_newline.status();
  EXPECT_EQ(without_newline->trajectories[0].length(), 2);
}

TEST(CsvTest, TakesOtherNamesAndIgnoresTheRestThen) {
  const std::string text = "time of day,force,y1,comment\n12:00,1,10,ok\n12:01,2,20,bad\n";
  const auto dataset = Read(text, {.inputs = {{"force"}}});
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_THAT(dataset->input_names, ElementsAre("force"));
  EXPECT_THAT(dataset->output_names, ElementsAre("y1"));
  EXPECT_EQ(dataset->trajectories[0].inputs, (Eigen::MatrixXd(1, 2) << 1, 2).finished());
}

TEST(CsvTest, AnEmptyListLeavesASignalOut) {
  const auto dataset = Read("y1,x1,x2\n1,2,3\n", {.states = std::vector<std::string>{}});
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_THAT(dataset->state_names, IsEmpty());
  EXPECT_EQ(dataset->trajectories[0].states.rows(), 0);
  EXPECT_EQ(dataset->trajectories[0].states.cols(), 1);
}

TEST(CsvTest, ThePeriodIsTheFallbackOnlyWhereTheFileDoesNotTell) {
  const CsvOptions options{.fallback_sample_period_s = 0.25};
  EXPECT_EQ(Read("y1\n1\n2\n", options)->trajectories[0].sample_period_s, 0.25);
  EXPECT_EQ(Read("t,y1\n3,1\n", options)->trajectories[0].sample_period_s, 0.25);
  EXPECT_EQ(Read("t,y1\n3,1\n", options)->trajectories[0].start_s, 3);
  EXPECT_EQ(Read("t,y1\n0,1\n2,1\n", options)->trajectories[0].sample_period_s, 2);
  EXPECT_EQ(Read("y1\n1\n")->trajectories[0].sample_period_s, 0);
}

TEST(CsvTest, TimeStartsAnewWithEveryTrajectory) {
  const auto dataset = Read("trajectory,t,y1\na,0,1\na,1,2\nb,5,3\nb,7,4\nb,9,4\n");
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_EQ(dataset->trajectories[0].sample_period_s, 1);
  EXPECT_EQ(dataset->trajectories[1].sample_period_s, 2);
  EXPECT_EQ(dataset->trajectories[1].start_s, 5);
}

TEST(CsvTest, ErrorsNameFileRowAndColumn) {
  EXPECT_EQ(ErrorOf("u1,y1\n1,2\n3\n"), "data.csv:3: 1 cell, but the header names 2");
  EXPECT_EQ(ErrorOf("u1,y1\n1,2,9\n"), "data.csv:2: 3 cells, but the header names 2");
  EXPECT_EQ(ErrorOf("u1,y1\n1,2\n3,abc\n"), "data.csv:3: column \"y1\": \"abc\" is not a number");
  EXPECT_EQ(ErrorOf("u1,y1\n1,-inf\n"), "data.csv:2: column \"y1\": -inf is not finite");
  EXPECT_EQ(ErrorOf("u1,y1\n1,1e999\n"), "data.csv:2: column \"y1\": 1e999 is not finite");
  EXPECT_THAT(ErrorOf("u1,y1\n1,nan\n"),
              HasSubstr("data.csv:2: column \"y1\": a value is missing"));
  EXPECT_THAT(ErrorOf("u1,y1\n1,\n"), HasSubstr("data.csv:2: column \"y1\": a value is missing"));
}

TEST(CsvTest, OnlyOutputsMayBeMissing) {
  const CsvOptions options{.allow_missing_outputs = true};
  const auto dataset = Read("u1,y1,y2\n1,,NaN\n2,3,4\n", options);
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_TRUE(std::isnan(dataset->trajectories[0].outputs(0, 0)));
  EXPECT_TRUE(std::isnan(dataset->trajectories[0].outputs(1, 0)));
  EXPECT_THAT(ErrorOf("u1,y1\n,1\n", options), HasSubstr("data.csv:2: column \"u1\""));
  EXPECT_THAT(ErrorOf("x1,y1\nnan,1\n", options), HasSubstr("data.csv:2: column \"x1\""));
  EXPECT_THAT(ErrorOf("t,y1\n,1\n", options), HasSubstr("column \"t\": a time is missing"));
}

TEST(CsvTest, RefusesBadHeaders) {
  EXPECT_THAT(ErrorOf(""), HasSubstr("data.csv: no header"));
  EXPECT_THAT(ErrorOf("\n1\n"), HasSubstr("data.csv: no header"));
  EXPECT_THAT(ErrorOf("y1\n"), HasSubstr("no row follows"));
  EXPECT_THAT(ErrorOf("y1,y1\n1,2\n"), HasSubstr("data.csv:1: column \"y1\" occurs twice"));
  EXPECT_THAT(ErrorOf("y1,,u1\n1,2,3\n"), HasSubstr("data.csv:1: column 2 has no name"));
  EXPECT_THAT(ErrorOf("u1;y1\n1;2\n"), HasSubstr("separated by commas"));
  EXPECT_THAT(ErrorOf("y1,Y2\n1,2\n"), HasSubstr("data.csv:1: column \"Y2\": unknown"));
  EXPECT_THAT(ErrorOf("y1,y3\n1,2\n"), HasSubstr("no column \"y2\""));
  EXPECT_THAT(ErrorOf("y2\n1\n"), HasSubstr("no column \"y1\""));
  EXPECT_THAT(ErrorOf("t,trajectory\n0,a\n"), HasSubstr("no column of an input, output or state"));
}

TEST(CsvTest, RefusesAMappingThatDoesNotFit) {
  EXPECT_THAT(ErrorOf("a,b\n1,2\n", {.outputs = {{"c"}}}),
              HasSubstr("data.csv:1: no column \"c\"; the columns are a, b"));
  EXPECT_THAT(ErrorOf("a,b\n1,2\n", {.inputs = {{"a"}}, .outputs = {{"a"}}}),
              HasSubstr("column \"a\": is asked for twice"));
}

TEST(CsvTest, RefusesBrokenLines) {
  EXPECT_THAT(ErrorOf("y1\n1\n\n2\n"), HasSubstr("data.csv:3: empty line"));
  EXPECT_THAT(ErrorOf("y1\n\"1\n"), HasSubstr("data.csv:2: a quote is not closed"));
  EXPECT_THAT(ErrorOf("y1\n\"1\"2\n"), HasSubstr("data.csv:2: text follows a closing quote"));
}

TEST(CsvTest, NamesTheRowOfUnevenTime) {
  EXPECT_THAT(ErrorOf("t,y1\n0,1\n0.01,1\n0.02,1\n0.04,1\n"),
              HasSubstr("data.csv:5: column \"t\": uneven time: 0.02 s after the last row, where "
                        "0.01 s was expected"));
  EXPECT_THAT(ErrorOf("t,y1\n0,1\n1,1\n1,1\n"),
              HasSubstr("data.csv:4: column \"t\": time 1 s does not come after 1 s"));
}

TEST(CsvTest, RefusesATrajectoryThatComesBack) {
  EXPECT_THAT(ErrorOf("trajectory,y1\na,1\nb,2\na,3\n"),
              HasSubstr("data.csv:4: column \"trajectory\": \"a\" comes back"));
}

TEST(CsvTest, RefusesToWriteWhatWouldNotReadBack) {
  const auto error_of = [](const auto& change) {
    Dataset dataset = Awkward();
    change(dataset);
    std::ostringstream text;
    const absl::Status status = WriteCsv(dataset, text);
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    return std::string(status.message());
  };
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories.clear(); }), HasSubstr("no trajectory"));
  EXPECT_THAT(error_of([](Dataset& d) { d.output_names[1] = "t"; }),
              HasSubstr("\"t\" cannot name"));
  EXPECT_THAT(error_of([](Dataset& d) { d.output_names[1] = ""; }), HasSubstr("\"\" cannot name"));
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories[1].name = "first"; }),
              HasSubstr("\"first\" cannot name a trajectory"));
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories[1].sample_period_s = 0; }),
              HasSubstr("sample period"));
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories[0].states.resize(1, 3); }),
              HasSubstr("channels of the dataset"));
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories[0].outputs(1, 7) = kInfinity; }),
              HasSubstr("trajectory first, sample 7: an infinite value"));
  EXPECT_THAT(error_of([](Dataset& d) {
                for (auto* m : {&d.trajectories[0].inputs, &d.trajectories[0].outputs,
                                &d.trajectories[0].states}) {
                  m->resize(m->rows(), 0);
                }
              }),
              HasSubstr("has no sample"));
  EXPECT_THAT(error_of([](Dataset& d) {
                d.input_names.clear();
                d.output_names.clear();
                d.state_names.clear();
              }),
              HasSubstr("no channel"));
}

TEST(CsvTest, SaysWhyAFileCannotBeOpened) {
  const auto missing = ReadCsvFile("/nowhere/data.csv");
  EXPECT_EQ(missing.status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(missing.status().message()), HasSubstr("No such file"));
  const auto directory = ReadCsvFile("/tmp");
  EXPECT_EQ(directory.status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(directory.status().message()), HasSubstr("directory"));
  EXPECT_EQ(WriteCsvFile(Awkward(), "/nowhere/data.csv").code(), absl::StatusCode::kNotFound);
}

TEST(CsvTest, AFullDiskIsAnError) {
  if (!std::filesystem::exists("/dev/full")) GTEST_SKIP() << "this system has no /dev/full";
  EXPECT_EQ(WriteCsvFile(Awkward(), "/dev/full").code(), absl::StatusCode::kDataLoss);
}

TEST(CsvTest, ReadsATableOfNumbers) {
  const std::string path = testing::TempDir() + "/table.csv";
  std::ofstream(path) << "m_L,k_L\n2,5e4\n1,2.5e4\n3,1\n";
  const auto table = ReadTableFile(path);
  ASSERT_TRUE(table.ok()) << table.status();
  EXPECT_THAT(table->names, ElementsAre("m_L", "k_L"));
  EXPECT_EQ(table->values, (Eigen::MatrixXd(3, 2) << 2, 5e4, 1, 2.5e4, 3, 1).finished());

  std::ofstream(path) << "m_L,k_L\n2,\n";
  EXPECT_THAT(std::string(ReadTableFile(path).status().message()),
              HasSubstr(":2: column \"k_L\": a value is missing"));
  std::ofstream(path) << "m_L,k_L\n";
  EXPECT_THAT(std::string(ReadTableFile(path).status().message()), HasSubstr("no row"));
  std::filesystem::remove(path);
  EXPECT_EQ(ReadTableFile(path).status().code(), absl::StatusCode::kNotFound);
}

}  // namespace
}  // namespace metaekf::data
