#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "server/store/context.h"
#include "server/store/page.h"
#include "server/store/request_id.h"

namespace metaekf::store {

struct ModelVersion {
  std::string model;
  int64_t version = 0;  ///< from 1 up, never given twice
  std::string digest;   ///< SHA-256 of the model file
  int64_t size_bytes = 0;
  std::string metadata_json;  ///< what a list tells of the version without opening its file
  absl::Time create_time;
};

struct Alias {
  std::string alias;
  int64_t version = 0;
};

struct Model {
  std::string name;
  int64_t latest_version = 0;
  int64_t version_count = 0;
  absl::Time create_time;  ///< of its oldest version
  std::vector<Alias> aliases;
};

/// Models and their versions, which never change once they are listed. A model is there while it
/// has a version. Safe to call concurrently.
///
/// Errors of all: InvalidArgument for a name that names.h refuses; NotFound; the database's own.
class ModelStore {
 public:
  explicit ModelStore(Context context) : context_(std::move(context)) {}

  /// Adds a version to a model, which is made if there is none yet; all or nothing.
  /// Errors: AlreadyExists if request.id was used with another fingerprint; those of quota.h.
  absl::StatusOr<ModelVersion> AddVersion(const std::string& model, StagedBlob file,
                                          const std::string& metadata_json,
                                          const RequestId& request = {});

  absl::StatusOr<Model> Get(const std::string& model);
  /// By name.
  absl::StatusOr<Page<Model>> List(const PageRequest& request);

  absl::StatusOr<ModelVersion> GetVersion(const std::string& model, int64_t version);
  absl::StatusOr<ModelVersion> GetLatest(const std::string& model);
  absl::StatusOr<ModelVersion> GetByAlias(const std::string& model, const std::string& alias);
  /// Newest first.
  absl::StatusOr<Page<ModelVersion>> ListVersions(const std::string& model,
                                                  const PageRequest& request);

  /// The model file. Errors: DataLoss naming the version if the file is damaged or gone.
  absl::StatusOr<std::string> ReadFile(const ModelVersion& version);

  /// Points an alias at a version, whether or not the alias existed.
  absl::Status SetAlias(const std::string& model, const std::string& alias, int64_t version);
  absl::Status DeleteAlias(const std::string& model, const std::string& alias);

  /// Errors: FailedPrecondition naming an alias or adaptation that still needs the version.
  absl::Status DeleteVersion(const std::string& model, int64_t version);

 private:
  Context context_;
};

/// Adds a version within a write transaction, for those who add more to it.
absl::StatusOr<ModelVersion> InsertVersion(const Context& context, Connection& connection,
                                           const std::string& model, StagedBlob& file,
                                           const std::string& metadata_json);

}  // namespace metaekf::store
