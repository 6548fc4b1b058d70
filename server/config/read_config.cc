#include "server/config/read_config.h"

#include <google/protobuf/io/tokenizer.h>
#include <google/protobuf/text_format.h>

#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "metaekf/v1/config.pb.h"
#include "server/convert/scope.h"
#include "server/store/files.h"
#include "server/store/names.h"

namespace metaekf::server {
namespace {

/// Keeps the first error.
class ErrorKeeper final : public google::protobuf::io::ErrorCollector {
 public:
  void AddError(int line, int column, const std::string& message) override {
    if (first_.empty()) first_ = absl::StrCat(line + 1, ":", column + 1, ": ", message);
  }
  const std::string& first() const { return first_; }

 private:
  std::string first_;
};

/// Takes fields over that are there and in range; keeps the first that is not.
class Taker {
 public:
  template <class T>
  void Count(const std::string& name, bool has, uint64_t value, uint64_t low, T* target) {
    constexpr uint64_t kHigh = std::numeric_limits<int64_t>::max();
    if (!has) return;
    if (value < low || value > kHigh) {
      return Fail(name, absl::StrCat("is ", value, ", must be at least ", low));
    }
    *target = static_cast<T>(value);
  }

  /// @param may_be_zero  which means never.
  void Seconds(const std::string& name, bool has, double value, absl::Duration* target, bool may_be_zero = false) {
    constexpr double kDay = 86400;
    if (!has) return;
    if (!((value > 0 || (may_be_zero && value == 0)) && value <= kDay)) {
      return Fail(name, absl::StrCat("is ", base::FormatExact(value), ", must be positive", may_be_zero ? ", or 0 for never," : "",
                                     " and at most a day"));
    }
    *target = absl::Seconds(value);
  }

  const absl::Status& status() const { return status_; }

  void Fail(const std::string& name, const std::string& what) {
    if (status_.ok()) status_ = absl::InvalidArgumentError(absl::StrCat(name, " ", what));
  }

 private:
  absl::Status status_;
};

absl::StatusOr<ServerOptions::Security::Client> ToClient(const v1::ServerConfig::Security::Client& given) {
  if (given.certificate_name().empty()) return absl::InvalidArgumentError("certificate_name is missing");
  METAEKF_RETURN_IF_ERROR(store::CheckName("tenant", given.tenant()));
  const absl::StatusOr<store::Scope> scope = ToScope(given.scope());
  if (!scope.ok()) return base::Annotate(scope.status(), "scope");
  return ServerOptions::Security::Client{given.certificate_name(), given.tenant(), *scope};
}

void ApplySecurity(const v1::ServerConfig::Security& given, Taker& taker,
                   ServerOptions::Security* security) {
  if (given.has_certificate_file()) security->certificate_file = given.certificate_file();
  if (given.has_key_file()) security->key_file = given.key_file();
  if (given.has_client_ca_file()) security->client_ca_file = given.client_ca_file();
  if (given.has_require_tokens()) security->require_tokens = given.require_tokens();
  for (int c = 0; c < given.clients_size(); ++c) {
    const auto client = ToClient(given.clients(c));
    if (!client.ok()) {
      taker.Fail(absl::StrCat("security.clients[", c, "]:"), std::string(client.status().message()));
    } else {
      security->clients.push_back(*client);
    }
  }
  for (const std::string& proxy : given.proxies()) security->proxies.push_back(proxy);
  taker.Seconds("security.max_connection_age_s", given.has_max_connection_age_s(),
                given.max_connection_age_s(), &security->max_connection_age);
}

void ApplyQuotas(const v1::ServerConfig& config, Taker& taker, store::Quotas* quotas) {
  for (int q = 0; q < config.quotas_size(); ++q) {
    const v1::ServerConfig::Quota& given = config.quotas(q);
    const std::string name = absl::StrCat("quotas[", q, "]");
    if (given.has_tenant()) {
      const absl::Status named = store::CheckName("tenant", given.tenant());
      if (!named.ok()) taker.Fail(name + ":", std::string(named.message()));
    }
    store::Quota& quota = given.has_tenant() ? quotas->by_tenant[given.tenant()] : quotas->others;
    taker.Count(name + ".sessions", given.has_sessions(), given.sessions(), 0, &quota.sessions);
    taker.Count(name + ".adaptations", given.has_adaptations(), given.adaptations(), 0, &quota.adaptations);
    taker.Count(name + ".stored_bytes", given.has_stored_bytes(), given.stored_bytes(), 0, &quota.stored_bytes);
    taker.Count(name + ".queued_jobs", given.has_queued_jobs(), given.queued_jobs(), 0, &quota.queued_jobs);
    taker.Count(name + ".running_jobs", given.has_running_jobs(), given.running_jobs(), 0, &quota.running_jobs);
    if (!given.has_samples_per_s()) continue;
    if (given.samples_per_s() > 0) {
      quota.samples_per_s = given.samples_per_s();
    } else {
      taker.Fail(name + ".samples_per_s",
                 absl::StrCat("is ", base::FormatExact(given.samples_per_s()), ", must be positive"));
    }
  }
}

}  // namespace

absl::Status ApplyConfig(const std::string& text, ServerOptions* options) {
  v1::ServerConfig config;
  ErrorKeeper errors;
  google::protobuf::TextFormat::Parser parser;
  parser.RecordErrorsTo(&errors);
  if (!parser.ParseFromString(text, &config)) return absl::InvalidArgumentError(errors.first());

  if (config.has_data_directory()) options->data_directory = config.data_directory();
  if (config.has_listen()) options->listen = config.listen();
  if (config.has_metrics_listen()) options->metrics_listen = config.metrics_listen();
  Taker taker;
  taker.Count("model_cache_bytes", config.has_model_cache_bytes(), config.model_cache_bytes(), 0,
              &options->model_cache_bytes);
  taker.Count("io_threads", config.has_io_threads(), config.io_threads(), 1, &options->io_threads);
  taker.Count("compute_threads", config.has_compute_threads(), config.compute_threads(), 0,
              &options->compute_threads);
  taker.Seconds("drain_timeout_s", config.has_drain_timeout_s(), config.drain_timeout_s(),
                &options->drain_timeout);

  ApplySecurity(config.security(), taker, &options->security);
  ApplyQuotas(config, taker, &options->quotas);

  const v1::ServerConfig::Training& training = config.training();
  ServerOptions::Training& jobs = options->training;
  taker.Count("training.concurrent_jobs", training.has_concurrent_jobs(),
              training.concurrent_jobs(), 1, &jobs.concurrent_jobs);
  taker.Count("training.threads_per_job", training.has_threads_per_job(),
              training.threads_per_job(), 0, &jobs.threads_per_job);
  taker.Count("training.max_queued_jobs", training.has_max_queued_jobs(),
              training.max_queued_jobs(), 1, &jobs.max_queued_jobs);
  taker.Seconds("training.checkpoint_period_s", training.has_checkpoint_period_s(),
                training.checkpoint_period_s(), &jobs.checkpoint_period);

  taker.Seconds("sessions.checkpoint_period_s", config.sessions().has_checkpoint_period_s(), config.sessions().checkpoint_period_s(),
                &options->sessions.checkpoint_period, /*may_be_zero=*/true);

  const v1::ServerConfig::Limits& given = config.limits();
  ServerOptions::Limits& limits = options->limits;
  constexpr uint64_t kKilo = 1024, kLeastMemory = 8 << 20;
  taker.Count("limits.memory_bytes", given.has_memory_bytes(), given.memory_bytes(), kLeastMemory,
              &limits.memory_bytes);
  taker.Count("limits.message_bytes", given.has_message_bytes(), given.message_bytes(), kKilo,
              &limits.message_bytes);
  taker.Count("limits.batch_bytes", given.has_batch_bytes(), given.batch_bytes(), kKilo,
              &limits.batch_bytes);
  taker.Count("limits.sample_bytes", given.has_sample_bytes(), given.sample_bytes(), kKilo,
              &limits.sample_bytes);
  taker.Count("limits.metadata_bytes", given.has_metadata_bytes(), given.metadata_bytes(), kKilo,
              &limits.metadata_bytes);
  taker.Count("limits.streams_per_connection", given.has_streams_per_connection(),
              given.streams_per_connection(), 1, &limits.streams_per_connection);
  taker.Count("limits.model_file_bytes", given.has_model_file_bytes(), given.model_file_bytes(),
              kKilo, &limits.model_file_bytes);
  taker.Count("limits.dataset_bytes", given.has_dataset_bytes(), given.dataset_bytes(), kKilo,
              &limits.dataset_bytes);
  taker.Count("limits.samples_per_call", given.has_samples_per_call(), given.samples_per_call(), 1,
              &limits.samples_per_call);
  taker.Count("limits.queued_calls", given.has_queued_calls(), given.queued_calls(), 1,
              &limits.queued_calls);
  return taker.status();
}

absl::Status ReadConfigFile(const std::string& path, ServerOptions* options) {
  auto text = store::ReadFile(path);
  METAEKF_RETURN_IF_ERROR(base::Annotate(text.status(), path));
  return base::Annotate(ApplyConfig(*text, options), path);
}

}  // namespace metaekf::server
