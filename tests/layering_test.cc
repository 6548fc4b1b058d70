#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <initializer_list>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"

// Reads every include of the project against the rule: client → proto ← server → core, the client library never sees core, and
// inside core only downwards.
namespace metaekf {
namespace {

namespace fs = std::filesystem;

// Folders of core from bottom to top: a folder may include those of lower levels only, and itself.
const std::map<std::string, int> kCoreLevel = {{"base", 0}, {"linalg", 0}, {"autodiff", 1}, {"data", 1}, {"plot", 1},
                                               {"nn", 2},   {"sim", 2},      {"physics", 3}, {"nssm", 4},
                                               {"filter", 5}, {"meta", 6},   {"experiments", 7}};

std::vector<std::string> Parts(const std::string& path) {
  std::vector<std::string> parts;
  for (const fs::path& part : fs::path(path)) parts.push_back(part.string());
  return parts;
}

/// The path that a line of source includes, less its quotes or brackets; empty if it includes nothing.
absl::string_view Included(absl::string_view line) {
  line = absl::StripLeadingAsciiWhitespace(line);
  if (!absl::ConsumePrefix(&line, "#")) return {};
  line = absl::StripLeadingAsciiWhitespace(line);
  if (!absl::ConsumePrefix(&line, "include")) return {};
  line = absl::StripLeadingAsciiWhitespace(line);
  return line.empty() ? line : line.substr(1, line.find_last_of("\">") - 1);
}

bool StartsWithAny(absl::string_view path, std::initializer_list<absl::string_view> prefixes) {
  return std::any_of(prefixes.begin(), prefixes.end(), [path](absl::string_view prefix) { return absl::StartsWith(path, prefix); });
}

bool IsAllowed(const std::vector<std::string>& from, const std::vector<std::string>& to) {
  const std::string &source = from[0], &target = to[0];
  if (source == "core") {
    if (target != "core") return false;
    if (from[1] == to[1]) return true;
    return kCoreLevel.count(from[1]) != 0 && kCoreLevel.count(to[1]) != 0 && kCoreLevel.at(to[1]) < kCoreLevel.at(from[1]);
  }
  if (source == "server") return target == "server" || target == "core";
  if (source == "client") {
    const bool command_line = from[1] == "cli" || from[1] == "examples";
    return target == "client" || (target == "core" && command_line);
  }
  return true;  // tests see all
}

TEST(LayeringTest, EveryIncludeFollowsTheRule) {
  int includes = 0;
  for (const std::string top : {"core", "server", "client"}) {
    for (const fs::directory_entry& entry : fs::recursive_directory_iterator(fs::path(METAEKF_SOURCE_DIR) / top)) {
      const std::string extension = entry.path().extension().string();
      if (extension != ".h" && extension != ".cc") continue;
      const std::string file = fs::relative(entry.path(), METAEKF_SOURCE_DIR).string();
      std::ifstream stream(entry.path());
      std::string line;
      while (std::getline(stream, line)) {
        const std::string included(Included(line));
        if (StartsWithAny(included, {"core/", "server/", "client/"})) {
          ++includes;
          EXPECT_TRUE(IsAllowed(Parts(file), Parts(included))) << file << ": " << line;
        }
        EXPECT_FALSE(top == "core" && StartsWithAny(included, {"metaekf/v1/", "grpc", "google/protobuf"})) << file << ": " << line;
      }
    }
  }
  EXPECT_GT(includes, 100);
}

TEST(LayeringTest, EveryFolderOfCoreHasALevelAndAReadme) {
  for (const fs::directory_entry& entry : fs::directory_iterator(fs::path(METAEKF_SOURCE_DIR) / "core")) {
    if (!entry.is_directory()) continue;
    EXPECT_TRUE(kCoreLevel.count(entry.path().filename().string())) << entry.path();
    EXPECT_TRUE(fs::exists(entry.path() / "README.md")) << entry.path();
  }
}

}  // namespace
}  // namespace metaekf
