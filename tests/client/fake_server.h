#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "metaekf/v1/adaptation.pb.h"
#include "metaekf/v1/estimation.pb.h"
#include "metaekf/v1/model.pb.h"
#include "metaekf/v1/prediction.pb.h"
#include "metaekf/v1/smoothing.pb.h"
#include "metaekf/v1/server_info.pb.h"
#include "metaekf/v1/training.pb.h"

/// A server that speaks the protocol and whose answers can be worked out by hand. Every member may
/// be changed before a call and read after it.
namespace metaekf::testing {

/// The model vdp, versions 1 and 2, alias stable = 1: input u1, output y1 in m, 0.5 s, Case I.
struct FakeModels {
  FakeModels();

  v1::Model model;
  v1::ModelVersion version;
  v1::ImportModelVersionRequest::Header import_header;
  std::string file;  // the one last imported, which is exported
  v1::ModelAlias set_alias;
  std::string asked_version, deleted;
};

/// Job 7, which runs in three iterations to its end state while it is watched.
struct FakeTraining {
  FakeTraining();

  v1::Job job;
  v1::Job::State end_state = v1::Job::SUCCEEDED;
  v1::CreateTrainingJobRequest::Header header;
  std::vector<v1::Samples> messages;
  // With what a new job is refused, if the code is not 0: a detail of google.rpc goes along.
  int refusal_code = 0;
  std::string refusal_message;
  std::shared_ptr<google::protobuf::Message> refusal_detail;
};

/// The adaptation "new" of vdp@2, made in two steps from four samples or more. Errors one step
/// ahead and in free run: before 0.5, 0.75; after 0.125, 0.25; ARX 0.0625, 0.5.
struct FakeAdaptations {
  static constexpr uint32_t kSamplesNeeded = 4;
  FakeAdaptations();
  static void SetErrors(double one_step, double simulate, v1::HeldOutErrors::Rmse* errors);

  v1::Adaptation adaptation;
  v1::AdaptRequest::Options options;
  v1::Samples context;  // the last message
  std::string deleted;
};

/// One step: ŷ_t = y_{t−1}. Free run: ŷ_t = y_0. One warm-up sample, one output; states likewise
/// where there are any.
struct FakePredictions {
  v1::PredictRequest::Header header;
  std::vector<v1::Samples> messages;
};

/// The estimate is y where it was measured, else the one before; its variance 0.25, its NIS 1.5.
/// Session 5 with token "secret".
struct FakeEstimation {
  v1::OpenSession open;
  v1::Channel estimated;
  std::vector<v1::SampleBatch> batches;
  std::string secret = "secret";
  uint64_t epoch = 0;
  uint64_t durable_seq = 0;
  double last_mean = 0;
  bool make_durable = false;   // every answered batch but the latest
  int stop_after_batches = 0;       // 0: never
  int then_stop_after_batches = 0;  // each time after the first
};

/// Estimates as those of FakeEstimation, all in one response.
struct FakeSmoothing {
  v1::SmoothRequest::Header header;
  v1::Channel estimated;
};

struct FakeInfo {
  FakeInfo();
  v1::ServerInfo info;
};

class FakeServer {
 public:
  FakeServer();
  ~FakeServer();

  /// Ends all calls at once.
  void Stop();
  /// HOST:PORT
  const std::string& address() const { return address_; }
  /// Serves a connection that somebody else has accepted.
  void Serve(int connection);

  FakeModels models;
  FakeTraining training;
  FakeAdaptations adaptations;
  FakePredictions predictions;
  FakeEstimation estimation;
  FakeSmoothing smoothing;
  FakeInfo info;

 private:
  struct Services;
  std::unique_ptr<Services> services_;
  std::string address_;
};

}  // namespace metaekf::testing
