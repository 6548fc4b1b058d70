#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/time/time.h"
#include "server/store/quota.h"
#include "server/store/scope.h"

namespace metaekf::server {

/// How a server runs. deploy/metaekfd.textproto says what each means; zero where that says so.
struct ServerOptions {
  std::string data_directory;
  std::string listen = "127.0.0.1:50051";
  std::string metrics_listen;  ///< of Prometheus' metrics; empty: nowhere
  bool insecure = false;  ///< listens beyond loopback whatever `security` says

  int64_t model_cache_bytes = int64_t{512} << 20;
  size_t io_threads = 4;
  size_t compute_threads = 0;  ///< 0: half the cores, at least 1
  absl::Duration drain_timeout = absl::Seconds(10);

  struct Security {
    std::string certificate_file;  ///< and key_file; empty: nothing is encrypted
    std::string key_file;
    std::string client_ca_file;   ///< clients must show a certificate that one of these signed
    bool require_tokens = false;  ///< every call must show a bearer token
    struct Client {
      std::string certificate_name;
      std::string tenant;
      store::Scope scope = store::Scope::kRead;
    };
    std::vector<Client> clients;       ///< who may call with a certificate alone
    std::vector<std::string> proxies;  ///< addresses that connections are taken from; empty: any
    absl::Duration max_connection_age = absl::Hours(1);
  } security;

  store::Quotas quotas;

  struct Training {
    size_t concurrent_jobs = 1;
    size_t threads_per_job = 0;  ///< 0: one per core
    size_t max_queued_jobs = 100;
    absl::Duration checkpoint_period = absl::Seconds(5);
    std::string worker_binary = "/proc/self/exe";
  } training;

  struct Sessions {
    absl::Duration checkpoint_period = absl::Milliseconds(100);  ///< 0: only at the end of a stream or the server
  } sessions;

  struct Limits {
    int64_t memory_bytes = int64_t{48} << 20;  ///< of gRPC's buffers
    int64_t message_bytes = int64_t{4} << 20;
    int64_t batch_bytes = int64_t{16} << 20;  ///< of batches and answers that streams hold
    int64_t metadata_bytes = int64_t{16} << 10;
    int64_t streams_per_connection = 1024;
    int64_t model_file_bytes = int64_t{256} << 20;
    int64_t dataset_bytes = int64_t{8} << 30;
    int64_t sample_bytes = int64_t{1} << 30;  ///< of recordings, and what is computed from them, over all calls
    int64_t samples_per_call = 16'000'000;  ///< of an adaptation or prediction
    int64_t queued_calls = 1024;
  } limits;
};

}  // namespace metaekf::server
