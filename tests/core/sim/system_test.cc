#include "core/sim/system.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include "core/sim/simulate.h"

namespace metaekf::sim {
namespace {

using ::testing::HasSubstr;

System Example() {
  System system;
  system.name = "example";
  system.parameters = {{"mass", "kg", 1, 2, 1.5, ""}, {"length", "m", 0, 1, 0.5, ""}};
  system.options = {{.name = "kind", .default_value = "fast", .choices = {"fast", "slow"}},
                    {.name = "count", .default_value = "3", .min = 0, .max = 10, .whole = true}};
  return system;
}

std::string ErrorOf(const std::map<std::string, std::string>& values) {
  const auto settings = Settings::Check(Example(), values);
  EXPECT_EQ(settings.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(settings.status().message());
}

TEST(SystemTest, SettingsFallBackToDefaults) {
  const auto settings = Settings::Check(Example(), {{"length", "7e-1"}, {"kind", "slow"}});
  ASSERT_TRUE(settings.ok()) << settings.status();
  EXPECT_FALSE(settings->FixedParameter(0).has_value());
  EXPECT_EQ(settings->FixedParameter(1), 0.7);
  EXPECT_EQ(settings->Choice("kind"), "slow");
  EXPECT_TRUE(settings->IsSet("kind"));
  EXPECT_EQ(settings->Number("count"), 3);
  EXPECT_FALSE(settings->IsSet("count"));
}

TEST(SystemTest, RefusesBadSettings) {
  EXPECT_EQ(ErrorOf({{"mas", "1"}}),
            "example has no \"mas\"; its parameters are mass, length; its options kind, count");
  EXPECT_EQ(ErrorOf({{"mass", "heavy"}}), "mass=heavy: a number is needed");
  EXPECT_EQ(ErrorOf({{"mass", "nan"}}), "mass=nan: a number is needed");
  EXPECT_EQ(ErrorOf({{"kind", "quick"}}), "kind=quick is none of fast, slow");
  EXPECT_EQ(ErrorOf({{"count", "11"}}), "count=11 is not between 0 and 10");
  EXPECT_EQ(ErrorOf({{"count", "2.5"}}), "count=2.5: a whole number is needed");
  EXPECT_EQ(ErrorOf({{"count", "inf"}}), "count=inf: a number is needed");
}

TEST(SystemTest, EveryFamilyDescribesItselfSoundly) {
  for (const System* system : Systems()) {
    EXPECT_FALSE(system->description.empty());
    EXPECT_FALSE(system->default_length.empty());
    EXPECT_GT(system->sample_period_s, 0);
    std::set<std::string> names;
    std::map<std::string, std::string> defaults;
    for (const Parameter& parameter : system->parameters) {
      EXPECT_TRUE(names.insert(parameter.name).second) << parameter.name;
      EXPECT_LT(parameter.min, parameter.max) << parameter.name;
      EXPECT_GE(parameter.nominal, parameter.min) << parameter.name;
      EXPECT_LE(parameter.nominal, parameter.max) << parameter.name;
      EXPECT_FALSE(parameter.description.empty()) << parameter.name;
    }
    for (const Option& option : system->options) {
      EXPECT_TRUE(names.insert(option.name).second) << option.name;
      EXPECT_FALSE(option.description.empty()) << option.name;
      defaults[option.name] = option.default_value;
    }
    EXPECT_TRUE(names.contains("nominal"));
    // One for all outputs, or one for each kind of them.
    EXPECT_TRUE(std::any_of(names.begin(), names.end(), [](const std::string& name) { return name.ends_with("noise_std"); }));
    EXPECT_TRUE(Settings::Check(*system, defaults).ok()) << "a default is not legal";
  }
}

TEST(SystemTest, NoticesThatAStateLeftTheFiniteNumbers) {
  data::Trajectory trajectory;
  trajectory.sample_period_s = 0.5;
  trajectory.states = Eigen::MatrixXd::Zero(2, 9);
  EXPECT_TRUE(CheckStayedFinite(trajectory).ok());
  trajectory.states(1, 4) = std::numeric_limits<double>::infinity();
  // Sample 4 stands at 2 s.
  EXPECT_THAT(std::string(CheckStayedFinite(trajectory).message()), HasSubstr("before 2 s"));
}

}  // namespace
}  // namespace metaekf::sim
