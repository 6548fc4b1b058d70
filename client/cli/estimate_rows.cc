#include "client/cli/estimate_rows.h"

#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"

namespace metaekf::cli {
namespace {

void AppendCell(double value, std::string& line) {
  if (!std::isnan(value)) line += base::FormatExact(value);
  line += ',';
}

}  // namespace

std::string EstimateHeader(const std::vector<client::Channel>& estimated, bool states,
                           bool constrained) {
  std::string header = "t";
  for (const auto& channel : estimated) {
    absl::StrAppend(&header, ",", channel.name, states ? "" : "_hat");
  }
  for (const auto& channel : estimated) absl::StrAppend(&header, ",s", channel.name);
  return absl::StrCat(header, ",nis,health,flags", constrained ? ",slack,projection" : "", "\n");
}

std::string EstimateRow(const client::EstimateBatch& batch, size_t i) {
  std::string line;
  AppendCell(batch.times_s[i], line);
  const size_t n = batch.means.size() / batch.samples;
  for (size_t k = 0; k < n; ++k) AppendCell(batch.means[i * n + k], line);
  for (size_t k = 0; k < n; ++k) AppendCell(std::sqrt(batch.covariances[i * n + k]), line);
  AppendCell(batch.nis[i], line);
  absl::StrAppend(&line, HealthWord(batch.health[i]), ",", FlagWords(batch.flags[i]));
  if (batch.slacks.size() == batch.samples) {
    line += ',';
    AppendCell(batch.slacks[i], line);
    AppendCell(batch.projections[i], line);
    line.pop_back();
  }
  return line + "\n";
}

const char* HealthWord(client::Health health) {
  switch (health) {
    case client::Health::kWarmingUp:
      return "warming_up";
    case client::Health::kConsistent:
      return "consistent";
    case client::Health::kOverconfident:
      return "overconfident";
    case client::Health::kUnderconfident:
      return "underconfident";
    case client::Health::kDiverged:
      return "diverged";
    case client::Health::kUnknown:
      break;
  }
  return "";
}

std::string FlagWords(uint32_t flags) {
  constexpr std::pair<client::Flag, const char*> kWords[] = {
      {client::kMissing, "missing"}, {client::kGated, "gated"}, {client::kProjected, "projected"},
      {client::kDelayed, "delayed"}, {client::kReset, "reset"}, {client::kAdapted, "adapted"}};
  std::string words;
  for (const auto& [flag, word] : kWords) {
    if (flags & flag) absl::StrAppend(&words, words.empty() ? "" : "|", word);
  }
  return words;
}

}  // namespace metaekf::cli
