#include "server/store/names.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace metaekf::store {
namespace {

using ::testing::HasSubstr;

std::string Message(const absl::Status& status) { return std::string(status.message()); }

TEST(NamesTest, TakesNamesOfThePattern) {
  for (const std::string& name :
       {std::string("a"), std::string("7"), std::string("van-der_pol2"), std::string(63, 'x')}) {
    EXPECT_TRUE(CheckName("model name", name).ok()) << name;
  }
}

TEST(NamesTest, RefusesOthersAndSaysWhat) {
  for (const std::string& name :
       {std::string(""), std::string("-a"), std::string("_a"), std::string("A"), std::string("a b"),
        std::string("a/b"), std::string(".."), std::string("a\0b", 3), std::string("é"),
        std::string(64, 'x')}) {
    const absl::Status status = CheckName("model name", name);
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << name;
    EXPECT_THAT(Message(status), HasSubstr("model name '" + name + "'"));
  }
}

TEST(NamesTest, AnAliasStartsWithALetter) {
  EXPECT_TRUE(CheckAlias("stable").ok());
  EXPECT_EQ(CheckAlias("3").code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(CheckAlias("").code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::store
