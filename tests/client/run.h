#pragma once

#include <algorithm>
#include <fstream>
#include <iterator>
#include <sstream>
#include <string>
#include <vector>

#include "client/cli/app.h"
#include "gtest/gtest.h"

namespace metaekf::testing {

/// How a run of the command line ended.
struct Outcome {
  int status;
  std::string out, err;
};

/// Runs `metaekf arguments` with `input` as standard input; its errors go to no terminal.
inline Outcome RunMetaekf(const std::vector<std::string>& arguments,
                          const std::string& input = "") {
  std::istringstream in(input);
  std::ostringstream out, err;
  cli::Console console(in, out, err, false);
  const int status = cli::Run(arguments, console);
  return {status, out.str(), err.str()};
}

/// A path for this test alone.
inline std::string TempPath(const std::string& name) {
  const auto* test = ::testing::UnitTest::GetInstance()->current_test_info();
  std::string owner = std::string(test->test_suite_name()) + "_" + test->name();
  std::replace(owner.begin(), owner.end(), '/', '_');  // of a parametrised test
  return ::testing::TempDir() + "metaekf_" + owner + "_" + name;
}

/// Writes a file for this test and gives its path.
inline std::string TempFile(const std::string& name, const std::string& text) {
  const std::string path = TempPath(name);
  std::ofstream(path, std::ios::binary) << text;
  return path;
}

inline std::string Contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace metaekf::testing
