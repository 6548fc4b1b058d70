#include "core/experiments/table.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"

namespace metaekf::experiments {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// Characters, those of several bytes counted once.
size_t Width(const std::string& text) {
  return static_cast<size_t>(std::count_if(text.begin(), text.end(),
                                           [](char c) { return (static_cast<unsigned char>(c) & 0xC0) != 0x80; }));
}

std::string Padded(const std::string& text, size_t width) {
  return text + std::string(width - std::min(width, Width(text)), ' ');
}

std::string Number(double value) {
  if (std::isfinite(value)) return base::FormatShort(value, 3);
  return std::isnan(value) ? "–" : "failed";
}

std::string CellText(const std::vector<double>& runs, const Column& column, Summary summary) {
  if (runs.empty()) return "";
  const Statistics s = Summarise(runs, column.larger_is_better);
  const bool median = summary == Summary::kMedian;
  std::string text = Number(median ? s.median : s.mean);
  if (s.runs > 1 && median) {
    absl::StrAppend(&text, " [", Number(s.lower_quartile), " – ", Number(s.upper_quartile), "]");
  }
  if (s.runs - s.failed > 1 && !median) absl::StrAppend(&text, " ± ", Number(s.standard_deviation));
  if (s.failed > 0) absl::StrAppend(&text, " (", s.failed, " of ", s.runs, " failed)");
  return text;
}

std::string Heading(const Column& column) {
  return column.unit.empty() ? column.name : absl::StrCat(column.name, " (", column.unit, ")");
}

/// A CSV field; quoted where it must be.
std::string Field(const std::string& text) {
  if (text.find_first_of(",\"\n") == std::string::npos) return text;
  std::string quoted = "\"";
  for (const char c : text) quoted += c == '"' ? std::string("\"\"") : std::string(1, c);
  return quoted + "\"";
}

}  // namespace

Statistics Summarise(const std::vector<double>& runs, bool larger_is_better) {
  Statistics s{.runs = runs.size(), .mean = kNan, .standard_deviation = kNan, .lower_quartile = kNan, .median = kNan,
               .upper_quartile = kNan};
  std::vector<double> sorted = runs;
  double sum = 0, squares = 0;
  for (double& value : sorted) {
    if (std::isfinite(value)) {
      sum += value;
      continue;
    }
    ++s.failed;
    value = larger_is_better ? -std::numeric_limits<double>::infinity() : std::numeric_limits<double>::infinity();
  }
  const size_t finite = s.runs - s.failed;
  if (finite > 0) s.mean = sum / static_cast<double>(finite);
  for (const double value : sorted) {
    if (std::isfinite(value)) squares += (value - s.mean) * (value - s.mean);
  }
  if (finite > 1) s.standard_deviation = std::sqrt(squares / static_cast<double>(finite - 1));
  if (sorted.empty()) return s;
  std::sort(sorted.begin(), sorted.end());
  s.lower_quartile = base::Quantile(sorted, 0.25);
  s.median = base::Quantile(sorted, 0.5);
  s.upper_quartile = base::Quantile(sorted, 0.75);
  return s;
}

double MeanUnlessFailed(const std::vector<double>& runs) {
  const Statistics s = Summarise(runs, false);
  return s.runs > 0 && s.failed == 0 ? s.mean : std::numeric_limits<double>::infinity();
}

std::string ToText(const Table& table) {
  std::vector<std::vector<std::string>> cells(1, {table.row_heading});
  for (const Column& column : table.columns) cells[0].push_back(Heading(column));
  for (const Row& row : table.rows) {
    cells.push_back({row.label});
    for (size_t i = 0; i < table.columns.size(); ++i) {
      cells.back().push_back(i < row.cells.size() ? CellText(row.cells[i], table.columns[i], table.summary) : "");
    }
  }
  std::vector<size_t> widths(cells[0].size(), 0);
  for (const auto& line : cells) {
    for (size_t i = 0; i < line.size(); ++i) widths[i] = std::max(widths[i], Width(line[i]));
  }
  std::string text = table.title + "\n";
  for (const auto& line : cells) {
    std::string joined;
    for (size_t i = 0; i < line.size(); ++i) absl::StrAppend(&joined, Padded(line[i], widths[i]), "  ");
    joined.erase(joined.find_last_not_of(' ') + 1);
    absl::StrAppend(&text, joined, "\n");
  }
  for (const std::string& note : table.notes) absl::StrAppend(&text, note, "\n");
  return text;
}

std::string ToCsv(const Table& table) {
  std::string csv = absl::StrCat(Field(table.row_heading),
                                 ",quantity,unit,runs,failed,mean,standard_deviation,lower_quartile,median,upper_quartile\n");
  for (const Row& row : table.rows) {
    for (size_t i = 0; i < row.cells.size() && i < table.columns.size(); ++i) {
      if (row.cells[i].empty()) continue;
      const Column& column = table.columns[i];
      const Statistics s = Summarise(row.cells[i], column.larger_is_better);
      absl::StrAppend(&csv, Field(row.label), ",", Field(column.name), ",", Field(column.unit), ",", s.runs, ",", s.failed);
      for (const double value : {s.mean, s.standard_deviation, s.lower_quartile, s.median, s.upper_quartile}) {
        absl::StrAppend(&csv, ",", base::FormatExact(value));
      }
      csv += "\n";
    }
  }
  return csv;
}

}  // namespace metaekf::experiments
