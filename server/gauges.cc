#include "server/gauges.h"

#include <spdlog/spdlog.h>

#include "absl/strings/str_cat.h"
#include "server/convert/jobs.h"

namespace metaekf::server {
namespace {

using store::Usage;

/// One gauge a tenant.
prometheus::MetricFamily OfTenants(const std::string& name, const std::string& help,
                                   const std::map<std::string, Usage>& usages, int64_t Usage::*count) {
  std::vector<Gauge> gauges;
  for (const auto& [tenant, usage] : usages) gauges.push_back({tenant, static_cast<double>(usage.*count)});
  return MakeGauges(name, help, "tenant", gauges);
}

void AddUsage(store::Store& store, Metrics::Families* families) {
  const auto usages = store.TakeUsage();
  if (!usages.ok()) {
    spdlog::error("no metrics of what tenants have: {}", usages.status().ToString());
    return;
  }
  families->push_back(OfTenants("metaekf_sessions", "Sessions stored", *usages, &Usage::sessions));
  families->push_back(OfTenants("metaekf_adaptations", "Adaptations stored", *usages, &Usage::adaptations));
  families->push_back(OfTenants("metaekf_model_versions", "Versions of models stored", *usages, &Usage::versions));
  families->push_back(
      OfTenants("metaekf_stored_bytes", "Model files and adaptations stored", *usages, &Usage::stored_bytes));
  families->push_back(OfTenants("metaekf_queued_jobs", "Training jobs that wait", *usages, &Usage::queued_jobs));
  families->push_back(OfTenants("metaekf_running_jobs", "Training jobs that run", *usages, &Usage::running_jobs));
}

void AddJobs(store::Store& store, Metrics::Families* families) {
  const auto running = store.job_queue().ListRunning();
  if (!running.ok()) return;  // which AddUsage has told
  std::vector<Gauge> progress;
  for (const store::JobQueue::Claimed& claimed : *running) {
    const v1::TrainingProgress told = ToMessage(claimed.job).progress();
    if (told.iterations() == 0) continue;
    progress.push_back({absl::StrCat(claimed.lease.tenant, "/", claimed.job.number),
                        static_cast<double>(told.iteration()) / told.iterations()});
  }
  families->push_back(MakeGauges("metaekf_job_progress_ratio", "Outer iterations done, of each job that runs", "job", progress));
}

}  // namespace

Metrics::Families ServerGauges(const GaugeSources& sources) {
  Metrics::Families families;
  AddUsage(sources.store, &families);
  AddJobs(sources.store, &families);
  std::vector<Gauge> streaming;
  for (const auto& [tenant, count] : sources.sessions.CountStreaming()) {
    streaming.push_back({tenant, static_cast<double>(count)});
  }
  families.push_back(MakeGauges("metaekf_streaming_sessions", "Sessions that a stream has open", "tenant", streaming));
  families.push_back(MakeGauges("metaekf_checkpoint_lag_seconds", "How long applied samples wait to become durable", "",
                                {{"", absl::ToDoubleSeconds(sources.sessions.CheckpointLag())}}));
  const ModelCache::Resident resident = sources.models.resident();
  families.push_back(MakeGauges("metaekf_resident_models", "Models in memory", "", {{"", static_cast<double>(resident.models)}}));
  families.push_back(MakeGauges("metaekf_model_cache_bytes", "Models in memory that nobody need be using", "",
                                {{"", static_cast<double>(resident.kept_bytes)}}));
  families.push_back(MakeGauges("metaekf_queued_calls", "Calls that wait for a thread", "threads",
                                {{"io", static_cast<double>(sources.io.queued())},
                                 {"compute", static_cast<double>(sources.compute.queued())}}));
  return families;
}

}  // namespace metaekf::server
