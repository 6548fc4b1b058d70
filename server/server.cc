#include "server/server.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/impl/service_type.h>
#include <grpcpp/resource_quota.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <chrono>
#include <optional>
#include <thread>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "core/base/status.h"
#include "server/access/exposure.h"
#include "server/gauges.h"
#include "server/handlers/call_record.h"
#include "server/handlers/services.h"
#include "server/keep_warm.h"
#include "server/metrics/metrics_port.h"
#include "server/session/estimation_service.h"
#include "server/tls_credentials.h"

namespace metaekf::server {
namespace {

size_t ComputeThreads(size_t configured) {
  return configured > 0 ? configured : std::max(1U, std::thread::hardware_concurrency() / 2);
}

constexpr absl::Duration kFarewell = absl::Milliseconds(500);

/// The defaults of gRPC are easy to exhaust from outside.
void SetLimits(const ServerOptions::Limits& limits, grpc::ServerBuilder& builder) {
  builder.SetMaxReceiveMessageSize(static_cast<int>(limits.message_bytes));
  builder.SetResourceQuota(
      grpc::ResourceQuota("metaekfd").Resize(static_cast<size_t>(limits.memory_bytes)));
  // A small compressed message could become a very large one.
  builder.SetCompressionAlgorithmSupportStatus(GRPC_COMPRESS_GZIP, false);
  builder.SetCompressionAlgorithmSupportStatus(GRPC_COMPRESS_DEFLATE, false);
  const auto set = [&builder](const char* name, int64_t value) {
    builder.AddChannelArgument(name, static_cast<int>(value));
  };
  set(GRPC_ARG_MAX_METADATA_SIZE, limits.metadata_bytes);
  set(GRPC_ARG_MAX_CONCURRENT_STREAMS, limits.streams_per_connection);
  // Without it the window, and with it what a connection may hold, does not grow.
  set(GRPC_ARG_HTTP2_BDP_PROBE, 0);
  // Four megabytes at a time come in faster than those who send too much are cut off.
  set(GRPC_ARG_TCP_MAX_READ_CHUNK_SIZE, 256 << 10);
  set(GRPC_ARG_KEEPALIVE_TIME_MS, 30'000);
  set(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 10'000);
  set(GRPC_ARG_KEEPALIVE_PERMIT_WITHOUT_CALLS, 1);
  set(GRPC_ARG_HTTP2_MIN_RECV_PING_INTERVAL_WITHOUT_DATA_MS, 10'000);
  // Two servers on one port would share its clients.
  set(GRPC_ARG_ALLOW_REUSEPORT, 0);
}

absl::StatusOr<std::shared_ptr<grpc::ServerCredentials>> MakeCredentials(
    const ServerOptions::Security& security) {
  if (security.certificate_file.empty()) return grpc::InsecureServerCredentials();
  return TlsCredentials({security.certificate_file, security.key_file, security.client_ca_file});
}

}  // namespace

/// Declared in the order in which they depend on those before.
class Server::Parts {
 public:
  Parts(const ServerOptions& given, std::unique_ptr<store::Store> opened)
      : options(given),
        store(std::move(opened)),
        models(*store, options.model_cache_bytes),
        training(*store, jobs, options),
        io({.threads = options.io_threads, .max_queued = Queued()}),
        compute({.threads = ComputeThreads(options.compute_threads),
                 .max_queued = Queued(),
                 .gives_way = true}),
        access(*store, [] { return absl::Now(); }, options.security),
        samples(options.limits.sample_bytes),
        context{access, *store, models, io, compute, training, jobs, options, absl::Now(), metrics, live_calls, samples},
        sessions(*store, models, metrics, options.sessions.checkpoint_period),
        estimation(context, sessions) {
    metrics->AddGauges([this] {
      return ServerGauges({*store, models, sessions, io, compute});
    });
    metrics->AddGauges(ProcessMetrics);
    services.push_back(MakeModelService(context));
    services.push_back(MakeTrainingService(context));
    services.push_back(MakeAdaptationService(context));
    services.push_back(MakePredictionService(context));
    services.push_back(MakeSmoothingService(context));
    services.push_back(MakeServerService(context));
    services.push_back(MakeAdminService(context));
  }

  absl::Status ListenForMetrics() {
    if (options.metrics_listen.empty()) return absl::OkStatus();
    METAEKF_ASSIGN_OR_RETURN(metrics_port, MetricsPort::Open(options.metrics_listen, metrics));
    return absl::OkStatus();
  }

  absl::Status Listen(const Address& address) {
    // Debian builds Abseil without NDEBUG: each lock in gRPC would ask a graph of all locks for cycles, behind one spin lock for the whole
    // process; the graph grows, and a cycle that it believes in ends the process.
    absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
    grpc::EnableDefaultHealthCheckService(true);
    grpc::reflection::InitProtoReflectionServerBuilderPlugin();
    grpc::ServerBuilder builder;
    SetLimits(options.limits, builder);
    if (!options.security.certificate_file.empty()) {
      // A connection keeps the certificates that it began with. Its streams may take as long as they like.
      builder.AddChannelArgument(GRPC_ARG_MAX_CONNECTION_AGE_MS,
                                 static_cast<int>(absl::ToInt64Milliseconds(options.security.max_connection_age)));
    }
    host = address.host;
    builder.AddListeningPort(options.listen, credentials, &port);
    for (const auto& service : services) builder.RegisterService(service.get());
    builder.RegisterService(&estimation);
    grpc_server = builder.BuildAndStart();
    if (grpc_server == nullptr || port == 0) {
      return absl::FailedPreconditionError(
          absl::StrCat("cannot listen on ", options.listen,
                       ": the port is in use or not allowed; choose another with --listen"));
    }
    for (const char* service : {"ModelService", "TrainingService", "AdaptationService", "PredictionService",
                                "SmoothingService", "EstimationService", "ServerService", "AdminService"}) {
      grpc_server->GetHealthCheckService()->SetServingStatus(absl::StrCat("metaekf.v1.", service), true);
    }
    keep_warm.emplace(grpc_server->InProcessChannel(grpc::ChannelArguments()));
    return absl::OkStatus();
  }

  void Drain(absl::Duration timeout) {
    if (grpc_server == nullptr) return;
    const absl::Time deadline = absl::Now() + timeout;
    grpc_server->GetHealthCheckService()->SetServingStatus(false);
    keep_warm.reset();
    jobs.Close();
    std::thread checkpoints([this] { training.Stop(); });
    std::thread last_scrape([this] { metrics_port.reset(); });  // takes two seconds
    estimation.Drain(std::chrono::steady_clock::now() + absl::ToChronoMilliseconds(timeout / 2));
    live_calls.WaitForNone(deadline);
    // What a client says after its last call is waited for, a moment: one that is idle may never say it.
    grpc_server->Shutdown(absl::ToChronoTime(std::min(deadline, absl::Now() + kFarewell)));
    checkpoints.join();
    last_scrape.join();
    grpc_server.reset();
  }

  size_t Queued() const { return static_cast<size_t>(options.limits.queued_calls); }

  const ServerOptions options;
  const std::unique_ptr<store::Store> store;
  const std::shared_ptr<Metrics> metrics = std::make_shared<Metrics>();
  ModelCache models;
  JobFeed jobs;
  TrainingScheduler training;
  BackgroundExecutor io;
  BackgroundExecutor compute;
  AccessControl access;
  LiveCalls live_calls;
  SampleBudget samples;
  const ServiceContext context;
  SessionManager sessions;
  EstimationService estimation;
  std::vector<std::unique_ptr<grpc::Service>> services;
  std::shared_ptr<grpc::ServerCredentials> credentials;  // which are asked at each handshake
  std::unique_ptr<grpc::Server> grpc_server;
  std::optional<KeepWarm> keep_warm;
  std::unique_ptr<MetricsPort> metrics_port;
  std::string host;
  int port = 0;
};

absl::StatusOr<std::unique_ptr<Server>> Server::Start(const ServerOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(const Address address, CheckExposure(options));
  METAEKF_ASSIGN_OR_RETURN(auto credentials, MakeCredentials(options.security));
  METAEKF_ASSIGN_OR_RETURN(auto store,
                           store::Store::Open(options.data_directory, [] { return absl::Now(); }, options.quotas));
  auto parts = std::make_unique<Parts>(options, std::move(store));
  parts->credentials = std::move(credentials);
  METAEKF_RETURN_IF_ERROR(parts->access.Reload());
  METAEKF_RETURN_IF_ERROR(parts->ListenForMetrics());
  METAEKF_RETURN_IF_ERROR(parts->Listen(address));
  METAEKF_RETURN_IF_ERROR(parts->training.Start());
  return std::unique_ptr<Server>(new Server(std::move(parts)));
}

Server::Server(std::unique_ptr<Parts> parts) : parts_(std::move(parts)) {}

Server::~Server() { Drain(parts_->options.drain_timeout); }

int Server::port() const { return parts_->port; }

std::string Server::address() const { return absl::StrCat(parts_->host, ":", parts_->port); }

int Server::metrics_port() const {
  return parts_->metrics_port == nullptr ? 0 : parts_->metrics_port->port();
}

void Server::Drain(absl::Duration timeout) { parts_->Drain(timeout); }

}  // namespace metaekf::server
