#include "tests/benchmark/report.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>

namespace metaekf::benchmark {

double Quantile(std::vector<double> values, double share) {
  if (values.empty()) return std::nan("");
  const auto at = values.begin() + static_cast<std::ptrdiff_t>(std::ceil(share * static_cast<double>(values.size())) - 1);
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

double Median(std::vector<double> values) { return Quantile(std::move(values), 0.5); }

void Print(const std::string& title, const std::vector<Row>& rows) {
  const auto cell = [](double value, int width, int digits) {
    if (std::isnan(value)) {
      std::printf(" %*s", width, "");
    } else {
      std::printf(" %*.*g", width, digits, value);
    }
  };
  std::printf("%-58s %12s %12s %8s\n", title.c_str(), "metaekf", "peer", "ratio");
  for (const Row& row : rows) {
    std::printf("%-58s", (row.what + (row.unit.empty() ? "" : ", " + row.unit)).c_str());
    cell(row.ours, 12, 4);
    cell(row.peer, 12, 4);
    cell(row.ratio, 8, 3);
    std::printf("\n");
  }
  std::fflush(stdout);
}

bool AddToJson(const std::string& path, const std::vector<Row>& rows) {
  nlohmann::json all;
  if (std::ifstream before(path); before) all = nlohmann::json::parse(before, nullptr, /*allow_exceptions=*/false);
  if (!all.is_object()) all = {{"ratios", nlohmann::json::object()}, {"figures", nlohmann::json::array()}};
  for (const Row& row : rows) {  // what is NaN is written as null
    all["figures"].push_back({{"what", row.what}, {"unit", row.unit}, {"metaekf", row.ours}, {"peer", row.peer}, {"ratio", row.ratio}});
    if (!row.key.empty()) all["ratios"][row.key] = row.ratio;
  }
  std::ofstream file(path);
  file << all.dump(2) << "\n";
  return static_cast<bool>(file.flush());
}

}  // namespace metaekf::benchmark
