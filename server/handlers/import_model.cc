#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/nssm/model_file.h"
#include "server/convert/models.h"
#include "server/handlers/model_handlers.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

using Request = v1::ImportModelVersionRequest;

constexpr size_t kMaxChunkBytes = size_t{1} << 20;

bool IsDigest(const std::string& text) {
  return text.size() == 64 && text.find_first_not_of("0123456789abcdef") == std::string::npos;
}

class Import final : public StreamHandler<Request, v1::ModelVersion> {
 public:
  explicit Import(CallContext context) : context_(std::move(context)) {}

  absl::Status OnRequest(Request& request, ResponseSink<v1::ModelVersion>&) override {
    if (!has_header_) return TakeHeader(request);
    if (!request.has_chunk()) {
      return FieldViolation("chunk", "is missing: after the header come chunks only");
    }
    if (request.chunk().size() > kMaxChunkBytes) {
      return FieldViolation("chunk", absl::StrCat("has ", request.chunk().size(),
                                                  " bytes, at most ", kMaxChunkBytes));
    }
    if (file_.size() + request.chunk().size() > header_.size_bytes()) return WrongSize("more than");
    file_ += request.chunk();
    return absl::OkStatus();
  }

  absl::Status OnEnd(ResponseSink<v1::ModelVersion>& sink) override {
    if (!has_header_) return FieldViolation("header", "is missing");
    if (file_.size() != header_.size_bytes()) {
      return WrongSize(absl::StrCat(file_.size(), " of"));
    }
    METAEKF_ASSIGN_OR_RETURN(store::StagedBlob blob, context_.store.blobs().Stage(file_));
    if (blob.digest() != header_.sha256()) {
      return absl::DataLossError(absl::StrCat("the file that arrived has SHA-256 ", blob.digest(),
                                              ", the header says ", header_.sha256()));
    }
    const auto bundle = nssm::ReadModelFile(file_);
    if (!bundle.ok()) return FieldViolation("chunk", std::string(bundle.status().message()));
    if (sink.cancelled()) return absl::CancelledError("the call was cancelled");
    const store::RequestId id{header_.request_id(),
                              absl::StrCat(header_.parent(), " ", header_.sha256())};
    METAEKF_ASSIGN_OR_RETURN(const store::ModelVersion version,
                             context_.store.models().AddVersion(model_, std::move(blob),
                                                                VersionMetadata(*bundle, ""), id));
    sink.Send(ToMessage(version));
    return absl::OkStatus();
  }

 private:
  absl::Status TakeHeader(const Request& request) {
    if (!request.has_header()) return FieldViolation("header", "must be the first message");
    header_ = request.header();
    has_header_ = true;
    METAEKF_ASSIGN_OR_RETURN(model_, ParseModelName("header.parent", header_.parent()));
    const auto limit = static_cast<uint64_t>(context_.server.options.limits.model_file_bytes);
    if (header_.size_bytes() == 0 || header_.size_bytes() > limit) {
      return FieldViolation("header.size_bytes", absl::StrCat("is ", header_.size_bytes(),
                                                              ", this server takes 1 to ", limit));
    }
    if (!IsDigest(header_.sha256())) {
      return FieldViolation("header.sha256", "must be 64 lower-case hexadecimal digits");
    }
    return absl::OkStatus();
  }

  absl::Status WrongSize(const std::string& arrived) const {
    return absl::DataLossError(absl::StrCat(arrived, " the ", header_.size_bytes(),
                                            " bytes that the header says have arrived"));
  }

  CallContext context_;
  bool has_header_ = false;
  Request::Header header_;
  std::string model_;
  std::string file_;
};

}  // namespace

std::unique_ptr<StreamHandler<Request, v1::ModelVersion>> ImportModelVersion(
    CallContext context) {
  return std::make_unique<Import>(std::move(context));
}

}  // namespace metaekf::server
