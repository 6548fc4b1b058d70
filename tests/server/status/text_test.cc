#include "server/status/text.h"

#include <gtest/gtest.h>

namespace metaekf::server {
namespace {

constexpr size_t kPlenty = 1000;

TEST(TextForClientsTest, HidesAbsolutePaths) {
  EXPECT_EQ(TextForClients("cannot open /var/lib/metaekf/blobs/ab: No such file", kPlenty),
            "cannot open [path]: No such file");
  EXPECT_EQ(TextForClients("/data", kPlenty), "[path]");
  EXPECT_EQ(TextForClients("file '/a/b c' (/d)", kPlenty), "file '[path] c' ([path])");
}

TEST(TextForClientsTest, KeepsWhatIsNoPath) {
  for (const char* text : {"models/robot/versions/3", "1.5 m/s", "a / b",
                           "see https://example.org/x", "ends in /", "ψ⁺ = 𝓐(ψ)"}) {
    EXPECT_EQ(TextForClients(text, kPlenty), text);
  }
}

// The second row on: RFC 3629, sections 3 and 4 (stray continuation, overlong '/', surrogate, above
// U+10FFFF, cut short).
TEST(TextForClientsTest, ReplacesBytesThatAreNotUtf8) {
  EXPECT_EQ(TextForClients("caf\xE9 au lait", kPlenty), "caf? au lait");
  EXPECT_EQ(TextForClients("\x80", kPlenty), "?");
  EXPECT_EQ(TextForClients("\xC0\xAF", kPlenty), "??");
  EXPECT_EQ(TextForClients("\xED\xA0\x80", kPlenty), "???");
  EXPECT_EQ(TextForClients("\xF4\x90\x80\x80", kPlenty), "????");
  EXPECT_EQ(TextForClients("\xE2\x82", kPlenty), "??");
}

TEST(TextForClientsTest, CutsBetweenCharacters) {
  EXPECT_EQ(TextForClients("abcdef", 4), "abcd");
  EXPECT_EQ(TextForClients("abcψ", 4), "abc");  // ψ takes two bytes
  EXPECT_EQ(TextForClients("abcψ", 5), "abcψ");
}

}  // namespace
}  // namespace metaekf::server
