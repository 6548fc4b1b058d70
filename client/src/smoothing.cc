#include "client/src/impl.h"

namespace metaekf::client {

Result<Smoothed> Client::Smooth(const SmoothingRequest& request) {
  v1::SmoothRequest first;
  auto* header = first.mutable_header();
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*header->mutable_target(), TargetResource(request.target));
  ToProto(request.noise, header->mutable_noise());
  ToProto(request.gate, header->mutable_gate());
  header->set_initial_samples(request.initial_samples);
  header->set_projection(static_cast<v1::Projection>(request.projection));  // the same numbers
  header->set_covariance_format(ToProto(request.covariance));

  using Stream = grpc::ClientReaderWriter<v1::SmoothRequest, v1::SmoothResponse>;
  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  const std::unique_ptr<Stream> stream = impl_->smoothing->Smooth(&context);
  const auto write = [&](Stream& out) {
    if (!out.Write(first)) return Status();
    return SendSamples(request.trajectory, [&](v1::Samples samples) {
      v1::SmoothRequest message;
      *message.mutable_samples() = std::move(samples);
      return out.Write(message);
    });
  };
  Smoothed smoothed;
  uint64_t samples = 0;
  const auto on_response = [&](const v1::SmoothResponse& response) {
    for (const v1::Channel& channel : response.estimated()) {
      smoothed.estimated.push_back({channel.name(), channel.unit()});
    }
    smoothed.constrained = smoothed.constrained || response.constrained();
    smoothed.batches.push_back(FromProto(response.estimates()));
    samples += smoothed.batches.back().samples;
    return true;
  };
  METAEKF_CLIENT_RETURN_IF_ERROR((impl_->Exchange<v1::SmoothRequest, v1::SmoothResponse>(
      context, *stream, write, on_response)));
  if (samples != request.trajectory.samples) {
    return Error(Code::kInternal, "the server answered " + std::to_string(samples) + " of " +
                                      std::to_string(request.trajectory.samples) + " samples");
  }
  return smoothed;
}

}  // namespace metaekf::client
