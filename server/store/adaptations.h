#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "server/store/context.h"
#include "server/store/page.h"
#include "server/store/request_id.h"

namespace metaekf::store {

/// The adapted subset of a version's parameters; worth nothing without that version.
struct Adaptation {
  std::string id;
  std::string model;
  int64_t version = 0;
  std::string digest;  ///< SHA-256 of the file with the adapted subset
  int64_t size_bytes = 0;
  std::string receipt_json;  ///< how it was made and what it gained
  absl::Time create_time;
};

struct NewAdaptation {
  std::string id;  ///< empty: the store chooses "a1", "a2", …
  std::string model;
  int64_t version = 0;
  StagedBlob file;
  std::string receipt_json;
  RequestId request;
};

/// Adaptations. Safe to call concurrently.
/// Errors of all: InvalidArgument for an id that names.h refuses; NotFound; the database's own.
class AdaptationStore {
 public:
  explicit AdaptationStore(Context context) : context_(std::move(context)) {}

  /// Errors: NotFound if the version is gone; AlreadyExists if the id is taken or the request.id
  /// was used with another fingerprint.
  absl::StatusOr<Adaptation> Create(NewAdaptation adaptation);

  /// What `request` made before, if it did: so that a repeated request need not adapt again.
  absl::StatusOr<std::optional<Adaptation>> FindByRequest(const RequestId& request);

  absl::StatusOr<Adaptation> Get(const std::string& id);
  /// By id.
  absl::StatusOr<Page<Adaptation>> List(const PageRequest& request);
  absl::Status Delete(const std::string& id);

  /// The adapted subset. Errors: DataLoss naming the adaptation if its file is damaged or gone.
  absl::StatusOr<std::string> ReadFile(const Adaptation& adaptation);

 private:
  Context context_;
};

}  // namespace metaekf::store
