#pragma once

#include <memory>
#include <optional>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/status.h"
#include "server/convert/samples.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"
#include "server/status/details.h"

namespace metaekf::server {

/// A call that brings recordings to a model or adaptation: a header first, then samples, a trajectory worked on when it is complete.
template <class Request, class Response>
class TrajectoryCall : public StreamHandler<Request, Response> {
 public:
  /// @param method  for the audit log.
  TrajectoryCall(CallContext context, const char* method)
      : context_(std::move(context)), method_(method), share_(context_.server.samples) {}

  absl::Status OnRequest(Request& request, ResponseSink<Response>& sink) final {
    if (!assembler_) {
      if (!request.has_header()) return FieldViolation("header", "must be the first message");
      return Open(request.header());
    }
    if (!request.has_samples()) {
      return FieldViolation("samples", "are missing: after the header come samples only");
    }
    share_.ShrinkTo(waiting_bytes_);  // the answers to the request before are on their way
    const int64_t bytes = assembler_->BytesOf(request.samples());
    METAEKF_RETURN_IF_ERROR(share_.Grow(bytes));
    METAEKF_ASSIGN_OR_RETURN(const auto complete, assembler_->Add(request.samples()));
    waiting_bytes_ = complete ? bytes : waiting_bytes_ + bytes;
    return complete ? WorkOn(*complete, sink) : absl::OkStatus();
  }

  absl::Status OnEnd(ResponseSink<Response>& sink) final {
    if (!assembler_) return FieldViolation("header", "is missing");
    const std::optional<data::Trajectory> last = assembler_->Finish();
    if (!last) return FieldViolation("samples", "there are none");
    return WorkOn(*last, sink);
  }

 protected:
  using Header = typename Request::Header;

  /// What the header says beyond target and channels, which are known when this is called.
  virtual absl::Status TakeHeader(const Header& header) = 0;
  /// What the work on a sample takes beside the sample itself, answers included until they have left.
  virtual int64_t BytesPerSample() const = 0;
  virtual absl::Status Answer(const data::Trajectory& trajectory, ResponseSink<Response>& sink) = 0;

  const ServedModel& model() const { return *model_; }

 private:
  absl::Status Open(const Header& header) {
    METAEKF_ASSIGN_OR_RETURN(model_, context_.server.models.Get(context_.caller.tenant, "header.target", header.target()));
    METAEKF_ASSIGN_OR_RETURN(const ChannelCounts channels, MatchChannels("header.channels", header.channels(), model_->bundle));
    METAEKF_RETURN_IF_ERROR(TakeHeader(header));
    METAEKF_RETURN_IF_ERROR(
        context_.store.AuditUse(method_, model_->adaptation.empty() ? model_->model_version : model_->adaptation));
    assembler_.emplace(SampleRules{.channels = channels,
                                   .missing_measurements = true,
                                   .sample_period_s = model_->bundle.sample_period_s,
                                   .max_samples = context_.server.options.limits.samples_per_call});
    return absl::OkStatus();
  }

  absl::Status WorkOn(const data::Trajectory& trajectory, ResponseSink<Response>& sink) {
    METAEKF_RETURN_IF_ERROR(share_.Grow(trajectory.length() * BytesPerSample()));
    return Answer(trajectory, sink);
  }

  CallContext context_;
  const char* const method_;
  SampleBudget::Share share_;
  int64_t waiting_bytes_ = 0;  // of the trajectory that is not complete
  std::shared_ptr<const ServedModel> model_;
  std::optional<TrajectoryAssembler> assembler_;  // once the header is there
};

}  // namespace metaekf::server
