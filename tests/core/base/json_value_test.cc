#include "core/base/json_value.h"

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>
#include <utility>

namespace metaekf::base {
namespace {

TEST(JsonValueTest, IsAnEmptyObjectUnlessToldOtherwise) { EXPECT_EQ(*JsonValue(), nlohmann::json::object()); }

TEST(JsonValueTest, HasItsValueStillWhenItWasMoved) {
  JsonValue value(nlohmann::json{{"seed", 3}});
  const JsonValue other = std::move(value);
  EXPECT_EQ(other->at("seed"), 3);
  EXPECT_EQ(value->at("seed"), 3);
}

}  // namespace
}  // namespace metaekf::base
