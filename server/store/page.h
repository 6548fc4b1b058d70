#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace metaekf::store {

/// Which page of a list: at most `page_size` items (0: 50, more than 1000: 1000) after what the
/// token of the page before says (empty: from the start).
struct PageRequest {
  int32_t page_size = 0;
  std::string page_token;
};

/// A page, and the token of the next one (empty: that was the last). A token says which item came
/// last, so that items made or deleted in between make no other item appear twice or never.
template <class T>
struct Page {
  std::vector<T> items;
  std::string next_page_token;
};

/// A PageRequest understood.
struct PageCursor {
  int64_t size;
  std::string after;  ///< key of the last item of the page before; empty: from the start
};

/// Of a list with the highest number first: only numbers below this one come on the page.
int64_t NumberLimit(const PageCursor& cursor);

/// `list` names the list, so that a token works for no other.
/// Errors: InvalidArgument for a negative size or a token that was not given for this list.
absl::StatusOr<PageCursor> ParsePage(const std::string& list, const PageRequest& request);

/// The token for what follows the item with key `last`.
std::string MakePageToken(const std::string& list, const std::string& last);

/// Turns `items`, of which one more than fits was asked for, into a page.
/// @param key  gives an item's key in the order of the list.
template <class T, class Key>
Page<T> MakePage(const std::string& list, const PageCursor& cursor, std::vector<T> items, Key key) {
  Page<T> page{std::move(items), ""};
  if (static_cast<int64_t>(page.items.size()) > cursor.size) {
    page.items.resize(static_cast<size_t>(cursor.size));
    page.next_page_token = MakePageToken(list, key(page.items.back()));
  }
  return page;
}

}  // namespace metaekf::store
