#pragma once

#include "server/executor/background_executor.h"
#include "server/metrics/metrics.h"
#include "server/serving/model_cache.h"
#include "server/session/session_manager.h"
#include "server/store/store.h"

namespace metaekf::server {

/// What gauges look at.
struct GaugeSources {
  store::Store& store;
  ModelCache& models;
  SessionManager& sessions;
  const BackgroundExecutor& io;
  const BackgroundExecutor& compute;
};

/// How a server stands now. Reads the store, and waits for nothing else.
Metrics::Families ServerGauges(const GaugeSources& sources);

}  // namespace metaekf::server
