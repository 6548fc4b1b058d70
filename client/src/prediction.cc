#include "client/src/impl.h"

namespace metaekf::client {

Result<std::vector<Prediction>> Client::Predict(
    const PredictionRequest& request, const std::function<void(uint64_t samples)>& on_rows) {
  v1::PredictRequest first;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*first.mutable_header()->mutable_target(),
                                  TargetResource(request.target));
  first.mutable_header()->set_mode(request.mode == PredictionMode::kOneStep
                                       ? v1::PredictRequest::ONE_STEP
                                       : v1::PredictRequest::SIMULATE);

  using Stream = grpc::ClientReaderWriter<v1::PredictRequest, v1::PredictResponse>;
  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  const std::unique_ptr<Stream> stream = impl_->predictions->Predict(&context);
  const auto write = [&](Stream& out) {
    bool open = out.Write(first);
    for (size_t i = 0; open && i < request.trajectories.size(); ++i) {
      METAEKF_CLIENT_RETURN_IF_ERROR(SendSamples(request.trajectories[i], [&](v1::Samples samples) {
        v1::PredictRequest message;
        *message.mutable_samples() = std::move(samples);
        return open = out.Write(message);
      }));
    }
    return Status();
  };
  std::vector<Prediction> predictions;
  uint64_t samples = 0;
  const auto on_response = [&](const v1::PredictResponse& response) {
    if (predictions.empty() || predictions.back().trajectory != response.trajectory()) {
      predictions.push_back({response.trajectory(), response.warmup_samples(), {}, {}});
    }
    Prediction& prediction = predictions.back();
    prediction.outputs.insert(prediction.outputs.end(), response.outputs().begin(),
                              response.outputs().end());
    prediction.states.insert(prediction.states.end(), response.states().begin(),
                             response.states().end());
    samples += response.sample_count();
    if (on_rows) on_rows(samples);
    return true;
  };
  METAEKF_CLIENT_RETURN_IF_ERROR((impl_->Exchange<v1::PredictRequest, v1::PredictResponse>(
      context, *stream, write, on_response)));
  uint64_t sent = 0;
  for (const Trajectory& trajectory : request.trajectories) sent += trajectory.samples;
  if (samples != sent || predictions.size() != request.trajectories.size()) {
    return Error(Code::kInternal, "the server answered " + std::to_string(samples) + " of " +
                                      std::to_string(sent) + " samples");
  }
  return predictions;
}

}  // namespace metaekf::client
