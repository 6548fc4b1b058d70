#include <cmath>

#include "absl/synchronization/mutex.h"
#include "client/src/impl.h"
#include "client/src/text_proto.h"

namespace metaekf::client {
namespace {

using std::chrono::steady_clock;
using std::chrono::system_clock;

constexpr std::chrono::seconds kSecondChance(2);  // of a connection, the backoff before it included
constexpr std::chrono::milliseconds kFresh(5);    // no server is restarted within this: a connection is taken for alive
constexpr std::chrono::milliseconds kLook(1);

grpc::ChannelArguments Arguments() {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, 100);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, 2'000);
  // Finds half-open connections; servers end clients that ping more often than every 10 s.
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, 25'000);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 10'000);
  arguments.SetInt(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);
  // Else all clients of a process share one connection, and its limit of streams.
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  // A server on this machine or network is not behind the proxy that the environment may name.
  arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);
  // gRPC 1.51 repeats a call whose connection ended before it was sent, but fails its first write all the same, and all
  // later ones: such a stream is half open for good, and waits for ever.
  arguments.SetInt(GRPC_ARG_ENABLE_RETRIES, 0);
  arguments.SetMaxReceiveMessageSize(16 << 20);
  return arguments;
}

std::shared_ptr<grpc::ChannelCredentials> Credentials(const std::optional<Tls>& tls) {
  if (!tls) return grpc::InsecureChannelCredentials();
  return grpc::SslCredentials({tls->authorities, tls->key, tls->certificate});
}

std::shared_ptr<grpc::Channel> MakeChannel(const Options& options) {
  // See README.md.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  return grpc::CreateCustomChannel(options.server, Credentials(options.tls), Arguments());
}

}  // namespace

Client::Impl::Impl(const Options& client_options)
    : options(client_options),
      channel(MakeChannel(options)),
      server(v1::ServerService::NewStub(channel)),
      models(v1::ModelService::NewStub(channel)),
      training(v1::TrainingService::NewStub(channel)),
      adaptations(v1::AdaptationService::NewStub(channel)),
      predictions(v1::PredictionService::NewStub(channel)),
      estimation(v1::EstimationService::NewStub(channel)),
      smoothing(v1::SmoothingService::NewStub(channel)),
      admin(v1::AdminService::NewStub(channel)) {}

Status Client::Impl::Translate(const grpc::Status& status) const {
  Status result = FromGrpc(status);
  if (status.error_details().empty()) {
    // gRPC cancels calls that reach a server while it ends, and some where its buffers are full.
    const bool reset = result.message.find("RST_STREAM") != std::string::npos;
    if (result.code == Code::kCancelled || (result.code == Code::kResourceExhausted && reset)) result.code = Code::kUnavailable;
  }
  if (result.code == Code::kUnavailable && status.error_details().empty()) {
    // Errors of gRPC itself, not of the server.
    const bool unresolved = result.message.find("resolution failed") != std::string::npos;
    const bool refused = result.message.find("Connection refused") != std::string::npos;
    const bool never_connected = result.message.find("failed to connect") != std::string::npos;
    if (never_connected && !refused && !unresolved) {
      // A server may well be there: say what gRPC says.
      result.reason = "NO_CONNECTION";
      result.message = "cannot connect to " + options.server + " (" + result.message + ")";
    } else if (unresolved || refused) {
      result.reason = "NO_SERVER";
      result.message = "no server at " + options.server +
                       (unresolved ? ", an address that cannot be resolved" : "");
    } else {
      result.reason = "CONNECTION_LOST";
      result.message = "the connection to " + options.server + " was lost (" + result.message + ")";
    }
    result.metadata["server"] = options.server;
  }
  if (result.code == Code::kDeadlineExceeded) {
    result.message = options.server + " did not answer within " +
                     std::to_string(std::lround(options.timeout_s)) + " s";
  }
  if (result.code == Code::kUnimplemented) {
    result.message = "what answers at " + options.server +
                     " is no metaekf server, or one of another version (" + result.message + ")";
  }
  return result;
}

void Client::Impl::Connect() const {
  const auto deadline = system_clock::now() + std::chrono::microseconds(std::llround(1e6 * options.timeout_s));
  auto state = channel->GetState(true);
  const auto now = steady_clock::now().time_since_epoch();
  // gRPC looks at its connection while it waits for something only.
  if (state == GRPC_CHANNEL_READY && now - last_call.load() > kFresh &&
      channel->WaitForStateChange(state, system_clock::now() + kLook)) {
    state = channel->GetState(true);
  }
  last_call = now;
  while (state == GRPC_CHANNEL_IDLE || state == GRPC_CHANNEL_CONNECTING) {
    if (!channel->WaitForStateChange(state, deadline)) return;
    state = channel->GetState(true);
  }
  if (state != GRPC_CHANNEL_TRANSIENT_FAILURE) return;
  grpc::ClientContext context;
  SetDeadline(context);
  Authorise(context);
  v1::ServerInfo info;
  const Status why = Translate(server->GetServerInfo(&context, v1::GetServerInfoRequest(), &info));
  if (why.reason == "NO_CONNECTION") channel->WaitForStateChange(state, system_clock::now() + kSecondChance);
}

void Client::Impl::SetDeadline(grpc::ClientContext& context) const {
  context.set_deadline(system_clock::now() +
                       std::chrono::microseconds(std::llround(1e6 * options.timeout_s)));
}

void Client::Impl::Authorise(grpc::ClientContext& context) const {
  if (!options.token.empty()) context.AddMetadata("authorization", "Bearer " + options.token);
}

Client::Client(const Options& options) : impl_(std::make_shared<Impl>(options)) {}
Client::~Client() = default;
Client::Client(Client&&) noexcept = default;
Client& Client::operator=(Client&&) noexcept = default;

const std::string& Client::server() const { return impl_->options.server; }

Result<ServerInfo> Client::GetServerInfo(bool verify_files) {
  v1::GetServerInfoRequest request;
  request.set_verify_files(verify_files);
  v1::ServerInfo response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->server, &v1::ServerService::Stub::GetServerInfo, request, &response));
  return FromProto(response);
}

Result<NoiseSettings> ParseNoiseSettings(const std::string& text, const std::string& source) {
  v1::NoiseSettings message;
  METAEKF_CLIENT_RETURN_IF_ERROR(ParseText(text, source, &message));
  return FromProto(message);
}

}  // namespace metaekf::client
