#include "server/status/grpc_status.h"

#include <spdlog/spdlog.h>

#include "google/rpc/status.pb.h"
#include "server/status/text.h"

namespace metaekf::server {
namespace {

// At worst a message is percent-encoded (× 3) and the details, which repeat it, are in base 64.
constexpr size_t kMaxMessageBytes = 600;
constexpr size_t kMaxDetailsBytes = 3584;
constexpr std::string_view kDetailPrefix = "type.googleapis.com/google.rpc.";

bool IsServersFault(absl::StatusCode code) {
  return code == absl::StatusCode::kInternal || code == absl::StatusCode::kUnknown;
}

std::string MessageForClients(const absl::Status& status) {
  if (IsServersFault(status.code())) return "internal error; the server's log says more";
  const std::string_view message(status.message().data(), status.message().size());
  return TextForClients(message, kMaxMessageBytes);
}

}  // namespace

grpc::Status ToGrpcStatus(const absl::Status& status) {
  if (status.ok()) return grpc::Status::OK;
  if (IsServersFault(status.code()) || status.code() == absl::StatusCode::kDataLoss) {
    spdlog::error("{}", status.ToString(absl::StatusToStringMode::kWithNoExtraData));
  }

  google::rpc::Status rich;
  rich.set_code(static_cast<int>(status.code()));
  rich.set_message(MessageForClients(status));
  status.ForEachPayload([&](absl::string_view type_url, const absl::Cord& payload) {
    const bool ours = type_url.substr(0, kDetailPrefix.size()) ==
                      absl::string_view(kDetailPrefix.data(), kDetailPrefix.size());
    if (!ours || rich.ByteSizeLong() + payload.size() > kMaxDetailsBytes) return;
    auto* detail = rich.add_details();
    detail->set_type_url(std::string(type_url));
    detail->set_value(std::string(payload));
  });
  // The codes of absl and gRPC are the same numbers, by design of both.
  return grpc::Status(static_cast<grpc::StatusCode>(status.code()), rich.message(),
                      rich.SerializeAsString());
}

}  // namespace metaekf::server
