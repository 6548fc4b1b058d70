#include "core/base/status.h"
#include "server/convert/models.h"
#include "server/handlers/model_handlers.h"
#include "server/names/resource_names.h"

namespace metaekf::server {
namespace {

using Response = v1::ExportModelVersionResponse;

constexpr size_t kChunkBytes = size_t{64} << 10;

class Export final : public ResponseSource<Response> {
 public:
  Export(CallContext context, std::string name)
      : context_(std::move(context)), name_(std::move(name)) {}

  absl::Status Open() override {
    store::ModelStore& models = context_.store.models();
    METAEKF_ASSIGN_OR_RETURN(version_, ResolveVersion(models, "name", name_));
    METAEKF_ASSIGN_OR_RETURN(file_, models.ReadFile(version_));
    return context_.store.AuditUse("ExportModelVersion", VersionName(version_.model, version_.version));
  }

  absl::StatusOr<bool> Next(Response* response) override {
    if (!header_sent_) {
      *response->mutable_header() = ToMessage(version_);
      header_sent_ = true;
      return true;
    }
    if (sent_ == file_.size()) return false;
    response->set_chunk(file_.substr(sent_, kChunkBytes));
    sent_ += response->chunk().size();
    return true;
  }

 private:
  CallContext context_;
  const std::string name_;
  store::ModelVersion version_;
  std::string file_;
  bool header_sent_ = false;
  size_t sent_ = 0;
};

}  // namespace

std::unique_ptr<ResponseSource<Response>> ExportModelVersion(
    CallContext context, const v1::ExportModelVersionRequest& request) {
  return std::make_unique<Export>(std::move(context), request.name());
}

}  // namespace metaekf::server
