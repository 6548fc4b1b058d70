#include "client/src/convert.h"

#include <algorithm>

#include "client/src/names.h"
#include "client/src/status.h"
#include "client/src/text_proto.h"

namespace metaekf::client {
namespace {

// Doubles per message: 512 KiB.
constexpr size_t kValuesPerMessage = 65536;

Time ToTime(const google::protobuf::Timestamp& stamp) {
  return Time(std::chrono::duration_cast<Time::duration>(std::chrono::seconds(stamp.seconds()) +
                                                         std::chrono::nanoseconds(stamp.nanos())));
}

template <typename Repeated>
auto ToVector(const Repeated& repeated) {
  return std::vector<std::decay_t<decltype(repeated.Get(0))>>(repeated.begin(), repeated.end());
}

std::vector<Channel> ToChannels(const google::protobuf::RepeatedPtrField<v1::Channel>& messages) {
  std::vector<Channel> channels;
  for (const auto& message : messages) channels.push_back({message.name(), message.unit()});
  return channels;
}

void AddChannels(const std::vector<Channel>& channels,
                 google::protobuf::RepeatedPtrField<v1::Channel>* messages) {
  for (const Channel& channel : channels) {
    auto* message = messages->Add();
    message->set_name(channel.name);
    message->set_unit(channel.unit);
  }
}

OutputErrors ToErrors(const v1::HeldOutErrors::Rmse& message) {
  return {ToVector(message.one_step()), ToVector(message.simulate())};
}

void AddRows(const std::vector<double>& values, size_t width, size_t first, size_t rows,
             google::protobuf::RepeatedField<double>* message) {
  const auto begin = values.begin() + static_cast<ptrdiff_t>(first * width);
  message->Add(begin, begin + static_cast<ptrdiff_t>(rows * width));
}

}  // namespace

ServerInfo FromProto(const v1::ServerInfo& message) {
  const auto& data = message.data_directory();
  return {.version = message.version(),
          .start_time = ToTime(message.start_time()),
          .data_format_version = data.format_version(),
          .stored_bytes = data.stored_bytes(),
          .free_disk_bytes = data.has_free_disk_bytes() ? std::optional(data.free_disk_bytes()) : std::nullopt,
          .problems = {data.problems().begin(), data.problems().end()},
          .models = data.model_count(),
          .model_versions = data.model_version_count(),
          .adaptations = data.adaptation_count(),
          .sessions = data.session_count(),
          .queued_jobs = data.queued_job_count(),
          .running_jobs = data.running_job_count(),
          .ended_jobs = data.ended_job_count()};
}

Token FromProto(const v1::Token& message) {
  Token token;
  token.id = Segment(message.name(), 1);
  token.tenant = message.tenant();
  token.scope = static_cast<Scope>(std::max(0, static_cast<int>(message.scope()) - 1));
  token.note = message.note();
  token.create_time = ToTime(message.create_time());
  if (message.has_expire_time()) token.expire_time = ToTime(message.expire_time());
  if (message.has_revoke_time()) token.revoke_time = ToTime(message.revoke_time());
  return token;
}

MetricFamily FromProto(const v1::MetricFamily& message) {
  MetricFamily family{.name = message.name(), .help = message.help(), .metrics = {}};
  for (const v1::Metric& given : message.metrics()) {
    Metric& metric = family.metrics.emplace_back();
    metric.labels.insert(given.labels().begin(), given.labels().end());
    metric.value = given.value();
    if (!given.has_histogram()) continue;
    const auto& histogram = given.histogram();
    metric.histogram = {histogram.count(),
                        histogram.sum(),
                        {histogram.upper_bounds().begin(), histogram.upper_bounds().end()},
                        {histogram.cumulative_counts().begin(), histogram.cumulative_counts().end()}};
  }
  return family;
}

BackupInfo FromProto(const v1::CreateBackupResponse::Header& message) {
  return {message.server_version(), message.data_format_version(), ToTime(message.create_time()), message.file_count(),
          message.size_bytes()};
}

AuditEntry FromProto(const v1::AuditEntry& message) {
  return {message.number(),   ToTime(message.time()), message.tenant(), message.identity(),
          message.action(),   message.resource(),     message.detail()};
}

Model FromProto(const v1::Model& message) {
  Model model{.name = Segment(message.name(), 1),
              .latest_version = message.latest_version(),
              .version_count = message.version_count(),
              .create_time = ToTime(message.create_time())};
  for (const auto& alias : message.aliases()) {
    model.aliases.push_back({Segment(alias.name(), 3), alias.version()});
  }
  return model;
}

ModelVersion FromProto(const v1::ModelVersion& message) {
  ModelVersion version{
      .model = Segment(message.name(), 1),
      .version = VersionOf(message.name()),
      .create_time = ToTime(message.create_time()),
      .size_bytes = message.size_bytes(),
      .sha256 = message.sha256(),
      .spec = PrintText(message.spec()),
      .estimates_states = message.spec().model().case_() == v1::ModelSpec::STATE_INPUT_OUTPUT,
      .channels = {ToChannels(message.channels().inputs()),
                   ToChannels(message.channels().outputs()),
                   ToChannels(message.channels().states())},
      .sample_period_s = message.sample_period_s(),
      .parameter_count = message.parameter_count(),
      .training_job = Segment(message.training_job(), 1)};
  if (message.has_validation_loss()) version.validation_loss = message.validation_loss();
  return version;
}

TrainingProgress FromProto(const v1::TrainingProgress& message) {
  TrainingProgress progress{.iteration = message.iteration(),
                            .iterations = message.iterations(),
                            .message = message.message()};
  if (message.has_training_loss()) progress.training_loss = message.training_loss();
  if (message.has_validation_loss()) progress.validation_loss = message.validation_loss();
  if (message.has_best_validation_loss()) {
    progress.best_validation_loss = message.best_validation_loss();
  }
  if (message.has_time_left_s()) progress.time_left_s = message.time_left_s();
  return progress;
}

JobState FromProto(v1::Job::State state) {
  switch (state) {
    case v1::Job::QUEUED:
      return JobState::kQueued;
    case v1::Job::RUNNING:
      return JobState::kRunning;
    case v1::Job::SUCCEEDED:
      return JobState::kSucceeded;
    case v1::Job::FAILED:
      return JobState::kFailed;
    case v1::Job::CANCELLED:
      return JobState::kCancelled;
    default:
      return JobState::kUnknown;
  }
}

Job FromProto(const v1::Job& message) {
  Job job{.id = Segment(message.name(), 1),
          .model = Segment(message.model(), 1),
          .spec = PrintText(message.spec()),
          .state = FromProto(message.state()),
          .error_message = message.error_message(),
          .attempt = message.attempt(),
          .create_time = ToTime(message.create_time()),
          .start_time = ToTime(message.start_time()),
          .end_time = ToTime(message.end_time())};
  if (message.has_progress()) job.progress = FromProto(message.progress());
  if (!message.model_version().empty()) job.model_version = VersionOf(message.model_version());
  return job;
}

Adaptation FromProto(const v1::Adaptation& message) {
  Adaptation adaptation{.id = Segment(message.name(), 1),
                        .model = Segment(message.model_version(), 1),
                        .model_version = VersionOf(message.model_version()),
                        .inner_loop = {.adapted_mask = message.inner_loop().adapted_mask()},
                        .seed = message.seed(),
                        .context_samples = message.context_samples(),
                        .context_loss_before = message.context_loss_before(),
                        .context_loss_after = message.context_loss_after(),
                        .duration_s = message.duration_s(),
                        .create_time = ToTime(message.create_time())};
  switch (message.method()) {
    case v1::Adaptation::ADAM:
      adaptation.method = AdaptationMethod::kAdam;
      break;
    case v1::Adaptation::FROM_SCRATCH:
      adaptation.method = AdaptationMethod::kFromScratch;
      break;
    case v1::Adaptation::LEVENBERG_MARQUARDT:
      adaptation.method = AdaptationMethod::kLevenbergMarquardt;
      break;
    default:
      break;
  }
  const auto& loop = message.inner_loop();
  if (loop.has_steps()) adaptation.inner_loop.steps = loop.steps();
  if (loop.has_learning_rate()) adaptation.inner_loop.learning_rate = loop.learning_rate();
  if (message.has_held_out()) {
    const auto& held_out = message.held_out();
    adaptation.held_out = {held_out.samples(), ToErrors(held_out.before()),
                           ToErrors(held_out.after()), ToErrors(held_out.arx()),
                           held_out.better_than_unadapted(), held_out.better_than_arx()};
  }
  return adaptation;
}

SessionInfo FromProto(const v1::SessionOpened& message) {
  SessionInfo info{.session = Segment(message.session(), 1),
                   .token = message.token(),
                   .epoch = message.epoch(),
                   .durable_seq = message.durable_seq(),
                   .model = Segment(message.model_version(), 1),
                   .model_version = VersionOf(message.model_version()),
                   .adaptation = Segment(message.adaptation(), 1),
                   .input_size = message.input_size(),
                   .output_size = message.output_size(),
                   .estimate_size = message.estimate_size(),
                   .estimated = ToChannels(message.estimated()),
                   .sample_period_s = message.sample_period_s(),
                   .send_innovations = message.send_innovations(),
                   .constrained = message.constrained()};
  if (message.covariance_format() == v1::OpenSession::DIAGONAL) {
    info.covariance = CovarianceFormat::kDiagonal;
  }
  if (message.covariance_format() == v1::OpenSession::LOWER_TRIANGLE) {
    info.covariance = CovarianceFormat::kLowerTriangle;
  }
  return info;
}

EstimateBatch FromProto(const v1::EstimateBatch& message) {
  EstimateBatch batch{.forecast = false,
                      .first_seq = message.first_seq(),
                      .durable_seq = message.durable_seq(),
                      .samples = static_cast<size_t>(message.nis_size()),
                      .times_s = ToVector(message.times_s()),
                      .means = ToVector(message.means()),
                      .covariances = ToVector(message.covariances()),
                      .innovations = ToVector(message.innovations()),
                      .innovation_covs = ToVector(message.innovation_covs()),
                      .nis = ToVector(message.nis()),
                      .flags = ToVector(message.flags()),
                      .slacks = ToVector(message.slacks()),
                      .projections = ToVector(message.projections())};
  for (const int health : message.health()) {
    // The numbers are the same on both sides.
    batch.health.push_back(health <= v1::EstimateBatch::UNDERCONFIDENT ? static_cast<Health>(health)
                                                                 : Health::kUnknown);
  }
  return batch;
}

NoiseSettings FromProto(const v1::NoiseSettings& message) {
  return {ToVector(message.process_noise_cov()), ToVector(message.measurement_noise_cov()),
          ToVector(message.initial_mean()), ToVector(message.initial_cov())};
}

void ToProto(const GateSettings& gate, v1::GateSettings* message) {
  message->set_probability(gate.probability);
  message->set_recover_after(gate.recover_after);
  message->set_off(gate.off);
}

void ToProto(const Channels& channels, v1::Channels* message) {
  AddChannels(channels.inputs, message->mutable_inputs());
  AddChannels(channels.outputs, message->mutable_outputs());
  AddChannels(channels.states, message->mutable_states());
}

void ToProto(const NoiseSettings& noise, v1::NoiseSettings* message) {
  const auto add = [](const std::vector<double>& values, auto* field) {
    field->Add(values.begin(), values.end());
  };
  add(noise.process_noise_cov, message->mutable_process_noise_cov());
  add(noise.measurement_noise_cov, message->mutable_measurement_noise_cov());
  add(noise.initial_mean, message->mutable_initial_mean());
  add(noise.initial_cov, message->mutable_initial_cov());
}

void ToProto(const InnerLoop& inner_loop, v1::InnerLoopSpec* message) {
  if (inner_loop.steps) message->set_steps(*inner_loop.steps);
  if (inner_loop.learning_rate) message->set_learning_rate(*inner_loop.learning_rate);
  message->set_adapted_mask(inner_loop.adapted_mask);
}

v1::Adaptation::Method ToProto(std::optional<AdaptationMethod> method) {
  if (!method) return v1::Adaptation::METHOD_UNSPECIFIED;
  switch (*method) {
    case AdaptationMethod::kAdam:
      return v1::Adaptation::ADAM;
    case AdaptationMethod::kFromScratch:
      return v1::Adaptation::FROM_SCRATCH;
    case AdaptationMethod::kLevenbergMarquardt:
      return v1::Adaptation::LEVENBERG_MARQUARDT;
    default:
      return v1::Adaptation::GRADIENT_DESCENT;
  }
}

v1::OpenSession::CovarianceFormat ToProto(CovarianceFormat format) {
  switch (format) {
    case CovarianceFormat::kDiagonal:
      return v1::OpenSession::DIAGONAL;
    case CovarianceFormat::kLowerTriangle:
      return v1::OpenSession::LOWER_TRIANGLE;
    default:
      return v1::OpenSession::NONE;
  }
}

Status SendSamples(const Trajectory& trajectory, const std::function<bool(v1::Samples)>& send) {
  const size_t samples = trajectory.samples;
  size_t width = 0;
  for (const auto* matrix : {&trajectory.inputs, &trajectory.outputs, &trajectory.states}) {
    if (samples == 0 || matrix->size() % samples != 0) {
      return Error(Code::kInvalidArgument, "trajectory \"" + trajectory.name +
                                               "\": " + std::to_string(matrix->size()) +
                                               " values are no whole number of rows of " +
                                               std::to_string(samples) + " samples");
    }
    width += matrix->size() / samples;
  }
  const size_t most = std::max<size_t>(1, kValuesPerMessage / std::max<size_t>(1, width));
  for (size_t first = 0; first < samples; first += most) {
    const size_t rows = std::min(most, samples - first);
    v1::Samples message;
    message.set_trajectory(trajectory.name);
    message.set_sample_count(static_cast<uint32_t>(rows));
    message.set_sample_period_s(trajectory.sample_period_s);
    message.set_start_time_s(trajectory.start_time_s);
    AddRows(trajectory.inputs, trajectory.inputs.size() / samples, first, rows,
            message.mutable_inputs());
    AddRows(trajectory.outputs, trajectory.outputs.size() / samples, first, rows,
            message.mutable_outputs());
    AddRows(trajectory.states, trajectory.states.size() / samples, first, rows,
            message.mutable_states());
    if (!send(std::move(message))) break;
  }
  return {};
}

}  // namespace metaekf::client
