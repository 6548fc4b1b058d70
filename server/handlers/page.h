#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "server/status/details.h"
#include "server/store/page.h"

namespace metaekf::server {

/// The page of a list that a request wants.
/// @param list  takes a store::PageRequest and returns a StatusOr<store::Page>.
/// Errors: InvalidArgument with a violation of page_size or page_token; those of `list`.
template <class Request, class List>
auto ListPage(const Request& request, const List& list) -> decltype(list(store::PageRequest())) {
  if (request.page_size() < 0) return FieldViolation("page_size", "must not be negative");
  auto page = list(store::PageRequest{request.page_size(), request.page_token()});
  if (absl::IsInvalidArgument(page.status())) {
    return FieldViolation("page_token", std::string(page.status().message()));
  }
  return page;
}

}  // namespace metaekf::server
