#pragma once

#include <cstdint>
#include <future>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <string>

#include "absl/status/statusor.h"
#include "core/filter/filter_model.h"
#include "core/nssm/bundle.h"
#include "server/names/resource_names.h"
#include "server/store/store.h"

namespace metaekf::server {

/// A model ready for use. Immutable.
struct ServedModel {
  nssm::Bundle bundle;  ///< with the adapted parameters, if it is adapted
  std::shared_ptr<const filter::FilterModel> filter_model;  ///< shared by equal architectures
  std::shared_ptr<const filter::FilterModel::Parameters> filter_parameters;
  std::string model_version;  ///< models/{model}/versions/{version}
  std::string adaptation;     ///< adaptations/{adaptation}; empty: as meta-trained
};

/// The version that a target which is no adaptation means now. Errors: NotFound.
absl::StatusOr<store::ModelVersion> ResolveTarget(store::ModelStore& models, const Target& target);

/// Loads models and adaptations from the store when they are asked for, and keeps those used last.
///
/// Every call looks up what the name means now; contents are cached by digest, so that an answer is
/// never older than the store. What is asked for while it loads is loaded once. Models that someone
/// still holds are found again also when they no longer fit the budget. Safe to call concurrently;
/// calls block on disk and on compiling a new architecture, so make them on a background executor.
class ModelCache {
 public:
  using Model = std::shared_ptr<const ServedModel>;

  /// @param budget_bytes  of the models that only the cache holds; the latest stays in any case.
  ModelCache(store::Store& store, int64_t budget_bytes)
      : store_(store), budget_bytes_(budget_bytes) {}

  /// @param target  models/{model}, …/versions/{version}, …/aliases/{alias} or
  /// adaptations/{adaptation}.
  /// @param tenant  whose it is.
  /// @param field   of the request, for the violation if the name has another form.
  /// Errors: InvalidArgument; NotFound; DataLoss if a stored file is damaged.
  absl::StatusOr<Model> Get(const std::string& tenant, const std::string& field,
                            const std::string& target);

  /// Keeps a version or adaptation no longer, since it is deleted; who holds it has it still.
  /// @param name  models/{model}/versions/{version} or adaptations/{adaptation}.
  void Forget(const std::string& tenant, const std::string& name);

  /// Models in memory, whoever holds them.
  struct Resident {
    int64_t models = 0;
    int64_t kept_bytes = 0;  ///< of those kept by the cache
  };
  Resident resident();

 private:
  using Loaded = absl::StatusOr<Model>;

  Loaded GetVersion(store::TenantStore& store, const store::ModelVersion& version);
  Loaded GetAdaptation(store::TenantStore& store, const std::string& id);
  /// From the cache, from whoever loads it now, or by `load`.
  template <class Load>
  Loaded GetOrLoad(const std::string& key, const Load& load);
  /// @param base  that the bundle is adapted from, or null.
  Loaded Serve(nssm::Bundle bundle, const std::string& tenant, const std::string& version,
               const std::string& adaptation, const Model& base);
  std::shared_ptr<const filter::FilterModel> FilterModelOf(const nssm::Bundle& bundle,
                                                          const std::string& tenant,
                                                          const std::string& version);
  void Keep(const Model& model);  // with mutex_ held

  store::Store& store_;
  const int64_t budget_bytes_;

  std::mutex mutex_;
  std::map<std::string, std::weak_ptr<const ServedModel>> known_;
  std::map<std::string, std::shared_future<Loaded>> loading_;
  std::list<Model> recent_;  // the latest first
  int64_t recent_bytes_ = 0;
  std::map<std::string, std::weak_ptr<const filter::FilterModel>> filter_models_;
};

}  // namespace metaekf::server
