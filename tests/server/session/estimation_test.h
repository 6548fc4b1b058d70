#pragma once

#include <grpcpp/grpcpp.h>

#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/rng.h"
#include "core/filter/ekf.h"
#include "metaekf/v1/estimation.grpc.pb.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {

inline constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

using Stream = grpc::ClientReaderWriter<v1::EstimateRequest, v1::EstimateResponse>;

/// A recording with missing values: one input, one output.
struct Recording {
  std::vector<double> inputs, outputs;
};

inline Recording MakeRecording(int samples, double missing_share) {
  base::Rng rng(4);
  Recording recording;
  double y = 0;
  for (int t = 0; t < samples; ++t) {
    const double u = rng.Normal();
    recording.inputs.push_back(u);
    recording.outputs.push_back(rng.Uniform() < missing_share ? kNaN : y + 0.01 * rng.Normal());
    y = 0.8 * y + 0.3 * u;
  }
  return recording;
}

/// All estimates of a session, one value after the other: mean, covariance and NIS of every sample.
using Estimates = std::vector<double>;

/// Streams of samples against a server in this process, beside the filter itself.
class EstimationTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Connect();
    bundle_ = TinyStateBundle();
    Import("tiny", *bundle_);
  }

  void Connect() {
    stub_ = v1::EstimationService::NewStub(grpc::CreateChannel(server_->address(), grpc::InsecureChannelCredentials()));
  }

  /// A stream with its first request written.
  struct Call {
    std::unique_ptr<grpc::ClientContext> context = std::make_unique<grpc::ClientContext>();
    std::unique_ptr<Stream> stream;
  };

  Call Start(const v1::EstimateRequest& first) {
    Call call;
    call.context->set_deadline(std::chrono::system_clock::now() + std::chrono::minutes(1));
    call.stream = stub_->Estimate(call.context.get());
    call.stream->Write(first);
    return call;
  }

  static v1::EstimateRequest OpenRequest(const std::string& target = "models/tiny") {
    v1::EstimateRequest request;
    request.mutable_open()->set_target(target);
    request.mutable_open()->set_covariance_format(v1::OpenSession::LOWER_TRIANGLE);
    return request;
  }

  static v1::EstimateRequest ResumeRequest(const v1::SessionOpened& opened) {
    v1::EstimateRequest request;
    request.mutable_resume()->set_session(opened.session());
    request.mutable_resume()->set_token(opened.token());
    return request;
  }

  static v1::EstimateRequest Batch(const Recording& recording, uint64_t first_seq, size_t count) {
    v1::EstimateRequest request;
    v1::SampleBatch* batch = request.mutable_samples();
    batch->set_first_seq(first_seq);
    for (size_t t = first_seq - 1; t < std::min(first_seq - 1 + count, recording.inputs.size()); ++t) {
      batch->add_inputs(recording.inputs[t]);
      batch->add_outputs(recording.outputs[t]);
    }
    return request;
  }

  static v1::SessionOpened ReadOpened(Call& call) {
    v1::EstimateResponse response;
    EXPECT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
    return response.opened();
  }

  static void Append(const v1::EstimateBatch& batch, Estimates* estimates) {
    const int rows = batch.nis_size();
    const int n = rows > 0 ? batch.means_size() / rows : 0, triangle = rows > 0 ? batch.covariances_size() / rows : 0;
    for (int row = 0; row < rows; ++row) {
      for (int i = 0; i < n; ++i) estimates->push_back(batch.means(row * n + i));
      for (int i = 0; i < triangle; ++i) estimates->push_back(batch.covariances(row * triangle + i));
      estimates->push_back(batch.nis(row));
    }
  }

  /// Sends samples first_seq … last and collects what comes back.
  static Estimates Run(Call& call, const Recording& recording, uint64_t first_seq, size_t last, size_t per_message) {
    Estimates estimates;
    v1::EstimateResponse response;
    for (uint64_t seq = first_seq; seq <= last; seq += per_message) {
      call.stream->Write(Batch(recording, seq, std::min(per_message, last - seq + 1)));
      EXPECT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
      EXPECT_EQ(response.estimates().first_seq(), seq);
      Append(response.estimates(), &estimates);
    }
    return estimates;
  }

  static grpc::Status End(Call& call) {
    call.stream->WritesDone();
    v1::EstimateResponse response;
    while (call.stream->Read(&response)) continue;
    return call.stream->Finish();
  }

  /// What the filter says that is called directly.
  Estimates Direct(const Recording& recording) const {
    const std::shared_ptr<filter::FilterModel> model = filter::FilterModel::Create(*bundle_);
    filter::Ekf ekf = *filter::Ekf::Create(*bundle_, model, model->Prepare(bundle_->parameters), {});
    const auto scratch = model->MakeScratch();
    filter::Estimate estimate = ekf.MakeEstimate();
    Estimates estimates;
    for (size_t t = 0; t < recording.inputs.size(); ++t) {
      EXPECT_TRUE(ekf.Step(Eigen::VectorXd::Constant(1, recording.inputs[t]),
                           Eigen::VectorXd::Constant(1, recording.outputs[t]), scratch.get(), &estimate).ok());
      for (const double value : estimate.mean) estimates.push_back(value);
      for (Eigen::Index i = 0; i < estimate.cov.rows(); ++i) {
        for (Eigen::Index j = 0; j <= i; ++j) estimates.push_back(estimate.cov(i, j));
      }
      estimates.push_back(estimate.nis);
    }
    return estimates;
  }

  static void ExpectIdentical(const Estimates& a, const Estimates& b) {
    ASSERT_EQ(a.size(), b.size());
    for (size_t i = 0; i < a.size(); ++i) {
      ASSERT_TRUE(a[i] == b[i] || (std::isnan(a[i]) && std::isnan(b[i]))) << "value " << i << ": " << a[i] << ", " << b[i];
    }
  }

  std::optional<nssm::Bundle> bundle_;
  std::unique_ptr<v1::EstimationService::Stub> stub_;
};

}  // namespace metaekf::server
