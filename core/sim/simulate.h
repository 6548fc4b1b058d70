#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/csv.h"
#include "core/data/trajectory.h"
#include "core/sim/system.h"

namespace metaekf::sim {

/// All families, in the order in which help lists them. To add one, write its file beside
/// van_der_pol.cc and name it in simulate.cc.
const std::vector<const System*>& Systems();

/// The family called `name`. Errors: NotFound, with the names that exist.
absl::StatusOr<const System*> FindSystem(const std::string& name);

/// What `metaekf simulate` asks for.
struct Request {
  std::string system;
  int64_t systems = 1;
  uint64_t seed = 0;
  std::optional<int64_t> steps;                 ///< samples recorded of each
  std::map<std::string, std::string> settings;  ///< parameters to fix and options, NAME → VALUE
  std::optional<data::Table> parameters;        ///< one row per system, columns named as parameters
  std::optional<RecordedInput> input;
};

/// Puts "NAME=VALUE" into `settings`. Errors: InvalidArgument without a name or "=", or for a name
/// that is there already.
absl::Status AddSetting(const std::string& text, std::map<std::string, std::string>& settings);

struct Fleet {
  data::Dataset dataset;   ///< trajectories "0", "1", …
  data::Table parameters;  ///< those used: one row per system, a column for each of the family's
};

using OnSystem = std::function<bool(int64_t done)>;

/// Draws a fleet of similar systems and simulates each.
///
/// System i takes everything random from its own stream (seed, i), parameters first and always all
/// of them: it depends neither on the number of systems nor on which parameters are fixed. A
/// parameter is, in this order, what `settings` fixes, its column in `parameters`, its nominal
/// value if nominal=1, uniform on its range.
///
/// Errors: NotFound for an unknown family; InvalidArgument for settings that it refuses, fewer than
/// one system or step, a table with a column that is not a parameter, one that is fixed by a
/// setting too or another number of rows than systems, an input that is empty, not finite, of other
/// channels or of another sample period than the family's, and whatever the family itself refuses,
/// with the system's number; Cancelled if on_system said so.
/// @param on_system  called after each system with how many are done, in one thread at a time; false stops. May be empty.
absl::StatusOr<Fleet> Simulate(const Request& request, base::Executor& executor, const OnSystem& on_system = nullptr);

}  // namespace metaekf::sim
