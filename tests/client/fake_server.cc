#include "tests/client/fake_server.h"

#include <grpcpp/grpcpp.h>
#include <grpcpp/server_posix.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "metaekf/v1/adaptation.grpc.pb.h"
#include "metaekf/v1/estimation.grpc.pb.h"
#include "metaekf/v1/model.grpc.pb.h"
#include "metaekf/v1/prediction.grpc.pb.h"
#include "metaekf/v1/smoothing.grpc.pb.h"
#include "metaekf/v1/server_info.grpc.pb.h"
#include "metaekf/v1/training.grpc.pb.h"

namespace metaekf::testing {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

grpc::Status NotFound(const std::string& kind, const std::string& name) {
  return {grpc::StatusCode::NOT_FOUND, "there is no " + kind + " '" + name + "'"};
}

/// An error with one detail, as the server sends it.
grpc::Status WithDetail(int code, const std::string& message,
                        const google::protobuf::Message& detail) {
  google::rpc::Status rich;
  rich.set_code(code);
  rich.set_message(message);
  rich.add_details()->PackFrom(detail);
  return {static_cast<grpc::StatusCode>(code), message, rich.SerializeAsString()};
}

class ModelService : public v1::ModelService::Service {
 public:
  explicit ModelService(FakeModels& fake) : fake_(fake) {}

  /// One model per page, so that clients must ask again.
  grpc::Status ListModels(grpc::ServerContext*, const v1::ListModelsRequest* request,
                          v1::ListModelsResponse* response) override {
    if (request->page_token().empty()) {
      *response->add_models() = fake_.model;
      response->set_next_page_token("second");
    } else {
      response->add_models()->set_name("models/" + request->page_token());
    }
    return grpc::Status::OK;
  }
  grpc::Status GetModel(grpc::ServerContext*, const v1::GetModelRequest* request,
                        v1::Model* response) override {
    if (request->name() != fake_.model.name()) return NotFound("model", request->name());
    *response = fake_.model;
    return grpc::Status::OK;
  }
  grpc::Status GetModelVersion(grpc::ServerContext*, const v1::GetModelVersionRequest* request,
                               v1::ModelVersion* response) override {
    fake_.asked_version = request->name();
    if (!request->name().starts_with(fake_.model.name())) return NotFound("model", request->name());
    *response = fake_.version;
    return grpc::Status::OK;
  }
  grpc::Status ListModelVersions(grpc::ServerContext*, const v1::ListModelVersionsRequest*,
                                 v1::ListModelVersionsResponse* response) override {
    *response->add_model_versions() = fake_.version;
    return grpc::Status::OK;
  }
  grpc::Status ImportModelVersion(grpc::ServerContext*,
                                  grpc::ServerReader<v1::ImportModelVersionRequest>* reader,
                                  v1::ModelVersion* response) override {
    v1::ImportModelVersionRequest request;
    reader->Read(&request);
    fake_.import_header = request.header();
    fake_.file.clear();
    while (reader->Read(&request)) fake_.file += request.chunk();
    *response = fake_.version;
    return grpc::Status::OK;
  }
  grpc::Status ExportModelVersion(
      grpc::ServerContext*, const v1::ExportModelVersionRequest*,
      grpc::ServerWriter<v1::ExportModelVersionResponse>* writer) override {
    v1::ExportModelVersionResponse response;
    *response.mutable_header() = fake_.version;
    response.mutable_header()->set_size_bytes(fake_.import_header.size_bytes());
    response.mutable_header()->set_sha256(fake_.import_header.sha256());
    writer->Write(response);
    const size_t half = fake_.file.size() / 2;
    for (const std::string& chunk : {fake_.file.substr(0, half), fake_.file.substr(half)}) {
      response.set_chunk(chunk);
      writer->Write(response);
    }
    return grpc::Status::OK;
  }
  grpc::Status SetModelAlias(grpc::ServerContext*, const v1::SetModelAliasRequest* request,
                             v1::ModelAlias* response) override {
    *response = fake_.set_alias = request->alias();
    return grpc::Status::OK;
  }
  grpc::Status DeleteModelAlias(grpc::ServerContext*, const v1::DeleteModelAliasRequest* request,
                                google::protobuf::Empty*) override {
    fake_.deleted = request->name();
    return grpc::Status::OK;
  }
  grpc::Status DeleteModelVersion(grpc::ServerContext*,
                                  const v1::DeleteModelVersionRequest* request,
                                  google::protobuf::Empty*) override {
    fake_.deleted = request->name();
    return grpc::Status::OK;
  }

 private:
  FakeModels& fake_;
};

class TrainingService : public v1::TrainingService::Service {
 public:
  explicit TrainingService(FakeTraining& fake) : fake_(fake) {}

  grpc::Status CreateTrainingJob(grpc::ServerContext*,
                                 grpc::ServerReader<v1::CreateTrainingJobRequest>* reader,
                                 v1::Job* response) override {
    v1::CreateTrainingJobRequest request;
    reader->Read(&request);
    fake_.header = request.header();
    fake_.messages.clear();
    while (reader->Read(&request)) fake_.messages.push_back(request.samples());
    if (fake_.refusal_code != 0) {
      return WithDetail(fake_.refusal_code, fake_.refusal_message, *fake_.refusal_detail);
    }
    *response = fake_.job;
    return grpc::Status::OK;
  }
  grpc::Status GetJob(grpc::ServerContext*, const v1::GetJobRequest* request,
                      v1::Job* response) override {
    if (request->name() != fake_.job.name()) return NotFound("job", request->name());
    *response = fake_.job;
    return grpc::Status::OK;
  }
  grpc::Status ListJobs(grpc::ServerContext*, const v1::ListJobsRequest*,
                        v1::ListJobsResponse* response) override {
    *response->add_jobs() = fake_.job;
    return grpc::Status::OK;
  }
  grpc::Status WatchJob(grpc::ServerContext*, const v1::WatchJobRequest*,
                        grpc::ServerWriter<v1::WatchJobResponse>* writer) override {
    v1::WatchJobResponse response;
    for (uint32_t iteration = 1; iteration <= 3; ++iteration) {
      response.set_state(iteration < 3 ? v1::Job::RUNNING : fake_.end_state);
      response.mutable_progress()->set_iteration(iteration);
      response.mutable_progress()->set_iterations(3);
      response.mutable_progress()->set_best_validation_loss(0.5 / iteration);
      if (!writer->Write(response)) return grpc::Status::CANCELLED;
    }
    *fake_.job.mutable_progress() = response.progress();
    fake_.job.set_state(fake_.end_state);
    if (fake_.end_state == v1::Job::SUCCEEDED) {
      fake_.job.set_model_version("models/vdp/versions/3");
    }
    if (fake_.end_state == v1::Job::FAILED) fake_.job.set_error_message("the loss diverged");
    return grpc::Status::OK;
  }
  grpc::Status CancelJob(grpc::ServerContext*, const v1::CancelJobRequest*,
                         v1::Job* response) override {
    fake_.job.set_state(v1::Job::CANCELLED);
    *response = fake_.job;
    return grpc::Status::OK;
  }

 private:
  FakeTraining& fake_;
};

class AdaptationService : public v1::AdaptationService::Service {
 public:
  explicit AdaptationService(FakeAdaptations& fake) : fake_(fake) {}

  grpc::Status Adapt(
      grpc::ServerContext*,
      grpc::ServerReaderWriter<v1::AdaptResponse, v1::AdaptRequest>* stream) override {
    v1::AdaptRequest request;
    stream->Read(&request);
    fake_.options = request.options();
    uint32_t samples = 0;
    while (stream->Read(&request)) {
      fake_.context = request.samples();
      samples += request.samples().sample_count();
    }
    if (samples < FakeAdaptations::kSamplesNeeded) {
      return {grpc::StatusCode::FAILED_PRECONDITION,
              "the context has " + std::to_string(samples) + " samples, the model needs " +
                  std::to_string(FakeAdaptations::kSamplesNeeded)};
    }
    v1::AdaptResponse response;
    for (uint32_t step = 1; step <= 2; ++step) {
      response.mutable_progress()->set_step(step);
      response.mutable_progress()->set_steps(2);
      response.mutable_progress()->set_loss(1.0 / step);
      if (!stream->Write(response)) return grpc::Status::CANCELLED;
    }
    fake_.adaptation.set_context_samples(samples);
    fake_.adaptation.set_method(fake_.options.method());
    *fake_.adaptation.mutable_inner_loop() = fake_.options.inner_loop();
    *response.mutable_result() = fake_.adaptation;
    stream->Write(response);
    return grpc::Status::OK;
  }
  grpc::Status GetAdaptation(grpc::ServerContext*, const v1::GetAdaptationRequest* request,
                             v1::Adaptation* response) override {
    if (request->name() != fake_.adaptation.name()) return NotFound("adaptation", request->name());
    *response = fake_.adaptation;
    return grpc::Status::OK;
  }
  grpc::Status ListAdaptations(grpc::ServerContext*, const v1::ListAdaptationsRequest*,
                               v1::ListAdaptationsResponse* response) override {
    *response->add_adaptations() = fake_.adaptation;
    return grpc::Status::OK;
  }
  grpc::Status DeleteAdaptation(grpc::ServerContext*, const v1::DeleteAdaptationRequest* request,
                                google::protobuf::Empty*) override {
    fake_.deleted = request->name();
    return grpc::Status::OK;
  }

 private:
  FakeAdaptations& fake_;
};

class PredictionService : public v1::PredictionService::Service {
 public:
  explicit PredictionService(FakePredictions& fake) : fake_(fake) {}

  grpc::Status Predict(
      grpc::ServerContext*,
      grpc::ServerReaderWriter<v1::PredictResponse, v1::PredictRequest>* stream) override {
    v1::PredictRequest request;
    stream->Read(&request);
    fake_.header = request.header();
    const bool one_step = fake_.header.mode() == v1::PredictRequest::ONE_STEP;
    uint64_t index = 0;
    double base = 0;  // what the next sample is predicted as
    for (std::string trajectory; stream->Read(&request);) {
      const v1::Samples& samples = request.samples();
      fake_.messages.push_back(samples);
      if (samples.trajectory() != trajectory) index = 0;
      trajectory = samples.trajectory();
      v1::PredictResponse response;
      response.set_trajectory(trajectory);
      response.set_first_sample(index);
      response.set_sample_count(samples.sample_count());
      response.set_warmup_samples(1);
      for (const double y : samples.outputs()) {
        response.add_outputs(index == 0 ? kNaN : base);
        if (one_step || index == 0) base = y;
        ++index;
      }
      for (const double x : samples.states()) response.add_states(x);
      stream->Write(response);
    }
    return grpc::Status::OK;
  }

 private:
  FakePredictions& fake_;
};

class SmoothingService : public v1::SmoothingService::Service {
 public:
  explicit SmoothingService(FakeSmoothing& fake) : fake_(fake) {}

  grpc::Status Smooth(grpc::ServerContext*,
                      grpc::ServerReaderWriter<v1::SmoothResponse, v1::SmoothRequest>* stream) override {
    v1::SmoothRequest request;
    stream->Read(&request);
    fake_.header = request.header();
    v1::SmoothResponse response;
    *response.add_estimated() = fake_.estimated;
    v1::EstimateBatch& estimates = *response.mutable_estimates();
    while (stream->Read(&request)) {
      response.set_trajectory(request.samples().trajectory());
      for (const double y : request.samples().outputs()) {
        estimates.add_times_s(0.5 * estimates.times_s_size());
        estimates.add_means(std::isnan(y) ? 7 : y);
        estimates.add_covariances(0.25);
        estimates.add_nis(1.5);
        estimates.add_health(v1::EstimateBatch::CONSISTENT);
        estimates.add_flags(std::isnan(y) ? v1::EstimateBatch::MISSING : v1::EstimateBatch::NO_FLAG);
      }
    }
    stream->Write(response);
    return grpc::Status::OK;
  }

 private:
  FakeSmoothing& fake_;
};

class EstimationService : public v1::EstimationService::Service {
 public:
  explicit EstimationService(FakeEstimation& fake) : fake_(fake) {}

  grpc::Status Estimate(
      grpc::ServerContext*,
      grpc::ServerReaderWriter<v1::EstimateResponse, v1::EstimateRequest>* stream) override {
    v1::EstimateRequest request;
    stream->Read(&request);
    if (request.has_open()) fake_.open = request.open();
    if (request.open().target() == "models/gone") return NotFound("model", "gone");
    if (request.has_resume() && request.resume().token() != fake_.secret) {
      return NotFound("session", request.resume().session());
    }
    stream->Write(Opened(request.has_open()));
    while (stream->Read(&request)) {
      if (request.has_forecast()) {
        v1::EstimateResponse response;
        for (uint32_t i = 0; i < request.forecast().horizon(); ++i) {
          response.mutable_forecast()->add_means(fake_.last_mean);
          response.mutable_forecast()->add_nis(kNaN);
        }
        stream->Write(response);
        continue;
      }
      fake_.batches.push_back(request.samples());
      stream->Write(Answer(request.samples()));
      if (fake_.stop_after_batches > 0 && --fake_.stop_after_batches == 0) {
        fake_.stop_after_batches = fake_.then_stop_after_batches;
        google::rpc::ErrorInfo info;
        info.set_reason("DRAINING");
        return WithDetail(grpc::StatusCode::UNAVAILABLE, "the server stops", info);
      }
    }
    return grpc::Status::OK;
  }

 private:
  v1::EstimateResponse Opened(bool with_token) {
    v1::EstimateResponse response;
    auto* opened = response.mutable_opened();
    opened->set_session("sessions/5");
    if (with_token) opened->set_token("secret");
    opened->set_epoch(++fake_.epoch);
    opened->set_durable_seq(fake_.durable_seq);
    opened->set_model_version("models/vdp/versions/2");
    opened->set_input_size(1);
    opened->set_output_size(1);
    opened->set_estimate_size(1);
    *opened->add_estimated() = fake_.estimated;
    opened->set_sample_period_s(0.5);
    opened->set_covariance_format(v1::OpenSession::DIAGONAL);
    return response;
  }
  v1::EstimateResponse Answer(const v1::SampleBatch& samples) {
    v1::EstimateResponse response;
    auto* batch = response.mutable_estimates();
    batch->set_first_seq(samples.first_seq());
    if (fake_.make_durable) {
      fake_.durable_seq = std::max(fake_.durable_seq, samples.first_seq() - 1);
    }
    batch->set_durable_seq(fake_.durable_seq);
    for (int i = 0; i < samples.outputs_size(); ++i) {
      const bool missing = std::isnan(samples.outputs(i));
      if (!missing) fake_.last_mean = samples.outputs(i);
      const double seq = static_cast<double>(samples.first_seq()) + i;
      batch->add_times_s(samples.times_s().empty() ? 0.5 * (seq - 1) : samples.times_s(i));
      batch->add_means(fake_.last_mean);
      batch->add_covariances(0.25);
      batch->add_nis(missing ? kNaN : 1.5);
      batch->add_health(v1::EstimateBatch::CONSISTENT);
      batch->add_flags(missing ? v1::EstimateBatch::MISSING : 0);
    }
    return response;
  }

  FakeEstimation& fake_;
};

class ServerService : public v1::ServerService::Service {
 public:
  explicit ServerService(FakeInfo& fake) : fake_(fake) {}
  grpc::Status GetServerInfo(grpc::ServerContext*, const v1::GetServerInfoRequest*,
                             v1::ServerInfo* response) override {
    *response = fake_.info;
    return grpc::Status::OK;
  }

 private:
  FakeInfo& fake_;
};

}  // namespace

FakeModels::FakeModels() {
  version.set_name("models/vdp/versions/2");
  version.mutable_spec()->mutable_model()->set_case_(v1::ModelSpec::INPUT_OUTPUT);
  version.set_sample_period_s(0.5);
  auto* output = version.mutable_channels()->add_outputs();
  output->set_name("y1");
  output->set_unit("m");
  version.mutable_channels()->add_inputs()->set_name("u1");
  version.mutable_create_time()->set_seconds(86400);
  model.set_name("models/vdp");
  model.set_latest_version(2);
  model.set_version_count(2);
  auto* alias = model.add_aliases();
  alias->set_name("models/vdp/aliases/stable");
  alias->set_version(1);
}

FakeTraining::FakeTraining() {
  job.set_name("jobs/7");
  job.set_model("models/vdp");
  job.set_state(v1::Job::QUEUED);
}

FakeAdaptations::FakeAdaptations() {
  adaptation.set_name("adaptations/new");
  adaptation.set_model_version("models/vdp/versions/2");
  auto* held_out = adaptation.mutable_held_out();
  held_out->set_samples(2);
  SetErrors(0.5, 0.75, held_out->mutable_before());
  SetErrors(0.125, 0.25, held_out->mutable_after());
  SetErrors(0.0625, 0.5, held_out->mutable_arx());
  held_out->set_better_than_unadapted(true);
  held_out->set_better_than_arx(true);
}

void FakeAdaptations::SetErrors(double one_step, double simulate, v1::HeldOutErrors::Rmse* errors) {
  errors->Clear();
  errors->add_one_step(one_step);
  errors->add_simulate(simulate);
}

FakeInfo::FakeInfo() {
  info.set_version("0.1.0");
  info.mutable_data_directory()->set_model_count(1);
  info.mutable_data_directory()->set_free_disk_bytes(50'000'000'000);
}

struct FakeServer::Services {
  explicit Services(FakeServer& fake)
      : models(fake.models),
        training(fake.training),
        adaptations(fake.adaptations),
        predictions(fake.predictions),
        estimation(fake.estimation),
        smoothing(fake.smoothing),
        info(fake.info) {}

  ModelService models;
  TrainingService training;
  AdaptationService adaptations;
  PredictionService predictions;
  EstimationService estimation;
  SmoothingService smoothing;
  ServerService info;
  std::unique_ptr<grpc::Server> server;
};

FakeServer::FakeServer() : services_(std::make_unique<Services>(*this)) {
  estimation.estimated = smoothing.estimated = models.version.channels().outputs(0);
  int port = 0;
  grpc::ServerBuilder builder;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  for (grpc::Service* service : std::initializer_list<grpc::Service*>{
           &services_->models, &services_->training, &services_->adaptations,
           &services_->predictions, &services_->estimation, &services_->smoothing, &services_->info}) {
    builder.RegisterService(service);
  }
  services_->server = builder.BuildAndStart();
  address_ = "127.0.0.1:" + std::to_string(port);
}

FakeServer::~FakeServer() { Stop(); }

void FakeServer::Serve(int connection) { grpc::AddInsecureChannelFromFd(services_->server.get(), connection); }

void FakeServer::Stop() { services_->server->Shutdown(std::chrono::system_clock::now()); }

}  // namespace metaekf::testing
