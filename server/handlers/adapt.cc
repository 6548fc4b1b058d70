#include <algorithm>
#include <memory>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/nssm/model_file.h"
#include "server/convert/adaptations.h"
#include "server/convert/samples.h"
#include "server/executor/give_way.h"
#include "server/handlers/adaptation_handlers.h"
#include "server/metrics/metrics.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"
#include "server/store/sha256.h"

namespace metaekf::server {
namespace {

using Request = v1::AdaptRequest;
using Response = v1::AdaptResponse;
using Sink = ResponseSink<Response>;

constexpr unsigned kMaxThreads = 3;  // starts that compete
constexpr absl::Duration kProgressPeriod = absl::Milliseconds(50);

class AdaptCall final : public StreamHandler<Request, Response> {
 public:
  explicit AdaptCall(CallContext context) : context_(std::move(context)), share_(context_.server.samples) {}

  absl::Status OnRequest(Request& request, Sink&) override {
    // So that the same request_id with other options or samples is recognised.
    fingerprint_.Update(request.SerializeAsString());
    if (!assembler_) {
      if (!request.has_options()) return FieldViolation("options", "must be the first message");
      return TakeOptions(request.options());
    }
    if (!request.has_samples()) {
      return FieldViolation("samples", "are missing: after the options come samples only");
    }
    METAEKF_RETURN_IF_ERROR(share_.Grow(assembler_->BytesOf(request.samples())));
    METAEKF_ASSIGN_OR_RETURN(const auto complete, assembler_->Add(request.samples()));
    if (!complete) return absl::OkStatus();
    return FieldViolation("samples.trajectory", "a second trajectory begins: the context is one");
  }

  absl::Status OnEnd(Sink& sink) override {
    if (!assembler_) return FieldViolation("options", "are missing");
    const std::optional<data::Trajectory> context = assembler_->Finish();
    if (!context) return FieldViolation("samples", "there are none: send a context");
    const store::RequestId id{request_.request_id(), fingerprint_.HexDigest()};
    METAEKF_ASSIGN_OR_RETURN(const auto before, context_.store.adaptations().FindByRequest(id));
    if (before) {
      SendResult(*before, sink);
      return absl::OkStatus();
    }
    const absl::Time start = absl::Now();
    const auto executor = base::MakeThreadExecutor(std::min(UsableProcessors(), kMaxThreads));
    meta::AdaptationOptions options = options_;
    options.executor = executor.get();
    METAEKF_ASSIGN_OR_RETURN(meta::AdaptationResult result,
                             meta::Adapt(model_->bundle, *context, options,
                                         [&](const meta::AdaptationStep& step) {
                                           if (!step.trial) SendProgress(step, sink);
                                           return !sink.cancelled();
                                         }));
    const absl::Duration duration = absl::Now() - start;
    context_.server.metrics->CountAdaptation(duration, result.context_loss_before, result.context_loss_after);
    return Store(std::move(result), id, absl::ToDoubleSeconds(duration), sink);
  }

 private:
  absl::Status TakeOptions(const Request::Options& request) {
    request_ = request;
    if (!request.adaptation_id().empty()) {
      METAEKF_RETURN_IF_ERROR(CheckId("options.adaptation_id", request.adaptation_id()));
    }
    METAEKF_RETURN_IF_ERROR(ParseModelTarget("options.model", request.model()).status());
    METAEKF_ASSIGN_OR_RETURN(model_, context_.server.models.Get(context_.caller.tenant, "options.model", request.model()));
    METAEKF_ASSIGN_OR_RETURN(options_, ResolveOptions(request, model_->bundle));
    METAEKF_ASSIGN_OR_RETURN(const ChannelCounts channels,
                             MatchChannels("options.channels", request.channels(), model_->bundle));
    assembler_.emplace(SampleRules{.channels = channels,
                                   .sample_period_s = model_->bundle.sample_period_s,
                                   .max_samples = context_.server.options.limits.samples_per_call});
    return absl::OkStatus();
  }

  void SendProgress(const meta::AdaptationStep& step, Sink& sink) {
    const absl::Time now = absl::Now();
    if (step.step < step.steps && (now - last_progress_ < kProgressPeriod || !sink.idle())) return;
    last_progress_ = now;
    Response response;
    response.mutable_progress()->set_step(static_cast<uint32_t>(step.step));
    response.mutable_progress()->set_steps(static_cast<uint32_t>(step.steps));
    response.mutable_progress()->set_loss(step.loss);
    sink.Send(std::move(response));
  }

  absl::Status Store(meta::AdaptationResult result, const store::RequestId& id, double duration_s,
                     Sink& sink) {
    if (request_.require_better_than_arx() && !meta::BetterInFreeRun(result.after, result.arx)) {
      return absl::FailedPreconditionError(
          "the adapted model is not better than linear ARX in free run on the context's tail, as was required; a longer "
          "context may help");
    }
    nssm::Bundle adapted = model_->bundle;
    adapted.parameters = std::move(result.parameters);
    adapted.posterior = std::move(result.posterior);
    adapted.noise = std::move(result.noise);
    METAEKF_ASSIGN_OR_RETURN(
        store::StagedBlob file,
        context_.store.blobs().Stage(nssm::WriteAdaptedSubset(adapted, result.mask)));
    METAEKF_ASSIGN_OR_RETURN(const Target version,
                             ParseVersionName("model_version", model_->model_version));
    if (sink.cancelled()) return absl::CancelledError("the call was cancelled");
    METAEKF_ASSIGN_OR_RETURN(
        const store::Adaptation adaptation,
        context_.store.adaptations().Create({request_.adaptation_id(), version.model,
                                             version.version, std::move(file),
                                             AdaptationReceipt(options_, result, duration_s), id}));
    SendResult(adaptation, sink);
    return absl::OkStatus();
  }

  static void SendResult(const store::Adaptation& adaptation, Sink& sink) {
    Response response;
    *response.mutable_result() = ToMessage(adaptation);
    sink.Send(std::move(response));
  }

  CallContext context_;
  Request::Options request_;
  std::shared_ptr<const ServedModel> model_;
  meta::AdaptationOptions options_;
  std::optional<TrajectoryAssembler> assembler_;  // once the options are there
  SampleBudget::Share share_;
  store::Sha256 fingerprint_;
  absl::Time last_progress_;
};

}  // namespace

std::unique_ptr<StreamHandler<Request, Response>> Adapt(CallContext context) {
  return std::make_unique<AdaptCall>(std::move(context));
}

}  // namespace metaekf::server
