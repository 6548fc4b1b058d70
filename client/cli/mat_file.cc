#include "client/cli/mat_file.h"

#include <matio.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <fstream>
#include <iterator>
#include <memory>
#include <string_view>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "client/cli/mat5.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/csv.h"

namespace metaekf::cli {
namespace {

struct Close {
  void operator()(mat_t* file) const { Mat_Close(file); }
  void operator()(matvar_t* array) const { Mat_VarFree(array); }
};

std::string ToText(const MatArray& array, size_t i) {
  if (!array.is_single || !std::isfinite(array.values[i])) return base::FormatExact(array.values[i]);
  char text[32];
  return std::string(text, std::to_chars(text, text + sizeof text, static_cast<float>(array.values[i])).ptr);
}

template <class T>
void Take(const matvar_t& array, std::vector<double>* values) {
  const T* begin = static_cast<const T*>(array.data);
  std::transform(begin, begin + values->size(), values->begin(), [](T value) { return static_cast<double>(value); });
}

/// @return whether it is an array of numbers that is a signal.
bool IsSignal(const matvar_t& array) {
  if (array.name == nullptr || array.rank != 2 || array.class_type < MAT_C_DOUBLE || array.class_type > MAT_C_UINT64) return false;
  return array.dims[0] > 1 || array.dims[1] > 1;
}

absl::StatusOr<MatArray> ToArray(const matvar_t& array) {
  MatArray read{.name = array.name, .rows = array.dims[0], .columns = array.dims[1], .is_single = array.class_type == MAT_C_SINGLE, .values = {}};
  const size_t count = read.rows * read.columns;
  if (array.isComplex) return absl::InvalidArgumentError(absl::StrCat("array \"", read.name, "\" is complex: give real numbers"));
  if (array.data == nullptr || array.nbytes < count * static_cast<size_t>(array.data_size)) {
    return absl::InvalidArgumentError(absl::StrCat("array \"", read.name, "\" is cut off"));
  }
  read.values.resize(count);
  switch (array.class_type) {
    case MAT_C_DOUBLE: Take<double>(array, &read.values); break;
    case MAT_C_SINGLE: Take<float>(array, &read.values); break;
    case MAT_C_INT8: Take<int8_t>(array, &read.values); break;
    case MAT_C_UINT8: Take<uint8_t>(array, &read.values); break;
    case MAT_C_INT16: Take<int16_t>(array, &read.values); break;
    case MAT_C_UINT16: Take<uint16_t>(array, &read.values); break;
    case MAT_C_INT32: Take<int32_t>(array, &read.values); break;
    case MAT_C_UINT32: Take<uint32_t>(array, &read.values); break;
    case MAT_C_INT64: Take<int64_t>(array, &read.values); break;
    default: Take<uint64_t>(array, &read.values); break;
  }
  return read;
}

/// Whether a file is HDF5 after a block of MATLAB's: matio tries anything else as version 4 and makes room for whatever that says.
bool IsMat73(std::string_view bytes) {
  constexpr size_t kUserBlock = 512;
  return bytes.size() > kUserBlock && bytes.substr(kUserBlock).starts_with("\x89HDF\r\n\x1a\n");
}

/// Reads what ReadMat5 does of a file of version 7.3, which is HDF5.
absl::StatusOr<std::vector<MatArray>> ReadMat73(const std::string& path, size_t file_size) {
  const std::unique_ptr<mat_t, Close> file(Mat_Open(path.c_str(), MAT_ACC_RDONLY));
  if (file == nullptr || Mat_GetVersion(file.get()) != MAT_FT_MAT73) {
    return absl::InvalidArgumentError("not a MAT file of version 5 or 7.3");
  }
  // matio makes room for what the file says, before it looks what is there.
  constexpr size_t kMostOfAByte = 1032;  // that deflate makes; a value takes one byte at least
  const size_t most_values = kMostOfAByte * file_size;
  std::vector<MatArray> arrays;
  while (const std::unique_ptr<matvar_t, Close> array{Mat_VarReadNextInfo(file.get())}) {
    if (!IsSignal(*array)) continue;
    if (array->dims[0] > most_values / std::max<size_t>(1, array->dims[1])) {
      return absl::InvalidArgumentError(absl::StrCat("array \"", array->name, "\" says that it is ", array->dims[0], " × ", array->dims[1],
                                                     ", more than the file can hold"));
    }
    if (Mat_VarReadDataAll(file.get(), array.get()) != 0) {
      return absl::InvalidArgumentError(absl::StrCat("array \"", array->name, "\" cannot be read"));
    }
    METAEKF_ASSIGN_OR_RETURN(MatArray read, ToArray(*array));
    arrays.push_back(std::move(read));
  }
  return arrays;
}

absl::StatusOr<std::vector<MatArray>> ReadArrays(std::istream& file, const std::string& path) {
  const std::string bytes{std::istreambuf_iterator<char>(file), {}};
  if (IsMat5(bytes)) return ReadMat5(bytes);
  if (IsMat73(bytes)) return ReadMat73(path, bytes.size());
  return absl::InvalidArgumentError("not a MAT file of version 5 or 7.3");
}

/// One column of the CSV: a row or column of an array.
struct Column {
  std::string name;
  const MatArray* array;
  size_t first, step;  // of its values
};

bool IsIdentifier(const std::string& name) {
  return !name.empty() && std::all_of(name.begin(), name.end(), [](char c) { return absl::ascii_isalnum(c) || c == '_'; });
}

absl::StatusOr<std::vector<Column>> ToColumns(const std::vector<MatArray>& arrays, size_t samples) {
  std::vector<Column> columns;
  for (const MatArray& array : arrays) {
    if (!IsIdentifier(array.name)) return absl::InvalidArgumentError("an array's name is none");
    const bool down = array.rows == samples;
    if (!down && array.columns != samples) {
      return absl::InvalidArgumentError(absl::StrCat("array \"", array.name, "\" is ", array.rows, " × ", array.columns,
                                                     ", but there are ", samples, " samples"));
    }
    const size_t width = down ? array.columns : array.rows;
    const bool numbered = width > 1 || array.name == "u" || array.name == "y" || array.name == "x";
    for (size_t k = 0; k < width; ++k) {
      columns.push_back({numbered ? absl::StrCat(array.name, k + 1) : array.name, &array, down ? k * samples : k, down ? 1 : width});
    }
  }
  return columns;
}

std::string ToCsv(const std::vector<Column>& columns, size_t samples) {
  std::string text;
  for (const Column& column : columns) absl::StrAppend(&text, text.empty() ? "" : ",", column.name);
  for (size_t t = 0; t < samples; ++t) {
    for (const Column& column : columns) {
      absl::StrAppend(&text, &column == columns.data() ? "\n" : ",", ToText(*column.array, column.first + t * column.step));
    }
  }
  text.push_back('\n');
  return text;
}

}  // namespace

bool IsMatFile(const std::string& path) { return absl::EndsWithIgnoreCase(path, ".mat"); }

absl::StatusOr<std::string> ReadMatFileAsCsv(const std::string& path) {
  METAEKF_ASSIGN_OR_RETURN(std::ifstream file, data::OpenForReading(path));
  const absl::StatusOr<std::vector<MatArray>> arrays = ReadArrays(file, path);
  if (!arrays.ok()) return base::Annotate(arrays.status(), path);
  size_t samples = 0;
  for (const MatArray& array : *arrays) samples = std::max({samples, array.rows, array.columns});
  if (samples == 0) return absl::InvalidArgumentError(absl::StrCat(path, ": there is no array of numbers"));
  const absl::StatusOr<std::vector<Column>> columns = ToColumns(*arrays, samples);
  if (!columns.ok()) return base::Annotate(columns.status(), path);
  return ToCsv(*columns, samples);
}

}  // namespace metaekf::cli
