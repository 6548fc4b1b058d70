#include <algorithm>
#include <condition_variable>
#include <deque>
#include <mutex>

#include "client/src/impl.h"

namespace metaekf::client {

struct EstimationSession::Impl {
  using Stream = grpc::ClientReaderWriter<v1::EstimateRequest, v1::EstimateResponse>;

  /// Opens the stream with its first request and reads what the server says.
  Status Connect(const v1::EstimateRequest& first);
  /// The numbers and matrices of a batch, checked against the session.
  Result<v1::SampleBatch> ToMessage(const SampleBatch& samples) const;
  /// Forgets what will not be needed again. With the mutex held.
  void Forget();
  /// Waits for a replay that is under way.
  void Join() {
    if (replay.joinable()) replay.join();
  }

  std::shared_ptr<Client::Impl> client;
  size_t max_in_flight = EstimationOptions().max_in_flight;
  size_t max_kept = EstimationOptions().max_kept;

  SessionInfo info;
  std::unique_ptr<grpc::ClientContext> context;
  std::unique_ptr<Stream> stream;
  std::thread replay;

  mutable std::mutex mutex;
  std::condition_variable changed;
  std::deque<v1::SampleBatch> kept;  // sent, not durable
  uint64_t sent_seq = 0;             // of the last sample given to Send
  uint64_t answered_seq = 0;
  uint64_t durable_seq = 0;
  bool ended = false;
};

namespace {

uint64_t LastSeq(const v1::SampleBatch& batch, size_t output_size) {
  return batch.first_seq() + static_cast<uint64_t>(batch.outputs_size()) / output_size - 1;
}

}  // namespace

Status EstimationSession::Impl::Connect(const v1::EstimateRequest& first) {
  stream.reset();
  client->Connect();
  context = std::make_unique<grpc::ClientContext>();
  stream = client->estimation->Estimate(context.get());
  v1::EstimateResponse response;
  if (!stream->Write(first) || !stream->Read(&response)) {
    Status status = client->Translate(stream->Finish());
    if (!status.ok()) return status;
  }
  if (!response.has_opened() || response.opened().output_size() == 0) {
    return Error(Code::kInternal, "the server did not say which session it opened");
  }
  SessionInfo opened = FromProto(response.opened());
  if (opened.token.empty()) opened.token = info.token;
  info = std::move(opened);
  const std::lock_guard lock(mutex);
  durable_seq = answered_seq = info.durable_seq;
  sent_seq = std::max(sent_seq, durable_seq);
  ended = false;
  Forget();
  return {};
}

Result<v1::SampleBatch> EstimationSession::Impl::ToMessage(const SampleBatch& samples) const {
  const auto wrong = [&](const char* what, size_t size, size_t width) {
    return Error(Code::kInvalidArgument, std::to_string(size) + " values of " + what + " for " +
                                             std::to_string(samples.samples) +
                                             " samples; the model needs " + std::to_string(width) +
                                             " per sample");
  };
  const size_t count = samples.samples;
  if (count == 0 || samples.outputs.size() != count * info.output_size) {
    return wrong("outputs", samples.outputs.size(), info.output_size);
  }
  if (samples.inputs.size() != count * info.input_size) {
    return wrong("inputs", samples.inputs.size(), info.input_size);
  }
  if (!samples.times_s.empty() && samples.times_s.size() != count) {
    return wrong("times", samples.times_s.size(), 1);
  }
  const size_t noise = samples.measurement_noise_covs.size(), n_y = info.output_size;
  if (noise != 0 && noise != count * n_y && noise != count * n_y * (n_y + 1) / 2) {
    return wrong("measurement noise", noise, n_y);
  }
  v1::SampleBatch message;
  message.mutable_measurement_noise_covs()->Add(samples.measurement_noise_covs.begin(),
                                                samples.measurement_noise_covs.end());
  message.mutable_inputs()->Add(samples.inputs.begin(), samples.inputs.end());
  message.mutable_outputs()->Add(samples.outputs.begin(), samples.outputs.end());
  message.mutable_times_s()->Add(samples.times_s.begin(), samples.times_s.end());
  return message;
}

void EstimationSession::Impl::Forget() {
  const auto last = [this](const v1::SampleBatch& batch) {
    return LastSeq(batch, info.output_size);
  };
  while (!kept.empty() && last(kept.front()) <= durable_seq) kept.pop_front();
  // Nothing is durable on a server that keeps sessions in memory only: waiting would be for ever.
  while (!kept.empty() && durable_seq == 0 && last(kept.front()) <= answered_seq &&
         sent_seq - kept.front().first_seq() >= max_kept) {
    kept.pop_front();
  }
}

EstimationSession::EstimationSession(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}

EstimationSession::~EstimationSession() {
  if (impl_->context) impl_->context->TryCancel();
  impl_->Join();
}

const SessionInfo& EstimationSession::info() const { return impl_->info; }

uint64_t EstimationSession::durable_seq() const {
  const std::lock_guard lock(impl_->mutex);
  return impl_->durable_seq;
}

Result<uint64_t> EstimationSession::Send(const SampleBatch& samples) {
  impl_->Join();
  METAEKF_CLIENT_ASSIGN_OR_RETURN(v1::SampleBatch batch, impl_->ToMessage(samples));
  v1::EstimateRequest request;
  uint64_t last = 0;
  {
    std::unique_lock lock(impl_->mutex);
    impl_->changed.wait(lock, [&] {
      const bool kept_full = !impl_->kept.empty() && impl_->durable_seq > 0 &&
                             impl_->sent_seq - impl_->kept.front().first_seq() >= impl_->max_kept;
      return impl_->ended ||
             (impl_->sent_seq - impl_->answered_seq < impl_->max_in_flight && !kept_full);
    });
    if (impl_->ended) return Error(Code::kUnavailable, "the stream has ended");
    batch.set_first_seq(impl_->sent_seq + 1);
    last = impl_->sent_seq += samples.samples;
    *request.mutable_samples() = batch;
    impl_->kept.push_back(std::move(batch));
  }
  if (!impl_->stream->Write(request)) return Error(Code::kUnavailable, "the stream has ended");
  return last;
}

Status EstimationSession::AskForecast(size_t horizon, const std::vector<double>& inputs) {
  impl_->Join();
  v1::EstimateRequest request;
  request.mutable_forecast()->set_horizon(static_cast<uint32_t>(horizon));
  request.mutable_forecast()->mutable_inputs()->Add(inputs.begin(), inputs.end());
  if (!impl_->stream->Write(request)) return Error(Code::kUnavailable, "the stream has ended");
  return {};
}

void EstimationSession::FinishSending() {
  impl_->Join();
  impl_->stream->WritesDone();
}

Result<std::optional<EstimateBatch>> EstimationSession::Receive() {
  v1::EstimateResponse response;
  if (!impl_->stream->Read(&response)) {
    {
      const std::lock_guard lock(impl_->mutex);
      if (impl_->ended) return Error(Code::kUnavailable, "the stream has ended");
      impl_->ended = true;
    }
    impl_->changed.notify_all();
    METAEKF_CLIENT_RETURN_IF_ERROR(impl_->client->Translate(impl_->stream->Finish()));
    return std::optional<EstimateBatch>();
  }
  if (response.has_forecast()) {
    EstimateBatch forecast = FromProto(response.forecast());
    forecast.forecast = true;
    return std::optional<EstimateBatch>(std::move(forecast));
  }
  EstimateBatch batch = FromProto(response.estimates());
  {
    const std::lock_guard lock(impl_->mutex);
    impl_->answered_seq = std::max(impl_->answered_seq, batch.first_seq + batch.samples - 1);
    impl_->durable_seq = std::max(impl_->durable_seq, batch.durable_seq);
    impl_->Forget();
  }
  impl_->changed.notify_all();
  return std::optional<EstimateBatch>(std::move(batch));
}

Status EstimationSession::Resume() {
  impl_->Join();
  v1::EstimateRequest first;
  first.mutable_resume()->set_session("sessions/" + impl_->info.session);
  first.mutable_resume()->set_token(impl_->info.token);
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Connect(first));

  std::vector<v1::SampleBatch> again;
  {
    const std::lock_guard lock(impl_->mutex);
    const uint64_t next = impl_->durable_seq + 1;
    const uint64_t oldest =
        impl_->kept.empty() ? impl_->sent_seq + 1 : impl_->kept.front().first_seq();
    if (oldest > next) {
      return Error(Code::kDataLoss, "the server goes on with sample " + std::to_string(next) +
                                        ", but samples before " + std::to_string(oldest) +
                                        " are no longer kept; raise max_kept");
    }
    again.assign(impl_->kept.begin(), impl_->kept.end());
  }
  // Beside the caller, who must receive what is answered meanwhile.
  impl_->replay = std::thread([stream = impl_->stream.get(), again = std::move(again)] {
    for (const v1::SampleBatch& batch : again) {
      v1::EstimateRequest request;
      *request.mutable_samples() = batch;
      if (!stream->Write(request)) return;
    }
  });
  return {};
}

Result<std::unique_ptr<EstimationSession>> Client::OpenEstimation(
    const EstimationOptions& options) {
  v1::EstimateRequest first;
  auto* open = first.mutable_open();
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*open->mutable_target(), TargetResource(options.target));
  ToProto(options.noise, open->mutable_noise());
  open->set_covariance_format(ToProto(options.covariance));
  open->set_send_innovations(options.send_innovations);
  open->set_sample_period_s(options.sample_period_s);
  open->set_max_lag_s(options.max_lag_s);
  ToProto(options.gate, open->mutable_gate());
  open->set_initial_samples(options.initial_samples);
  open->set_projection(static_cast<v1::Projection>(options.projection));  // the same numbers
  open->set_stay_diverged(options.stay_diverged);

  auto impl = std::make_unique<EstimationSession::Impl>();
  impl->client = impl_;
  impl->max_in_flight = std::max<size_t>(1, options.max_in_flight);
  impl->max_kept = options.max_kept;
  METAEKF_CLIENT_RETURN_IF_ERROR(impl->Connect(first));
  return std::unique_ptr<EstimationSession>(new EstimationSession(std::move(impl)));
}

Result<std::unique_ptr<EstimationSession>> Client::ResumeEstimation(const std::string& session,
                                                                    const std::string& token) {
  v1::EstimateRequest first;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*first.mutable_resume()->mutable_session(),
                                  Resource("sessions", session));
  first.mutable_resume()->set_token(token);
  auto impl = std::make_unique<EstimationSession::Impl>();
  impl->client = impl_;
  impl->info.token = token;
  METAEKF_CLIENT_RETURN_IF_ERROR(impl->Connect(first));
  return std::unique_ptr<EstimationSession>(new EstimationSession(std::move(impl)));
}

}  // namespace metaekf::client
