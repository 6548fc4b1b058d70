#include "server/server.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/impl/service_type.h>
#include <grpcpp/resource_quota.h>
#include <spdlog/spdlog.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <optional>
#include <thread>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/status.h"
#include "server/handlers/services.h"
#include "server/keep_warm.h"
#include "server/session/estimation_service.h"

namespace metaekf::server {
namespace {

/// HOST:PORT taken apart; HOST may be an IPv6 address in brackets.
struct Address {
  std::string host;
  int port = 0;
};

absl::StatusOr<Address> ParseAddress(const std::string& text) {
  const size_t colon = text.rfind(':');
  Address address;
  if (colon == std::string::npos || colon == 0 ||
      !absl::SimpleAtoi(text.substr(colon + 1), &address.port) || address.port < 0 ||
      address.port > 65535) {
    return absl::InvalidArgumentError(
        absl::StrCat("'", text, "' is not an address of the form HOST:PORT"));
  }
  address.host = text.substr(0, colon);
  return address;
}

bool IsLoopback(const std::string& host) {
  return host == "localhost" || host == "[::1]" || host.rfind("127.", 0) == 0;
}

absl::StatusOr<Address> CheckAddress(const ServerOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(Address address, ParseAddress(options.listen));
  if (options.insecure || IsLoopback(address.host)) return address;
  return absl::InvalidArgumentError(absl::StrCat(
      "refusing to listen on ", options.listen,
      ": connections are not encrypted yet, so others could read and change what is sent; listen "
      "on 127.0.0.1, or say --insecure on a network that you trust"));
}

size_t MemoryQuota(int64_t configured) {
  if (configured > 0) return static_cast<size_t>(configured);
  return static_cast<size_t>(sysconf(_SC_PHYS_PAGES)) / 4 *
         static_cast<size_t>(sysconf(_SC_PAGESIZE));
}

size_t ComputeThreads(size_t configured) {
  return configured > 0 ? configured : std::max(1U, std::thread::hardware_concurrency() / 2);
}

/// The defaults of gRPC are easy to exhaust from outside.
void SetLimits(const ServerOptions::Limits& limits, grpc::ServerBuilder& builder) {
  builder.SetMaxReceiveMessageSize(static_cast<int>(limits.message_bytes));
  builder.SetResourceQuota(
      grpc::ResourceQuota("metaekfd").Resize(MemoryQuota(limits.memory_bytes)));
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
  set(GRPC_ARG_KEEPALIVE_TIME_MS, 30'000);
  set(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 10'000);
  set(GRPC_ARG_KEEPALIVE_PERMIT_WITHOUT_CALLS, 1);
  set(GRPC_ARG_HTTP2_MIN_RECV_PING_INTERVAL_WITHOUT_DATA_MS, 10'000);
  // Two servers on one port would share its clients.
  set(GRPC_ARG_ALLOW_REUSEPORT, 0);
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
        access(*store, [] { return absl::Now(); }, options.require_tokens),
        context{access, *store, models, io, compute, training, jobs, options, absl::Now()},
        sessions(*store, models),
        estimation(context, sessions) {
    services.push_back(MakeModelService(context));
    services.push_back(MakeTrainingService(context));
    services.push_back(MakeAdaptationService(context));
    services.push_back(MakePredictionService(context));
    services.push_back(MakeSmoothingService(context));
    services.push_back(MakeServerService(context));
    services.push_back(MakeAdminService(context));
  }

  absl::Status Listen(const Address& address) {
    grpc::EnableDefaultHealthCheckService(true);
    grpc::reflection::InitProtoReflectionServerBuilderPlugin();
    grpc::ServerBuilder builder;
    SetLimits(options.limits, builder);
    host = address.host;
    builder.AddListeningPort(options.listen, grpc::InsecureServerCredentials(), &port);
    for (const auto& service : services) builder.RegisterService(service.get());
    builder.RegisterService(&estimation);
    grpc_server = builder.BuildAndStart();
    if (grpc_server == nullptr || port == 0) {
      return absl::FailedPreconditionError(
          absl::StrCat("cannot listen on ", options.listen,
                       ": the port is in use or not allowed; choose another with --listen"));
    }
    keep_warm.emplace(grpc_server->InProcessChannel(grpc::ChannelArguments()));
    return absl::OkStatus();
  }

  void Drain(absl::Duration timeout) {
    if (grpc_server == nullptr) return;
    const auto deadline = absl::ToChronoTime(absl::Now() + timeout);
    grpc_server->GetHealthCheckService()->SetServingStatus(false);
    keep_warm.reset();
    jobs.Close();
    std::thread checkpoints([this] { training.Stop(); });
    estimation.Drain(std::chrono::steady_clock::now() + absl::ToChronoMilliseconds(timeout / 2));
    grpc_server->Shutdown(deadline);
    checkpoints.join();
    grpc_server.reset();
  }

  size_t Queued() const { return static_cast<size_t>(options.limits.queued_calls); }

  const ServerOptions options;
  const std::unique_ptr<store::Store> store;
  ModelCache models;
  JobFeed jobs;
  TrainingScheduler training;
  BackgroundExecutor io;
  BackgroundExecutor compute;
  AccessControl access;
  const ServiceContext context;
  SessionManager sessions;
  EstimationService estimation;
  std::vector<std::unique_ptr<grpc::Service>> services;
  std::unique_ptr<grpc::Server> grpc_server;
  std::optional<KeepWarm> keep_warm;
  std::string host;
  int port = 0;
};

absl::StatusOr<std::unique_ptr<Server>> Server::Start(const ServerOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(const Address address, CheckAddress(options));
  METAEKF_ASSIGN_OR_RETURN(auto store,
                           store::Store::Open(options.data_directory, [] { return absl::Now(); }));
  auto parts = std::make_unique<Parts>(options, std::move(store));
  METAEKF_RETURN_IF_ERROR(parts->access.Reload());
  METAEKF_RETURN_IF_ERROR(parts->Listen(address));
  METAEKF_RETURN_IF_ERROR(parts->training.Start());
  return std::unique_ptr<Server>(new Server(std::move(parts)));
}

Server::Server(std::unique_ptr<Parts> parts) : parts_(std::move(parts)) {}

Server::~Server() { Drain(parts_->options.drain_timeout); }

int Server::port() const { return parts_->port; }

std::string Server::address() const { return absl::StrCat(parts_->host, ":", parts_->port); }

void Server::Drain(absl::Duration timeout) { parts_->Drain(timeout); }

}  // namespace metaekf::server
