#pragma once

#include <chrono>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "client/cli/console.h"

namespace metaekf::cli {

/// An object with its fields in order: what commands print.
using Record = nlohmann::ordered_json;

/// Prints a list in the format that the user asked for. As a table numbers have 4 digits; as JSON
/// (an array) and CSV they read back exactly. `columns` are the fields shown, also of an empty
/// list.
void PrintRecords(Console& console, const std::vector<std::string>& columns,
                  const std::vector<Record>& records);

/// Prints one object: as lines "field  value", a JSON object, or CSV with one row.
void PrintRecord(Console& console, const Record& record);

/// "2026-05-01T12:30:00Z"; null for Time().
Record ToRecord(std::chrono::system_clock::time_point time);

/// The value, or null.
template <typename T>
Record OrNull(const std::optional<T>& value) {
  return value ? Record(*value) : Record();
}

}  // namespace metaekf::cli
