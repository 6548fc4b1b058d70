#include "server/serving/model_cache.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <optional>

#include "core/base/status.h"
#include "core/nssm/model_file.h"

namespace metaekf::server {
namespace {

/// Parameters in double and in the precision that they run in, and what comes with them.
int64_t SizeBytes(const ServedModel& model) {
  constexpr int64_t kOverhead = 64 << 10;
  return kOverhead + static_cast<int64_t>(model.bundle.parameters.size()) * 16;
}

/// A stored file that was read whole but makes no sense was written by us, so it is our loss.
absl::Status AsDataLoss(const absl::Status& status, const std::string& owner) {
  if (status.ok()) return status;
  return absl::DataLossError(
      absl::StrCat(owner, ": the stored file cannot be used: ", std::string(status.message())));
}

template <class T>
void EraseExpired(std::map<std::string, std::weak_ptr<T>>& map) {
  std::erase_if(map, [](const auto& entry) { return entry.second.expired(); });
}

}  // namespace

absl::StatusOr<store::ModelVersion> ResolveTarget(store::ModelStore& models, const Target& target) {
  switch (target.kind) {
    case Target::Kind::kVersion:
      return models.GetVersion(target.model, target.version);
    case Target::Kind::kAlias:
      return models.GetByAlias(target.model, target.alias);
    default:
      return models.GetLatest(target.model);
  }
}

absl::StatusOr<ModelCache::Model> ModelCache::Get(const std::string& tenant,
                                                  const std::string& field,
                                                  const std::string& name) {
  METAEKF_ASSIGN_OR_RETURN(const Target target, ParseTarget(field, name));
  store::TenantStore store = store_.Of(tenant);
  if (target.kind == Target::Kind::kAdaptation) return GetAdaptation(store, target.adaptation);
  METAEKF_ASSIGN_OR_RETURN(const store::ModelVersion version, ResolveTarget(store.models(), target));
  return GetVersion(store, version);
}

ModelCache::Loaded ModelCache::GetVersion(store::TenantStore& store,
                                          const store::ModelVersion& version) {
  const std::string name = VersionName(version.model, version.version);
  return GetOrLoad(absl::StrCat(store.tenant(), "/", name), [&]() -> Loaded {
    METAEKF_ASSIGN_OR_RETURN(const std::string bytes, store.models().ReadFile(version));
    auto bundle = nssm::ReadModelFile(bytes);
    METAEKF_RETURN_IF_ERROR(AsDataLoss(bundle.status(), name));
    return Serve(*std::move(bundle), store.tenant(), name, "", nullptr);
  });
}

ModelCache::Loaded ModelCache::GetAdaptation(store::TenantStore& store, const std::string& id) {
  METAEKF_ASSIGN_OR_RETURN(const store::Adaptation adaptation, store.adaptations().Get(id));
  const std::string name = AdaptationName(id);
  // An id may be deleted and given to another adaptation, unlike the number of a version.
  const std::string key = absl::StrCat(store.tenant(), "/", name, "@", adaptation.digest, "@",
                                       VersionName(adaptation.model, adaptation.version));
  return GetOrLoad(key, [&]() -> Loaded {
    METAEKF_ASSIGN_OR_RETURN(const store::ModelVersion version,
                             store.models().GetVersion(adaptation.model, adaptation.version));
    METAEKF_ASSIGN_OR_RETURN(const Model base, GetVersion(store, version));
    METAEKF_ASSIGN_OR_RETURN(const std::string bytes, store.adaptations().ReadFile(adaptation));
    nssm::Bundle bundle = base->bundle;
    METAEKF_RETURN_IF_ERROR(AsDataLoss(nssm::ApplyAdaptedSubset(bytes, &bundle), name));
    return Serve(std::move(bundle), store.tenant(), base->model_version, name, base);
  });
}

template <class Load>
ModelCache::Loaded ModelCache::GetOrLoad(const std::string& key, const Load& load) {
  std::promise<Loaded> promise;
  std::optional<std::shared_future<Loaded>> others;
  {
    std::lock_guard lock(mutex_);
    if (const auto known = known_.find(key); known != known_.end()) {
      if (const Model model = known->second.lock()) {
        Keep(model);
        return model;
      }
    }
    if (const auto loading = loading_.find(key); loading != loading_.end()) {
      others = loading->second;
    } else {
      loading_[key] = promise.get_future().share();
    }
  }
  if (others) return others->get();
  const Loaded loaded = load();
  {
    std::lock_guard lock(mutex_);
    loading_.erase(key);
    EraseExpired(known_);
    EraseExpired(filter_models_);
    if (loaded.ok()) {
      known_[key] = *loaded;
      Keep(*loaded);
    }
  }
  promise.set_value(loaded);
  return loaded;
}

ModelCache::Loaded ModelCache::Serve(nssm::Bundle bundle, const std::string& tenant,
                                     const std::string& version, const std::string& adaptation,
                                     const Model& base) {
  auto model = std::make_shared<ServedModel>(ServedModel{.bundle = std::move(bundle)});
  model->filter_model = FilterModelOf(model->bundle, tenant, version);
  // What an adaptation leaves as it was is kept once.
  const bool shares = base != nullptr && base->filter_model == model->filter_model;
  model->filter_parameters = model->filter_model->Prepare(model->bundle, shares ? base->filter_parameters.get() : nullptr);
  model->model_version = version;
  model->adaptation = adaptation;
  return model;
}

std::shared_ptr<const filter::FilterModel> ModelCache::FilterModelOf(const nssm::Bundle& bundle,
                                                                    const std::string& tenant,
                                                                    const std::string& version) {
  // A fitted start takes the version's prior into the filter model.
  const nssm::ModelSpec& spec = bundle.model.spec();
  const std::string owner = spec.fits_start() ? absl::StrCat(tenant, "/", version) : "";
  const std::string architecture = absl::StrCat(owner, nssm::ToJson(spec).dump());
  const auto find = [&]() -> std::shared_ptr<const filter::FilterModel> {
    const auto found = filter_models_.find(architecture);
    return found == filter_models_.end() ? nullptr : found->second.lock();
  };
  {
    std::lock_guard lock(mutex_);
    if (auto found = find()) return found;
  }
  std::shared_ptr<const filter::FilterModel> made = filter::FilterModel::Create(bundle);
  std::lock_guard lock(mutex_);
  if (auto found = find()) return found;
  filter_models_[architecture] = made;
  return made;
}

void ModelCache::Keep(const Model& model) {
  const auto found = std::find(recent_.begin(), recent_.end(), model);
  if (found != recent_.end()) {
    recent_.splice(recent_.begin(), recent_, found);
    return;
  }
  recent_.push_front(model);
  recent_bytes_ += SizeBytes(*model);
  while (recent_bytes_ > budget_bytes_ && recent_.size() > 1) {
    recent_bytes_ -= SizeBytes(*recent_.back());
    recent_.pop_back();
  }
}

void ModelCache::Forget(const std::string& tenant, const std::string& name) {
  const std::string key = absl::StrCat(tenant, "/", name), of_adaptation = key + "@";
  std::lock_guard lock(mutex_);
  for (const auto& [known, held] : known_) {
    if (known != key && known.rfind(of_adaptation, 0) != 0) continue;
    const auto kept = std::find(recent_.begin(), recent_.end(), held.lock());
    if (kept == recent_.end()) continue;
    recent_bytes_ -= SizeBytes(**kept);
    recent_.erase(kept);
  }
}

ModelCache::Resident ModelCache::resident() {
  std::lock_guard lock(mutex_);
  Resident resident{.kept_bytes = recent_bytes_};
  for (const auto& [key, model] : known_) resident.models += !model.expired();
  return resident;
}

}  // namespace metaekf::server
