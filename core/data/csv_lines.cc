#include "core/data/csv_lines.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::data {
namespace {

std::string_view WithoutBlanks(std::string_view text) {
  const auto is_blank = [](char c) { return c == ' ' || c == '\t'; };
  while (!text.empty() && is_blank(text.front())) text.remove_prefix(1);
  while (!text.empty() && is_blank(text.back())) text.remove_suffix(1);
  return text;
}

}  // namespace

absl::Status CsvLines::Error(int column, const std::string& message) const {
  std::string place = absl::StrCat(source_, ":", line_, ": ");
  if (column >= 0) absl::StrAppend(&place, "column \"", header_[column], "\": ");
  return absl::InvalidArgumentError(absl::StrCat(place, message));
}

absl::StatusOr<CsvLines> CsvLines::Open(std::istream& stream, std::string source) {
  CsvLines lines(stream, std::move(source));
  METAEKF_ASSIGN_OR_RETURN(const bool found, lines.ReadLine());
  if (!found || WithoutBlanks(lines.text_).empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat(lines.source_, ": no header; the first line must name the columns"));
  }
  if (lines.text_.starts_with("\xEF\xBB\xBF")) lines.text_.erase(0, 3);
  METAEKF_RETURN_IF_ERROR(lines.Split());
  for (const std::string_view cell : lines.cells_) {
    std::string name(cell);
    if (lines.cells_.size() == 1 && name.find_first_of(";\t") != std::string::npos) {
      return lines.Error(-1, "columns must be separated by commas");
    }
    if (name.empty()) {
      return lines.Error(-1, absl::StrCat("column ", lines.header_.size() + 1, " has no name"));
    }
    if (lines.Find(name) >= 0) {
      return lines.Error(-1, absl::StrCat("column \"", name, "\" occurs twice"));
    }
    lines.header_.push_back(std::move(name));
  }
  return lines;
}

int CsvLines::Find(std::string_view name) const {
  const auto found = std::find(header_.begin(), header_.end(), name);
  return found == header_.end() ? -1 : static_cast<int>(found - header_.begin());
}

absl::StatusOr<bool> CsvLines::ReadLine() {
  if (!std::getline(*stream_, text_)) {
    if (stream_->bad()) {
      return absl::DataLossError(absl::StrCat(source_, ": reading failed after line ", line_));
    }
    return false;
  }
  ++line_;
  if (text_.ends_with('\r')) text_.pop_back();
  return true;
}

absl::StatusOr<bool> CsvLines::Next() {
  METAEKF_ASSIGN_OR_RETURN(bool found, ReadLine());
  if (!found) return false;
  if (text_.empty()) {
    const int64_t empty_line = line_;
    while (found && text_.empty()) {
      METAEKF_ASSIGN_OR_RETURN(found, ReadLine());
    }
    if (!found) return false;
    line_ = empty_line;
    return Error(-1, "empty line; write nan for a value that was not measured");
  }
  METAEKF_RETURN_IF_ERROR(Split());
  if (cells_.size() != header_.size()) {
    return Error(-1, absl::StrCat(cells_.size(), cells_.size() == 1 ? " cell" : " cells",
                                  ", but the header names ", header_.size()));
  }
  return true;
}

absl::Status CsvLines::Split() {
  cells_.clear();
  unquoted_.clear();
  unquoted_.reserve(text_.size());  // cells refer to it: it must not move
  std::string_view rest = text_;
  while (true) {
    const size_t comma = std::min(rest.find(','), rest.size());
    const std::string_view leading = WithoutBlanks(rest.substr(0, comma));
    if (!leading.starts_with('"')) {
      cells_.push_back(leading);
      if (comma == rest.size()) return absl::OkStatus();
      rest.remove_prefix(comma + 1);
      continue;
    }
    rest.remove_prefix(rest.find('"') + 1);
    const size_t begin = unquoted_.size();
    while (true) {
      const size_t quote = rest.find('"');
      if (quote == std::string_view::npos) return Error(-1, "a quote is not closed on its line");
      unquoted_ += rest.substr(0, quote);
      rest.remove_prefix(quote + 1);
      if (!rest.starts_with('"')) break;
      unquoted_ += '"';
      rest.remove_prefix(1);
    }
    cells_.push_back(std::string_view(unquoted_).substr(begin));
    rest = rest.substr(std::min(rest.find_first_not_of(" \t"), rest.size()));
    if (rest.empty()) return absl::OkStatus();
    if (rest.front() != ',') return Error(-1, "text follows a closing quote");
    rest.remove_prefix(1);
  }
}

absl::StatusOr<double> CsvLines::Number(int column) const {
  const std::string_view cell = cells_[column];
  if (cell.empty()) return std::numeric_limits<double>::quiet_NaN();
  const std::optional<double> number = base::ParseDouble(cell);
  if (!number) {
    return Error(column, absl::StrCat("\"", std::string(cell), "\" is not a number"));
  }
  if (std::isinf(*number)) {
    return Error(column, absl::StrCat(std::string(cell), " is not finite"));
  }
  return *number;
}

}  // namespace metaekf::data
