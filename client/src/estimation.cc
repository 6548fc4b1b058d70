#include <algorithm>
#include <cmath>
#include <condition_variable>
#include <mutex>
#include <random>

#include "client/src/impl.h"
#include "client/src/outbox.h"

namespace metaekf::client {

using std::chrono::duration;
using std::chrono::steady_clock;

/// One thread may send while another receives. While the stream works, sends are written by whoever sends, the stream is
/// read, broken off and opened again by whoever receives; while it is broken, what is sent stays in the outbox, until the
/// thread that sends again has caught up with it.
struct EstimationSession::Impl {
  using Stream = grpc::ClientReaderWriter<v1::EstimateRequest, v1::EstimateResponse>;

  /// Opens a stream with its first request and reads what the server says.
  Result<SessionInfo> Connect(const v1::EstimateRequest& first);
  /// The numbers and matrices of a batch, checked against the session.
  Result<v1::SampleBatch> ToMessage(const SampleBatch& samples) const;
  /// Writes an entry, unless the stream is broken. With send_mutex held.
  void Write(const Outbox::Entry& entry);
  /// Notes an answer; nothing if all of it has been received before.
  std::optional<EstimateBatch> Take(const v1::EstimateResponse& response);
  /// Ends the stream on this side, after a read that failed. @return how it ended.
  Status BreakOff();
  /// Opens the stream again and sends what is needed. Errors: see EstimationSession::Resume.
  Result<SessionInfo> Reopen();
  /// Reopens until it works. Errors: why not, once there is no hope or no time left.
  Status Reconnect(Status lost);
  /// What the thread does that sends again.
  void SendAgain();
  void Join() {
    if (sends_again.joinable()) sends_again.join();
  }

  std::shared_ptr<Client::Impl> client;
  size_t max_in_flight = EstimationOptions().max_in_flight;
  size_t max_kept = EstimationOptions().max_kept;
  duration<double> reconnect_for{EstimationOptions().reconnect_for_s};

  SessionInfo info;  // not changed while somebody may send
  std::unique_ptr<grpc::ClientContext> context;
  std::unique_ptr<Stream> stream;
  std::thread sends_again;

  // Of whoever receives.
  std::optional<steady_clock::time_point> lost_since;  // no answer came after this
  uint64_t received_seq = 0;
  std::minstd_rand jitter{std::random_device()()};

  std::mutex send_mutex;  // whoever sends, against the stream being broken off; taken before mutex
  bool broken = true;
  bool finished_sending = false;

  mutable std::mutex mutex;  // of all below
  std::condition_variable changed;
  Outbox outbox;
  bool ended = false;  // and not to be opened again
};

namespace {

/// Errors that pass: of the network, of a server that is stopped or restarted or has too much to do.
bool MayPass(const Status& status) {
  return status.code == Code::kUnavailable ||
         (status.code == Code::kResourceExhausted && status.retry_delay_s.has_value());
}

/// Removes the first `count` rows.
void DropRows(size_t count, EstimateBatch& batch) {
  const auto drop = [&](auto& values) {
    values.erase(values.begin(), values.begin() + static_cast<ptrdiff_t>(count * values.size() / batch.samples));
  };
  drop(batch.times_s);
  drop(batch.means);
  drop(batch.covariances);
  drop(batch.innovations);
  drop(batch.innovation_covs);
  drop(batch.nis);
  drop(batch.health);
  drop(batch.flags);
  drop(batch.slacks);
  drop(batch.projections);
  batch.first_seq += count;
  batch.samples -= count;
}

/// The server would refuse them, and end the stream. @param missing  NaN is a value that was not measured.
Status CheckNumbers(const char* what, const std::vector<double>& values, bool missing) {
  for (size_t i = 0; i < values.size(); ++i) {
    if (std::isfinite(values[i]) || (missing && std::isnan(values[i]))) continue;
    return Error(Code::kInvalidArgument, std::string(what) + "[" + std::to_string(i) + "] is " + std::to_string(values[i]) +
                                             (missing ? "; NaN is a value that was not measured" : ", must be a finite number"));
  }
  return {};
}

Status StreamEnded() { return Error(Code::kUnavailable, "the stream has ended"); }

}  // namespace

Result<SessionInfo> EstimationSession::Impl::Connect(const v1::EstimateRequest& first) {
  client->Connect();
  stream.reset();
  context = std::make_unique<grpc::ClientContext>();
  client->Authorise(*context);
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
  if (opened.token.empty()) opened.token = first.resume().token();
  const std::lock_guard lock(mutex);
  outbox.Begin(opened.durable_seq);
  return opened;
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
  METAEKF_CLIENT_RETURN_IF_ERROR(CheckNumbers("inputs", samples.inputs, false));
  METAEKF_CLIENT_RETURN_IF_ERROR(CheckNumbers("outputs", samples.outputs, true));
  METAEKF_CLIENT_RETURN_IF_ERROR(CheckNumbers("times_s", samples.times_s, false));
  v1::SampleBatch message;
  message.mutable_measurement_noise_covs()->Add(samples.measurement_noise_covs.begin(),
                                                samples.measurement_noise_covs.end());
  message.mutable_inputs()->Add(samples.inputs.begin(), samples.inputs.end());
  message.mutable_outputs()->Add(samples.outputs.begin(), samples.outputs.end());
  message.mutable_times_s()->Add(samples.times_s.begin(), samples.times_s.end());
  return message;
}

void EstimationSession::Impl::Write(const Outbox::Entry& entry) {
  // A write that fails is none that is lost: whoever receives finds the stream broken, and has the entry sent again.
  if (!broken) (void)stream->Write(*entry.request);
}

std::optional<EstimateBatch> EstimationSession::Impl::Take(const v1::EstimateResponse& response) {
  lost_since.reset();
  if (response.has_forecast()) {
    EstimateBatch forecast = FromProto(response.forecast());
    forecast.forecast = true;
    const std::lock_guard lock(mutex);
    outbox.ForecastAnswered();
    return forecast;
  }
  EstimateBatch batch = FromProto(response.estimates());
  if (batch.samples == 0) return std::nullopt;
  const uint64_t last = batch.first_seq + batch.samples - 1;
  {
    const std::lock_guard lock(mutex);
    outbox.Answered(last, batch.durable_seq, max_kept);
  }
  changed.notify_all();
  if (last <= received_seq) return std::nullopt;
  if (batch.first_seq <= received_seq) DropRows(received_seq + 1 - batch.first_seq, batch);
  received_seq = last;
  return batch;
}

Status EstimationSession::Impl::BreakOff() {
  Join();
  const std::lock_guard lock(send_mutex);
  broken = true;
  return client->Translate(stream->Finish());
}

Result<SessionInfo> EstimationSession::Impl::Reopen() {
  Join();
  v1::EstimateRequest first;
  first.mutable_resume()->set_session("sessions/" + info.session);
  first.mutable_resume()->set_token(info.token);
  METAEKF_CLIENT_ASSIGN_OR_RETURN(SessionInfo opened, Connect(first));
  {
    const std::lock_guard lock(mutex);
    const uint64_t next = outbox.durable_seq() + 1;
    if (outbox.oldest_seq() > next) {
      return Error(Code::kDataLoss, "the server goes on with sample " + std::to_string(next) +
                                        ", but samples before " + std::to_string(outbox.oldest_seq()) +
                                        " are no longer kept; raise max_kept");
    }
    ended = false;
  }
  // Beside the caller, who must receive what is answered meanwhile.
  sends_again = std::thread([this] { SendAgain(); });
  return opened;
}

void EstimationSession::Impl::SendAgain() {
  const auto next_after = [this](uint64_t id) {
    const std::lock_guard lock(mutex);
    return outbox.After(id);
  };
  uint64_t id = 0;
  while (true) {
    std::optional<Outbox::Entry> next = next_after(id);
    if (!next) {
      // Caught up, unless something was sent just now.
      const std::lock_guard lock(send_mutex);
      next = next_after(id);
      if (!next) {
        broken = false;
        if (finished_sending) stream->WritesDone();
        return;
      }
    }
    id = next->id;
    if (!stream->Write(*next->request)) return;
  }
}

Status EstimationSession::Impl::Reconnect(Status lost) {
  constexpr duration<double> kFirstDelay(0.1), kLastDelay(5);
  if (reconnect_for.count() <= 0) return lost;
  if (!lost_since) lost_since = steady_clock::now();
  for (duration<double> delay = kFirstDelay; MayPass(lost); delay = std::min(2 * delay, kLastDelay)) {
    // Not all clients at once.
    const double part = std::uniform_real_distribution(0.5, 1.0)(jitter);
    const duration<double> wait = std::max(part * delay, duration<double>(lost.retry_delay_s.value_or(0)));
    if (steady_clock::now() + wait > *lost_since + reconnect_for) break;
    std::this_thread::sleep_for(wait);
    lost = Reopen().status();
    if (lost.ok()) return lost;
  }
  const std::string durable = std::to_string([this] {
    const std::lock_guard lock(mutex);
    return outbox.durable_seq();
  }());
  if (MayPass(lost)) {
    lost.message += "; gave up after " + std::to_string(std::lround(reconnect_for.count())) +
                    " s, samples up to " + durable + " are kept by the server";
  }
  lost.metadata["durable_seq"] = durable;
  return lost;
}

EstimationSession::EstimationSession(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}

EstimationSession::~EstimationSession() {
  if (impl_->context) impl_->context->TryCancel();
  impl_->Join();
}

const SessionInfo& EstimationSession::info() const { return impl_->info; }

uint64_t EstimationSession::durable_seq() const {
  const std::lock_guard lock(impl_->mutex);
  return impl_->outbox.durable_seq();
}

Result<uint64_t> EstimationSession::Send(const SampleBatch& samples) {
  METAEKF_CLIENT_ASSIGN_OR_RETURN(v1::SampleBatch batch, impl_->ToMessage(samples));
  {
    std::unique_lock lock(impl_->mutex);
    impl_->changed.wait(lock, [&] {
      const Outbox& outbox = impl_->outbox;
      const uint64_t in_flight = outbox.sent_seq() - outbox.answered_seq();
      const bool kept_full =
          outbox.durable_seq() > 0 && outbox.sent_seq() >= outbox.oldest_seq() + impl_->max_kept;
      // What is durable is told with answers: if none is to come, waiting would be for ever.
      return impl_->ended || in_flight == 0 || (in_flight < impl_->max_in_flight && !kept_full);
    });
    if (impl_->ended) return StreamEnded();
  }
  const std::lock_guard sending(impl_->send_mutex);
  const Outbox::Entry entry = [&] {
    const std::lock_guard lock(impl_->mutex);
    return impl_->outbox.Add(std::move(batch), samples.samples);
  }();
  impl_->Write(entry);
  return entry.last_seq;
}

Status EstimationSession::AskForecast(size_t horizon, const std::vector<double>& inputs) {
  v1::ForecastRequest forecast;
  forecast.set_horizon(static_cast<uint32_t>(horizon));
  forecast.mutable_inputs()->Add(inputs.begin(), inputs.end());
  const std::lock_guard sending(impl_->send_mutex);
  std::optional<Outbox::Entry> entry;
  {
    const std::lock_guard lock(impl_->mutex);
    if (impl_->ended) return StreamEnded();
    entry = impl_->outbox.Add(std::move(forecast));
  }
  impl_->Write(*entry);
  return {};
}

void EstimationSession::FinishSending() {
  const std::lock_guard sending(impl_->send_mutex);
  impl_->finished_sending = true;
  if (!impl_->broken) impl_->stream->WritesDone();
}

Result<std::optional<EstimateBatch>> EstimationSession::Receive() {
  while (true) {
    {
      const std::lock_guard lock(impl_->mutex);
      if (impl_->ended) return StreamEnded();
    }
    v1::EstimateResponse response;
    if (impl_->stream->Read(&response)) {
      if (std::optional<EstimateBatch> batch = impl_->Take(response)) return batch;
      continue;
    }
    Status status = impl_->BreakOff();
    const bool all_came = status.ok();
    if (!all_came) status = impl_->Reconnect(std::move(status));
    if (!all_came && status.ok()) continue;
    {
      const std::lock_guard lock(impl_->mutex);
      impl_->ended = true;
      if (status.code == Code::kInvalidArgument) impl_->outbox.Refused();
    }
    impl_->changed.notify_all();
    if (all_came) return std::optional<EstimateBatch>();
    return status;
  }
}

Status EstimationSession::Resume() {
  impl_->received_seq = 0;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(impl_->info, impl_->Reopen());
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
  impl->reconnect_for = duration<double>(options.reconnect_for_s);
  METAEKF_CLIENT_ASSIGN_OR_RETURN(impl->info, impl->Connect(first));
  impl->broken = false;
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
  METAEKF_CLIENT_ASSIGN_OR_RETURN(impl->info, impl->Connect(first));
  impl->received_seq = impl->info.durable_seq;
  impl->broken = false;
  return std::unique_ptr<EstimationSession>(new EstimationSession(std::move(impl)));
}

}  // namespace metaekf::client
