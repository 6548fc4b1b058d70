#include "server/handlers/server_handlers.h"

#include "core/base/status.h"
#include "server/convert/time.h"
#include "server/metrics/metrics.h"

namespace metaekf::server {

absl::Status GetServerInfo(CallContext& context, const v1::GetServerInfoRequest& request,
                           v1::ServerInfo* response) {
  // Who looks after the server sees everyone's.
  const std::string tenant = context.caller.scope == store::Scope::kAdmin ? "" : context.caller.tenant;
  METAEKF_ASSIGN_OR_RETURN(const store::Inventory inventory,
                           context.server.store.TakeInventory(tenant, request.verify_files()));
  response->set_version(METAEKF_VERSION);
  *response->mutable_start_time() = ToTimestamp(context.server.start_time);
  v1::DataDirectory& directory = *response->mutable_data_directory();
  directory.set_format_version(static_cast<uint32_t>(inventory.format_version));
  directory.set_stored_bytes(static_cast<uint64_t>(inventory.stored_bytes));
  if (tenant.empty()) {
    directory.set_free_disk_bytes(static_cast<uint64_t>(inventory.free_disk_bytes));
  }
  for (const std::string& problem : inventory.problems) directory.add_problems(problem);
  directory.set_model_count(static_cast<uint32_t>(inventory.models));
  directory.set_model_version_count(static_cast<uint32_t>(inventory.versions));
  directory.set_adaptation_count(static_cast<uint32_t>(inventory.adaptations));
  directory.set_queued_job_count(static_cast<uint32_t>(inventory.queued_jobs));
  directory.set_running_job_count(static_cast<uint32_t>(inventory.running_jobs));
  directory.set_ended_job_count(static_cast<uint32_t>(inventory.ended_jobs));
  directory.set_session_count(static_cast<uint32_t>(inventory.sessions));
  return absl::OkStatus();
}

absl::Status GetMetrics(CallContext& context, const v1::GetMetricsRequest&, v1::GetMetricsResponse* response) {
  for (const prometheus::MetricFamily& family : context.server.metrics->Collect()) {
    v1::MetricFamily& out = *response->add_families();
    out.set_name(family.name);
    out.set_help(family.help);
    for (const prometheus::ClientMetric& metric : family.metric) {
      v1::Metric& message = *out.add_metrics();
      for (const auto& label : metric.label) (*message.mutable_labels())[label.name] = label.value;
      if (family.type == prometheus::MetricType::Histogram) {
        message.mutable_histogram()->set_count(metric.histogram.sample_count);
        message.mutable_histogram()->set_sum(metric.histogram.sample_sum);
        for (const auto& bucket : metric.histogram.bucket) {
          message.mutable_histogram()->add_upper_bounds(bucket.upper_bound);
          message.mutable_histogram()->add_cumulative_counts(bucket.cumulative_count);
        }
      } else {
        message.set_value(family.type == prometheus::MetricType::Counter ? metric.counter.value : metric.gauge.value);
      }
    }
  }
  return absl::OkStatus();
}

}  // namespace metaekf::server
