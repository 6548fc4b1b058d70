#include "server/config/read_config.h"

#include <google/protobuf/io/tokenizer.h>
#include <google/protobuf/text_format.h>

#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "metaekf/v1/config.pb.h"
#include "server/store/files.h"

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

  void Seconds(const std::string& name, bool has, double value, absl::Duration* target) {
    constexpr double kDay = 86400;
    if (!has) return;
    if (!(value > 0 && value <= kDay)) {
      return Fail(name, absl::StrCat("is ", base::FormatExact(value),
                                     ", must be positive and at most a day"));
    }
    *target = absl::Seconds(value);
  }

  const absl::Status& status() const { return status_; }

 private:
  void Fail(const std::string& name, const std::string& what) {
    if (status_.ok()) status_ = absl::InvalidArgumentError(absl::StrCat(name, " ", what));
  }

  absl::Status status_;
};

}  // namespace

absl::Status ApplyConfig(const std::string& text, ServerOptions* options) {
  v1::ServerConfig config;
  ErrorKeeper errors;
  google::protobuf::TextFormat::Parser parser;
  parser.RecordErrorsTo(&errors);
  if (!parser.ParseFromString(text, &config)) return absl::InvalidArgumentError(errors.first());

  if (config.has_data_directory()) options->data_directory = config.data_directory();
  if (config.has_listen()) options->listen = config.listen();
  Taker taker;
  taker.Count("model_cache_bytes", config.has_model_cache_bytes(), config.model_cache_bytes(), 0,
              &options->model_cache_bytes);
  taker.Count("io_threads", config.has_io_threads(), config.io_threads(), 1, &options->io_threads);
  taker.Count("compute_threads", config.has_compute_threads(), config.compute_threads(), 0,
              &options->compute_threads);
  taker.Seconds("drain_timeout_s", config.has_drain_timeout_s(), config.drain_timeout_s(),
                &options->drain_timeout);

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

  const v1::ServerConfig::Limits& given = config.limits();
  ServerOptions::Limits& limits = options->limits;
  constexpr uint64_t kKilo = 1024;
  taker.Count("limits.memory_bytes", given.has_memory_bytes(), given.memory_bytes(), 0,
              &limits.memory_bytes);
  taker.Count("limits.message_bytes", given.has_message_bytes(), given.message_bytes(), kKilo,
              &limits.message_bytes);
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
