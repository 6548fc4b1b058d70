#pragma once

#include <memory>

#include "server/access/access_control.h"
#include "server/convert/sample_budget.h"
#include "server/executor/background_executor.h"
#include "server/options.h"
#include "server/serving/model_cache.h"
#include "server/store/store.h"
#include "server/training/job_feed.h"
#include "server/training/scheduler.h"

namespace metaekf::server {

class LiveCalls;
class Metrics;

/// What the services work with; all of it outlives them.
struct ServiceContext {
  AccessControl& access;
  store::Store& store;
  ModelCache& models;
  BackgroundExecutor& io;       ///< SQL and files
  BackgroundExecutor& compute;  ///< adaptation and prediction
  TrainingScheduler& training;
  JobFeed& jobs;
  const ServerOptions& options;
  absl::Time start_time;
  std::shared_ptr<Metrics> metrics;
  LiveCalls& live_calls;
  SampleBudget& samples;
};

}  // namespace metaekf::server
