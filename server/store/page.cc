#include "server/store/page.h"

#include <algorithm>
#include <limits>

#include "absl/strings/escaping.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "server/store/sha256.h"

namespace metaekf::store {
namespace {

constexpr int64_t kDefaultPageSize = 50;
constexpr int64_t kMaxPageSize = 1000;
constexpr size_t kCheckLength = 8;

/// Tells tokens of this list from others and from what someone made up. Not a secret.
std::string Check(const std::string& list, const std::string& last) {
  return Sha256Hex(absl::StrCat(list, "\n", last)).substr(0, kCheckLength);
}

}  // namespace

absl::StatusOr<PageCursor> ParsePage(const std::string& list, const PageRequest& request) {
  if (request.page_size < 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("page_size is ", request.page_size, ", must not be negative"));
  }
  const int64_t size = request.page_size == 0 ? kDefaultPageSize
                                              : std::min<int64_t>(request.page_size, kMaxPageSize);
  if (request.page_token.empty()) return PageCursor{size, ""};
  std::string text;
  if (!absl::WebSafeBase64Unescape(request.page_token, &text) || text.size() < kCheckLength ||
      text.substr(0, kCheckLength) != Check(list, text.substr(kCheckLength))) {
    return absl::InvalidArgumentError(
        "page_token is not one that this list gave; leave it out to start again");
  }
  return PageCursor{size, text.substr(kCheckLength)};
}

int64_t NumberLimit(const PageCursor& cursor) {
  int64_t limit = 0;
  if (cursor.after.empty() || !absl::SimpleAtoi(cursor.after, &limit)) {
    return std::numeric_limits<int64_t>::max();
  }
  return limit;
}

std::string MakePageToken(const std::string& list, const std::string& last) {
  return absl::WebSafeBase64Escape(Check(list, last) + last);
}

}  // namespace metaekf::store
