#include <limits>
#include <optional>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/convert/jobs.h"
#include "server/convert/json.h"
#include "server/convert/samples.h"
#include "server/handlers/training_handlers.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"
#include "server/training/check_fleet.h"
#include "server/training/dataset_file.h"

namespace metaekf::server {
namespace {

using Request = v1::CreateTrainingJobRequest;

class Create final : public StreamHandler<Request, v1::Job> {
 public:
  explicit Create(CallContext context) : context_(std::move(context)) {}

  absl::Status OnRequest(Request& request, ResponseSink<v1::Job>&) override {
    if (!checker_) {
      if (!request.has_header()) return FieldViolation("header", "must be the first message");
      return TakeHeader(request);
    }
    if (!request.has_samples()) {
      return FieldViolation("samples", "are missing: after the header come samples only");
    }
    METAEKF_RETURN_IF_ERROR(checker_->Add(request.samples()));
    return Append(request);
  }

  absl::Status OnEnd(ResponseSink<v1::Job>& sink) override {
    if (!checker_) return FieldViolation("header", "is missing");
    METAEKF_RETURN_IF_ERROR(CheckFleet(header_, checker_->recordings()));
    METAEKF_ASSIGN_OR_RETURN(store::StagedBlob dataset, writer_->Finish());
    METAEKF_RETURN_IF_ERROR(CheckQueue());
    METAEKF_ASSIGN_OR_RETURN(const std::string model,
                             ParseModelName("header.model", header_.model()));
    if (sink.cancelled()) return absl::CancelledError("the call was cancelled");
    const store::RequestId id{header_.request_id(), dataset.digest()};
    METAEKF_ASSIGN_OR_RETURN(const store::Job job,
                             context_.store.jobs().Create(
                                 {model, MessageToJson(header_.spec()), std::move(dataset), id}));
    context_.server.training.Wake();
    sink.Send(ToMessage(job));
    return absl::OkStatus();
  }

 private:
  absl::Status TakeHeader(const Request& request) {
    header_ = request.header();
    METAEKF_RETURN_IF_ERROR(CheckTrainingHeader(header_));
    METAEKF_RETURN_IF_ERROR(CheckQueue());
    METAEKF_ASSIGN_OR_RETURN(store::BlobWriter writer, context_.store.blobs().NewBlob());
    writer_.emplace(std::move(writer));
    // Bytes are limited below.
    checker_.emplace(SampleRules{.channels = CountChannels(header_.channels()),
                                 .max_samples = std::numeric_limits<int64_t>::max()});
    return Append(request);
  }

  absl::Status Append(const Request& request) {
    METAEKF_RETURN_IF_ERROR(writer_->Append(DatasetFrame(request)));
    const int64_t limit = context_.server.options.limits.dataset_bytes;
    if (writer_->size_bytes() <= limit) return absl::OkStatus();
    return absl::ResourceExhaustedError(absl::StrCat(
        "the data has more than ", limit, " bytes, this server's limit; send a smaller fleet"));
  }

  absl::Status CheckQueue() const {
    METAEKF_ASSIGN_OR_RETURN(const store::Inventory inventory,
                             context_.server.store.TakeInventory("", /*verify_files=*/false));
    const auto limit = static_cast<int64_t>(context_.server.options.training.max_queued_jobs);
    if (inventory.queued_jobs < limit) return absl::OkStatus();
    return WithRetryDelay(absl::ResourceExhaustedError(absl::StrCat(
                              inventory.queued_jobs, " jobs are waiting, this server's limit")),
                          absl::Minutes(1));
  }

  CallContext context_;
  Request::Header header_;
  std::optional<SampleChecker> checker_;  // once the header is there
  std::optional<store::BlobWriter> writer_;
};

}  // namespace

std::unique_ptr<StreamHandler<Request, v1::Job>> CreateTrainingJob(CallContext context) {
  return std::make_unique<Create>(std::move(context));
}

}  // namespace metaekf::server
