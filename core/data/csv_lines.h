#pragma once

#include <cstdint>
#include <istream>
#include <string>
#include <string_view>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace metaekf::data {

/// The lexical half of reading CSV: a header, then one line of as many cells at a time.
///
/// Cells are separated by commas and may stand in double quotes ("" inside quotes is one quote); a
/// quoted cell ends on its own line. Tolerated: a UTF-8 byte order mark, CRLF, blanks around cells,
/// a last line without newline, empty lines at the end. Nothing is read beyond the line asked for,
/// empty lines apart, so a pipe can be followed row by row.
class CsvLines {
 public:
  /// Reads the header. `source` names the stream in messages; the stream must outlive the object.
  ///
  /// Errors (InvalidArgument unless said otherwise, with source and line): no header; another
  /// separator; a column without a name; a name that occurs twice; DataLoss if the stream fails.
  static absl::StatusOr<CsvLines> Open(std::istream& stream, std::string source);

  const std::vector<std::string>& header() const { return header_; }
  /// Index of the column called `name`, or −1.
  int Find(std::string_view name) const;

  /// Reads the next line; false at the end. Errors: a number of cells other than the header's, an
  /// empty line before the last, an unclosed quote; DataLoss if the stream fails.
  absl::StatusOr<bool> Next();

  /// Cells of the line last read, without blanks and quotes around them; valid until the next read.
  const std::vector<std::string_view>& cells() const { return cells_; }
  /// Number of the line last read, counted from 1; the header is line 1.
  int64_t line() const { return line_; }

  /// The number in cell `column`; NaN for an empty cell, "nan" and "NaN". Errors: text, infinity.
  absl::StatusOr<double> Number(int column) const;

  /// An InvalidArgument that names source and line, and the column unless it is −1.
  absl::Status Error(int column, const std::string& message) const;

 private:
  CsvLines(std::istream& stream, std::string source)
      : stream_(&stream), source_(std::move(source)) {}

  /// The next line without its end; false at the end of the stream.
  absl::StatusOr<bool> ReadLine();
  absl::Status Split();

  std::istream* stream_;
  std::string source_;
  std::vector<std::string> header_;
  std::string text_;                     // the line last read
  std::string unquoted_;                 // what cells with doubled quotes refer to
  std::vector<std::string_view> cells_;  // into text_ or unquoted_
  int64_t line_ = 0;
};

}  // namespace metaekf::data
