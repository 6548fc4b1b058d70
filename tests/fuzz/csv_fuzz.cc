#include <cmath>
#include <cstdlib>
#include <sstream>

#include "core/data/csv.h"

namespace {

using metaekf::data::Dataset;

bool Same(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  if (a.rows() != b.rows() || a.cols() != b.cols()) return false;
  for (Eigen::Index i = 0; i < a.size(); ++i) {
    if (!(a(i) == b(i) || (std::isnan(a(i)) && std::isnan(b(i))))) return false;
  }
  return true;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  std::istringstream stream(std::string(reinterpret_cast<const char*>(data), size));
  const auto read = metaekf::data::ReadCsv(stream, "input", {.allow_missing_outputs = true});
  if (!read.ok()) return 0;
  std::ostringstream written;
  if (!metaekf::data::WriteCsv(*read, written).ok()) return 0;  // as where only some trajectories have a period
  std::istringstream again(written.str());
  const auto reread = metaekf::data::ReadCsv(again, "written", {.allow_missing_outputs = true});
  if (!reread.ok() || reread->trajectories.size() != read->trajectories.size()) std::abort();
  for (size_t i = 0; i < read->trajectories.size(); ++i) {
    const auto &a = read->trajectories[i], &b = reread->trajectories[i];
    if (!Same(a.inputs, b.inputs) || !Same(a.outputs, b.outputs) || !Same(a.states, b.states)) std::abort();
  }
  return 0;
}
