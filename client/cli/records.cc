#include "client/cli/records.h"

#include <algorithm>
#include <ctime>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/str_split.h"
#include "core/base/numbers.h"

namespace metaekf::cli {
namespace {

std::string Cell(const Record& value, bool exact) {
  if (value.is_null()) return "";
  if (value.is_string()) return value.get<std::string>();
  if (value.is_number_float()) {
    const double number = value.get<double>();
    return exact ? base::FormatExact(number) : base::FormatShort(number);
  }
  return value.dump();
}

std::string CsvCell(const Record& value) {
  const std::string text = Cell(value, true);
  if (text.find_first_of(",\"\n") == std::string::npos) return text;
  return absl::StrCat("\"", absl::StrReplaceAll(text, {{"\"", "\"\""}}), "\"");
}

/// Code points, which is how wide a text is.
size_t Width(const std::string& text) {
  return static_cast<size_t>(
      std::count_if(text.begin(), text.end(), [](char c) { return (c & 0xC0) != 0x80; }));
}

Record At(const Record& record, const std::string& column) {
  return record.contains(column) ? record[column] : Record();
}

void PrintCsv(std::ostream& out, const std::vector<std::string>& columns,
              const std::vector<Record>& records) {
  std::string text;
  for (const std::string& column : columns) absl::StrAppend(&text, column, ",");
  text.back() = '\n';
  for (const Record& record : records) {
    for (const std::string& column : columns) {
      absl::StrAppend(&text, CsvCell(At(record, column)), ",");
    }
    text.back() = '\n';
  }
  out << text;
}

void PrintTable(std::ostream& out, const std::vector<std::string>& columns,
                const std::vector<Record>& records) {
  std::vector<std::vector<std::string>> lines = {columns};
  for (const Record& record : records) {
    auto& line = lines.emplace_back();
    for (const std::string& column : columns) line.push_back(Cell(At(record, column), false));
  }
  std::vector<std::string> text(lines.size());
  for (size_t c = 0; c < columns.size(); ++c) {
    size_t width = 0;
    for (const auto& line : lines) width = std::max(width, Width(line[c]));
    const bool right = std::any_of(records.begin(), records.end(), [&](const Record& record) {
      return At(record, columns[c]).is_number();
    });
    for (size_t i = 0; i < lines.size(); ++i) {
      const std::string blanks(width - Width(lines[i][c]), ' ');
      if (c > 0) text[i] += "  ";
      text[i] += right ? blanks + lines[i][c] : lines[i][c] + blanks;
    }
  }
  for (std::string& line : text) {
    line.erase(line.find_last_not_of(' ') + 1);
    out << line << '\n';
  }
}

}  // namespace

void PrintRecords(Console& console, const std::vector<std::string>& columns,
                  const std::vector<Record>& records) {
  switch (console.format) {
    case Format::kJson:
      console.out << Record(records).dump(2) << '\n';
      return;
    case Format::kCsv:
      PrintCsv(console.out, columns, records);
      return;
    case Format::kTable:
      PrintTable(console.out, columns, records);
      return;
  }
}

void PrintRecord(Console& console, const Record& record) {
  std::vector<std::string> columns;
  size_t width = 0;
  for (const auto& [name, value] : record.items()) {
    columns.push_back(name);
    width = std::max(width, name.size());
  }
  if (console.format == Format::kJson) {
    console.out << record.dump(2) << '\n';
  } else if (console.format == Format::kCsv) {
    PrintCsv(console.out, columns, {record});
  } else {
    for (const std::string& name : columns) {
      std::string value = Cell(record[name], false);
      while (value.ends_with('\n')) value.pop_back();
      // A text of several lines stands indented below its name.
      const bool block = value.find('\n') != std::string::npos;
      if (block) value = "\n  " + absl::StrReplaceAll(value, {{"\n", "\n  "}});
      console.out << name;
      if (!value.empty() && !block) console.out << std::string(width + 2 - name.size(), ' ');
      console.out << value << '\n';
    }
  }
}

Record ToRecord(std::chrono::system_clock::time_point time) {
  if (time == std::chrono::system_clock::time_point()) return {};
  const std::time_t seconds = std::chrono::system_clock::to_time_t(time);
  std::tm utc{};
  gmtime_r(&seconds, &utc);
  char text[32];
  std::strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%SZ", &utc);
  return text;
}

}  // namespace metaekf::cli
