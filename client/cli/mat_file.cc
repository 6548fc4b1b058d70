#include "client/cli/mat_file.h"

#include <matio.h>
#include <zlib.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <memory>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

struct Close {
  void operator()(mat_t* file) const { Mat_Close(file); }
  void operator()(matvar_t* array) const { Mat_VarFree(array); }
};

/// A numeric array of a file, column by column.
struct Array {
  std::string name;
  size_t rows = 0, columns = 0;
  bool is_single = false;  // printed as such: 0.1f is 0.1, and times stay even
  std::vector<double> values;
};

std::string ToText(const Array& array, size_t i) {
  if (!array.is_single || !std::isfinite(array.values[i])) return base::FormatExact(array.values[i]);
  char text[32];
  return std::string(text, std::to_chars(text, text + sizeof text, static_cast<float>(array.values[i])).ptr);
}

template <class T>
void Take(const matvar_t& array, std::vector<double>* values) {
  const T* begin = static_cast<const T*>(array.data);
  std::transform(begin, begin + values->size(), values->begin(), [](T value) { return static_cast<double>(value); });
}

bool IsIdentifier(const std::string& name) {
  return !name.empty() && std::all_of(name.begin(), name.end(), [](char c) { return absl::ascii_isalnum(c) || c == '_'; });
}

/// @return whether it is an array of numbers that is a signal.
bool IsSignal(const matvar_t& array) {
  if (array.rank != 2 || array.class_type < MAT_C_DOUBLE || array.class_type > MAT_C_UINT64) return false;
  return array.dims[0] > 1 || array.dims[1] > 1;
}

absl::StatusOr<Array> ToArray(const matvar_t& array) {
  Array read{.name = array.name, .rows = array.dims[0], .columns = array.dims[1], .is_single = array.class_type == MAT_C_SINGLE, .values = {}};
  const size_t count = read.rows * read.columns;
  if (!IsIdentifier(read.name)) return absl::InvalidArgumentError("an array's name is none");
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

/// @param most_values  that the file can hold: matio makes room for what the file says, before it looks what is there.
absl::StatusOr<std::vector<Array>> ReadArrays(mat_t* file, size_t most_values) {
  std::vector<Array> arrays;
  while (const std::unique_ptr<matvar_t, Close> array{Mat_VarReadNextInfo(file)}) {
    if (array->name == nullptr || !IsSignal(*array)) continue;
    if (array->dims[0] > most_values / std::max<size_t>(1, array->dims[1])) {
      return absl::InvalidArgumentError(absl::StrCat("array \"", array->name, "\" says that it is ", array->dims[0], " × ", array->dims[1],
                                                     ", more than the file can hold"));
    }
    if (Mat_VarReadDataAll(file, array.get()) != 0) {
      return absl::InvalidArgumentError(absl::StrCat("array \"", array->name, "\" cannot be read"));
    }
    METAEKF_ASSIGN_OR_RETURN(Array read, ToArray(*array));
    arrays.push_back(std::move(read));
  }
  return arrays;
}

uint32_t Word(const std::string& bytes, size_t at, bool big_endian) {
  uint32_t word = 0;
  for (size_t i = 0; i < 4; ++i) word |= uint32_t{static_cast<uint8_t>(bytes[at + i])} << 8 * (big_endian ? 3 - i : i);
  return word;
}

/// Whether a zlib stream comes to its end, its checksum included.
bool IsWholeStream(const char* bytes, size_t size) {
  z_stream stream{};
  if (inflateInit(&stream) != Z_OK) return false;
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<char*>(bytes));
  stream.avail_in = static_cast<uInt>(size);
  std::vector<Bytef> out(size_t{1} << 16);
  int code = Z_OK;
  while (code == Z_OK) {
    stream.next_out = out.data();
    stream.avail_out = static_cast<uInt>(out.size());
    code = inflate(&stream, Z_NO_FLUSH);
  }
  inflateEnd(&stream);
  return code == Z_STREAM_END;
}

/// That the arrays of a file of version 5 are all there: matio reads zeros where a file is cut off.
absl::Status CheckWhole(const std::string& path) {
  constexpr size_t kHeader = 128, kTag = 8;
  constexpr uint32_t kMatrix = 14, kCompressed = 15;
  std::ifstream file(path, std::ios::binary);
  const std::string bytes{std::istreambuf_iterator<char>(file), {}};
  if (bytes.size() < kHeader) return absl::InvalidArgumentError("not a MAT file of version 5 or 7.3");
  const bool big_endian = bytes[126] == 'M';
  for (size_t at = kHeader, end = 0; at < bytes.size(); at = end) {
    if (bytes.size() - at < kTag) return absl::InvalidArgumentError("the file is cut off");
    const uint32_t type = Word(bytes, at, big_endian), size = Word(bytes, at + 4, big_endian);
    end = at + kTag + size;
    if (end > bytes.size()) return absl::InvalidArgumentError("the file is cut off");
    if (type != kMatrix && type != kCompressed) return absl::InvalidArgumentError("not a MAT file of version 5 or 7.3");
    if (type == kCompressed && !IsWholeStream(&bytes[at + kTag], size)) return absl::InvalidArgumentError("the file is damaged");
  }
  return absl::OkStatus();
}

/// One column of the CSV: a row or column of an array.
struct Column {
  std::string name;
  const Array* array;
  size_t first, step;  // of its values
};

absl::StatusOr<std::vector<Column>> ToColumns(const std::vector<Array>& arrays, size_t samples) {
  std::vector<Column> columns;
  for (const Array& array : arrays) {
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
  std::error_code error;
  if (!std::filesystem::is_regular_file(path, error)) {
    return absl::NotFoundError(absl::StrCat("cannot read ", path, ": ", error ? error.message() : "it is no file"));
  }
  const std::unique_ptr<mat_t, Close> file(Mat_Open(path.c_str(), MAT_ACC_RDONLY));
  if (file == nullptr) return absl::InvalidArgumentError(absl::StrCat(path, ": not a MAT file of version 5 or 7.3"));
  if (Mat_GetVersion(file.get()) == MAT_FT_MAT4) return absl::InvalidArgumentError(absl::StrCat(path, ": not a MAT file of version 5 or 7.3"));
  if (Mat_GetVersion(file.get()) == MAT_FT_MAT5) METAEKF_RETURN_IF_ERROR(base::Annotate(CheckWhole(path), path));
  constexpr size_t kMostOfAByte = 1032;  // that deflate makes; a value takes one byte at least
  const absl::StatusOr<std::vector<Array>> arrays = ReadArrays(file.get(), kMostOfAByte * std::filesystem::file_size(path, error));
  if (!arrays.ok()) return base::Annotate(arrays.status(), path);
  size_t samples = 0;
  for (const Array& array : *arrays) samples = std::max({samples, array.rows, array.columns});
  if (samples == 0) return absl::InvalidArgumentError(absl::StrCat(path, ": there is no array of numbers"));
  const absl::StatusOr<std::vector<Column>> columns = ToColumns(*arrays, samples);
  if (!columns.ok()) return base::Annotate(columns.status(), path);
  return ToCsv(*columns, samples);
}

}  // namespace metaekf::cli
