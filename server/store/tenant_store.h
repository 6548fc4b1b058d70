#pragma once

#include <string>

#include "server/store/adaptations.h"
#include "server/store/audit.h"
#include "server/store/context.h"
#include "server/store/jobs.h"
#include "server/store/models.h"
#include "server/store/sessions.h"

namespace metaekf::store {

/// What one tenant has, as one of its clients works with it. Nothing of another tenant can be named
/// through it. Made for a call; outlived by the store.
class TenantStore {
 public:
  explicit TenantStore(const Context& context)
      : context_(context),
        models_(context),
        adaptations_(context),
        jobs_(context),
        sessions_(context) {}

  ModelStore& models() { return models_; }
  AdaptationStore& adaptations() { return adaptations_; }
  JobStore& jobs() { return jobs_; }
  SessionStore& sessions() { return sessions_; }
  const BlobStore& blobs() const { return context_.blobs; }
  const std::string& tenant() const { return context_.tenant; }

  /// Writes down that context.identity was served with a model version or adaptation.
  absl::Status AuditUse(const std::string& action, const std::string& resource) {
    return context_.database.Write([&](Connection& connection) { return Audit(context_, connection, action, resource); });
  }

 private:
  Context context_;
  ModelStore models_;
  AdaptationStore adaptations_;
  JobStore jobs_;
  SessionStore sessions_;
};

}  // namespace metaekf::store
