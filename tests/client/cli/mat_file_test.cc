#include "client/cli/mat_file.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <matio.h>

#include <limits>

#include "client/cli/data_files.h"
#include "tests/client/run.h"

namespace metaekf::cli {
namespace {

using metaekf::testing::Contents;
using metaekf::testing::TempFile;
using metaekf::testing::TempPath;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

/// Writes arrays into a MAT file of one of the two versions.
class MatFileTest : public ::testing::TestWithParam<mat_ft> {
 protected:
  void SetUp() override {
    std::remove(path_.c_str());
    file_ = Mat_CreateVer(path_.c_str(), nullptr, GetParam());
    ASSERT_NE(file_, nullptr);
  }
  template <class T>
  void Add(const char* name, size_t rows, size_t columns, std::vector<T> values, matio_classes kind, matio_types type, int options = 0) {
    size_t dims[2] = {rows, columns};
    matvar_t* array = Mat_VarCreate(name, kind, type, 2, dims, values.data(), options);
    ASSERT_EQ(Mat_VarWrite(file_, array, MAT_COMPRESSION_ZLIB), 0);
    Mat_VarFree(array);
  }
  void Add(const char* name, size_t rows, size_t columns, std::vector<double> values) {
    Add(name, rows, columns, std::move(values), MAT_C_DOUBLE, MAT_T_DOUBLE);
  }
  absl::StatusOr<std::string> Read() {
    Mat_Close(file_);
    return ReadMatFileAsCsv(path_);
  }
  std::string Error() { return std::string(Read().status().message()); }

  const std::string path_ = TempPath("data.mat");
  mat_t* file_ = nullptr;
};

TEST_P(MatFileTest, ArraysBecomeColumns) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  Add("fs", 1, 1, {10.0});  // no signal
  Add<uint8_t>("note", 1, 4, {'w', 'e', 'l', 'l'}, MAT_C_CHAR, MAT_T_UTF8);
  Add<float>("t", 3, 1, {0, 0.1F, 0.2F}, MAT_C_SINGLE, MAT_T_SINGLE);
  Add("u", 3, 2, {1, 2, 3, 10, 20, 30});  // a column per input
  Add<uint8_t>("x1", 1, 3, {7, 8, 255}, MAT_C_UINT8, MAT_T_UINT8);
  Add<int32_t>("x2", 3, 1, {-4, 5, 6}, MAT_C_INT32, MAT_T_INT32);
  Add("y", 1, 3, {0.1, nan, 1.0 / 3});  // lying
  const auto text = Read();
  ASSERT_TRUE(text.ok()) << text.status();
  EXPECT_EQ(*text,
            "t,u1,u2,x1,x2,y1\n"
            "0,1,10,7,-4,0.1\n"
            "0.1,2,20,8,5,nan\n"
            "0.2,3,30,255,6,0.3333333333333333\n");
  const auto dataset = ReadData({path_}, {.allow_missing_outputs = true});
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  EXPECT_THAT(dataset->state_names, ElementsAre("x1", "x2"));
  EXPECT_EQ(dataset->trajectories.front().sample_period_s, 0.1);
  EXPECT_EQ(dataset->trajectories.front().outputs(0, 2), 1.0 / 3);
}

TEST_P(MatFileTest, TrajectoriesAreNumbered) {
  Add("trajectory", 4, 1, {1, 1, 2, 2});
  Add("y", 4, 1, {1, 2, 3, 4});
  ASSERT_TRUE(Read().ok());
  const auto dataset = ReadData({path_}, {});
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  ASSERT_EQ(dataset->trajectories.size(), 2u);
  EXPECT_EQ(dataset->trajectories[1].name, "2");
}

TEST_P(MatFileTest, ArraysOfDifferentLengthsAreNamed) {
  Add("u", 3, 1, {1, 2, 3});
  Add("y", 4, 2, {1, 2, 3, 4, 5, 6, 7, 8});
  EXPECT_THAT(Error(), HasSubstr("data.mat: array \"u\" is 3 × 1, but there are 4 samples"));
}

TEST_P(MatFileTest, ComplexArraysAreNamed) {
  std::vector<double> re = {1, 2}, im = {3, 4};
  mat_complex_split_t both = {re.data(), im.data()};
  size_t dims[2] = {2, 1};
  matvar_t* array = Mat_VarCreate("u", MAT_C_DOUBLE, MAT_T_DOUBLE, 2, dims, &both, MAT_F_COMPLEX);
  ASSERT_EQ(Mat_VarWrite(file_, array, MAT_COMPRESSION_NONE), 0);
  Mat_VarFree(array);
  EXPECT_THAT(Error(), HasSubstr("array \"u\" is complex"));
}

TEST_P(MatFileTest, WithoutArraysThereIsNothingToRead) {
  Add("fs", 1, 1, {10.0});
  EXPECT_THAT(Error(), HasSubstr("there is no array of numbers"));
}

TEST_P(MatFileTest, AFileThatIsCutOffIsAnError) {
  std::vector<double> values(1000);
  for (size_t i = 0; i < values.size(); ++i) values[i] = std::sin(static_cast<double>(i * i));
  Add("y", 1000, 1, values);
  const auto whole = Read();
  ASSERT_TRUE(whole.ok());
  const std::string bytes = Contents(path_);
  for (size_t size = 0; size < bytes.size(); size += bytes.size() / 23) {
    const auto read = ReadMatFileAsCsv(TempFile("part.mat", bytes.substr(0, size)));
    EXPECT_FALSE(read.ok()) << size << " of " << bytes.size() << " bytes";
  }
  if (GetParam() == MAT_FT_MAT73) return;  // whose data have no checksum
  std::string damaged = bytes;
  damaged[bytes.size() / 2] ^= 1;
  EXPECT_THAT(std::string(ReadMatFileAsCsv(TempFile("part.mat", damaged)).status().message()), HasSubstr("damaged"));
}

TEST_P(MatFileTest, StructuresArePassedOver) {
  const char* fields[] = {"notes"};
  size_t one[2] = {1, 1};
  matvar_t* structure = Mat_VarCreateStruct("info", 2, one, fields, 1);
  size_t dims[2] = {3, 1};
  double values[] = {1, 2, 3};
  Mat_VarSetStructFieldByName(structure, "notes", 0, Mat_VarCreate(nullptr, MAT_C_DOUBLE, MAT_T_DOUBLE, 2, dims, values, 0));
  ASSERT_EQ(Mat_VarWrite(file_, structure, MAT_COMPRESSION_ZLIB), 0);
  Mat_VarFree(structure);
  Add("y", 2, 1, {4, 5});
  const auto text = Read();
  ASSERT_TRUE(text.ok()) << text.status();
  EXPECT_EQ(*text, "y1\n4\n5\n");
}

INSTANTIATE_TEST_SUITE_P(Versions, MatFileTest, ::testing::Values(MAT_FT_MAT5, MAT_FT_MAT73),
                         [](const auto& version) { return version.param == MAT_FT_MAT5 ? "V5" : "V73"; });

/// A file of version 5 written out by hand: one array "y" of three numbers kept as int16, as MATLAB keeps whole doubles.
class Mat5Test : public ::testing::Test {
 protected:
  static std::string Words(bool big_endian, std::initializer_list<uint32_t> words) {
    std::string bytes;
    for (const uint32_t word : words) {
      for (int i = 0; i < 4; ++i) bytes.push_back(static_cast<char>(word >> 8 * (big_endian ? 3 - i : i)));
    }
    return bytes;
  }
  static std::string File(bool big_endian, uint32_t rows, uint32_t bytes_of_sizes, uint32_t stored_as) {
    const std::string values = big_endian ? std::string("\0\1\377\376\1\0\0\0", 8) : std::string("\1\0\376\377\0\1\0\0", 8);
    const std::string name = big_endian ? std::string("\0\1\0\1y\0\0\0", 8) : std::string("\1\0\1\0y\0\0\0", 8);
    return std::string(124, ' ') + (big_endian ? std::string("\1\0MI", 4) : std::string("\0\1IM", 4)) +
           Words(big_endian, {14, 56, 6, 8, 6, 0, 5, bytes_of_sizes, rows, 1}) + name + Words(big_endian, {stored_as, 6}) + values;
  }
  static std::string Error(const std::string& bytes) {
    return std::string(ReadMatFileAsCsv(TempFile("hand.mat", bytes)).status().message());
  }
};

TEST_F(Mat5Test, BothByteOrdersAreRead) {
  for (const bool big_endian : {false, true}) {
    const auto text = ReadMatFileAsCsv(TempFile("hand.mat", File(big_endian, 3, 8, 3)));
    ASSERT_TRUE(text.ok()) << text.status();
    EXPECT_EQ(*text, "y1\n1\n-2\n256\n");
  }
}

TEST_F(Mat5Test, WhatAnArrayDoesNotHoldIsNamed) {
  EXPECT_THAT(Error(File(false, 4, 8, 3)), HasSubstr("hand.mat: array \"y\" says that it is 4 × 1, which is not what it holds"));
  EXPECT_THAT(Error(File(false, 0x7fffffff, 8, 3)), HasSubstr("says that it is 2147483647 × 1, which is not what it holds"));
  EXPECT_THAT(Error(File(false, 3, 8, 8)), HasSubstr("which is not what it holds"));       // stored as no type there is
  EXPECT_THAT(Error(File(false, 3, 0x7ffffff0, 3)), HasSubstr("the file is cut off"));     // sizes of a billion dimensions
  EXPECT_THAT(Error(File(false, 0xffffffff, 8, 3)), HasSubstr("the file is damaged"));     // minus one row
}

TEST(MatFileNamesTest, WhatIsNoMatFileIsSaid) {
  EXPECT_TRUE(IsMatFile("a/B.MAT"));
  EXPECT_FALSE(IsMatFile("mat.csv"));
  EXPECT_THAT(std::string(ReadMatFileAsCsv(TempFile("n.mat", "u1,y1\n0,0\n")).status().message()), HasSubstr("not a MAT file"));
  // Of version 4, and says that it is huge.
  const std::string version_4 = std::string(4, '\0') + std::string(96, 'u');
  EXPECT_THAT(std::string(ReadMatFileAsCsv(TempFile("v4.mat", version_4)).status().message()), HasSubstr("not a MAT file of version 5 or 7.3"));
  const auto missing = ReadMatFileAsCsv("/no/such.mat");
  EXPECT_EQ(missing.status().code(), absl::StatusCode::kNotFound);
}

}  // namespace
}  // namespace metaekf::cli
