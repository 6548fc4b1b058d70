#pragma once

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"

/// Returns from the enclosing function if `expression` (an absl::Status) is an error.
#define METAEKF_RETURN_IF_ERROR(expression)             \
  do {                                                  \
    if (absl::Status status_ = (expression); !status_.ok()) return status_; \
  } while (false)

/// Assigns the value of `expression` (an absl::StatusOr) to `target`, or returns its error.
#define METAEKF_ASSIGN_OR_RETURN(target, expression) \
  METAEKF_ASSIGN_OR_RETURN_IMPL_(METAEKF_CONCAT_(status_or_, __LINE__), target, expression)

#define METAEKF_CONCAT_INNER_(a, b) a##b
#define METAEKF_CONCAT_(a, b) METAEKF_CONCAT_INNER_(a, b)
#define METAEKF_ASSIGN_OR_RETURN_IMPL_(result, target, expression) \
  auto result = (expression);                                      \
  if (!result.ok()) return std::move(result).status();             \
  target = *std::move(result)

namespace metaekf::base {

/// `status` with `context` put before its message: "FILE:12: <message>".
inline absl::Status Annotate(const absl::Status& status, const std::string& context) {
  if (status.ok()) return status;
  return absl::Status(status.code(), absl::StrCat(context, ": ", status.message()));
}

}  // namespace metaekf::base
