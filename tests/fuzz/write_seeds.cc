// Writes the seeds that are not text: models, MAT files, and a call of every method that does what it is for.
// Usage: write_seeds tests/fuzz/seeds

#include <google/protobuf/message.h>
#include <google/protobuf/text_format.h>
#include <matio.h>

#include <algorithm>
#include <cstdio>
#include <fstream>

#include "core/nssm/model_file.h"
#include "metaekf/v1/model.pb.h"
#include "server/store/sha256.h"
#include "tests/fuzz/request_frames.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf {
namespace {

using google::protobuf::DescriptorPool;
using google::protobuf::MessageFactory;
using google::protobuf::TextFormat;

struct Seed {
  std::string file, method;
  std::vector<std::string> messages;  // as text
};

constexpr const char* kSamples =
    "samples { sample_count: 8 sample_period_s: 0.1 inputs: [0, 1, 0, -1, 0, 1, 0, -1] outputs: [0, 0, 0.3, 0.2, -0.1, 0, 0.2, 0.1] }";

std::vector<Seed> Seeds() {
  return {
      {"adapt", "AdaptationService/Adapt", {"options { model: 'models/io' inner_loop { steps: 2 learning_rate: 0.01 } seed: 3 }", kSamples}},
      {"get_adaptation", "AdaptationService/GetAdaptation", {"name: 'adaptations/mine'"}},
      {"list_adaptations", "AdaptationService/ListAdaptations", {"page_size: 2"}},
      {"delete_adaptation", "AdaptationService/DeleteAdaptation", {"name: 'adaptations/a1'"}},
      {"create_token", "AdminService/CreateToken", {"tenant: 'plant' scope: READ lifetime { seconds: 60 } note: 'a press'"}},
      {"list_tokens", "AdminService/ListTokens", {""}},
      {"revoke_token", "AdminService/RevokeToken", {"name: 'tokens/t1'"}},
      {"list_audit", "AdminService/ListAuditEntries", {"page_size: 3 tenant: 'default'"}},
      {"backup", "AdminService/CreateBackup", {""}},
      {"estimate", "EstimationService/Estimate",
       {"open { target: 'models/states' covariance_format: LOWER_TRIANGLE send_innovations: true max_lag_s: 0.5 "
        "noise { process_noise_cov: [0.1, 0.1] measurement_noise_cov: [0.01] initial_mean: [0, 0] initial_cov: [1, 1] } "
        "gate { probability: 0.99 recover_after: 3 } }",
        "samples { first_seq: 1 inputs: [0, 1] outputs: [0.1, nan] times_s: [0, 0.1] }",
        "samples { first_seq: 3 inputs: [0] outputs: [5] times_s: [0.1] measurement_noise_covs: [0.2] received_seq: 2 }",
        "forecast { horizon: 5 inputs: [0, 1, 0, 1, 0] }"}},
      {"estimate_window", "EstimationService/Estimate",
       {"open { target: 'models/io' covariance_format: DIAGONAL }",
        "samples { first_seq: 1 inputs: [0, 1, 0, 1, 0, 1] outputs: [0, 0.1, 0, 0.2, 1, 0] }"}},
      {"resume", "EstimationService/Estimate", {"resume { session: 'sessions/1' token: 'guess' }"}},
      {"get_session", "EstimationService/GetSession", {"name: 'sessions/1'"}},
      {"list_sessions", "EstimationService/ListSessions", {"page_size: 2"}},
      {"delete_session", "EstimationService/DeleteSession", {"name: 'sessions/1'"}},
      {"list_models", "ModelService/ListModels", {"page_size: 1"}},
      {"get_model", "ModelService/GetModel", {"name: 'models/io'"}},
      {"list_versions", "ModelService/ListModelVersions", {"parent: 'models/io' page_size: 1"}},
      {"get_version", "ModelService/GetModelVersion", {"name: 'models/io/versions/1'"}},
      {"export", "ModelService/ExportModelVersion", {"name: 'models/io'"}},
      {"set_alias", "ModelService/SetModelAlias", {"alias { name: 'models/io/aliases/live' version: 1 }"}},
      {"delete_alias", "ModelService/DeleteModelAlias", {"name: 'models/io/aliases/live'"}},
      {"delete_version", "ModelService/DeleteModelVersion", {"name: 'models/seed/versions/1'"}},
      {"predict", "PredictionService/Predict", {"header { target: 'adaptations/mine' mode: SIMULATE }", kSamples}},
      {"predict_channels", "PredictionService/Predict",
       {"header { target: 'models/io' mode: ONE_STEP channels { inputs { name: 'u1' } outputs { name: 'y1' } } }", kSamples}},
      {"info", "ServerService/GetServerInfo", {"verify_files: true"}},
      {"metrics", "ServerService/GetMetrics", {""}},
      {"smooth", "SmoothingService/Smooth", {"header { target: 'models/states' covariance_format: DIAGONAL initial_samples: 3 }", kSamples}},
      {"train", "TrainingService/CreateTrainingJob",
       {"header { model: 'models/made' spec { context_samples: 4 loss { horizon: 2 } "
        "model { case: INPUT_OUTPUT latent_size: 2 window: 2 transition { block { hidden_widths: 2 } } } iterations: 2 } }",
        kSamples}},
      {"get_job", "TrainingService/GetJob", {"name: 'jobs/1'"}},
      {"list_jobs", "TrainingService/ListJobs", {"page_size: 2"}},
      {"watch_job", "TrainingService/WatchJob", {"name: 'jobs/1'"}},
      {"cancel_job", "TrainingService/CancelJob", {"name: 'jobs/1'"}},
  };
}

void WriteFile(const std::string& path, const std::string& bytes) { std::ofstream(path, std::ios::binary) << bytes; }

void WriteMat(const std::string& path, matio_compression compression) {
  mat_t* file = Mat_CreateVer(path.c_str(), "seed", MAT_FT_MAT5);
  double u[6] = {1, 2, 3, 4, 5, 6};
  float t[3] = {0, 0.1F, 0.2F};
  int16_t y[3] = {-1, 0, 1};
  size_t wide[2] = {3, 2}, lying[2] = {1, 3}, standing[2] = {3, 1};
  for (matvar_t* array : {Mat_VarCreate("u", MAT_C_DOUBLE, MAT_T_DOUBLE, 2, wide, u, 0), Mat_VarCreate("t", MAT_C_SINGLE, MAT_T_SINGLE, 2, lying, t, 0),
                          Mat_VarCreate("y", MAT_C_INT16, MAT_T_INT16, 2, standing, y, 0)}) {
    Mat_VarWrite(file, array, compression);
    Mat_VarFree(array);
  }
  Mat_Close(file);
}

int WriteRequests(const std::string& directory) {
  const std::vector<std::string> methods = testing::AllMethods();
  std::vector<bool> called(methods.size());
  const auto write = [&](const std::string& file, const std::string& method, const std::vector<std::string>& messages) {
    const auto number = static_cast<size_t>(std::find(methods.begin(), methods.end(), "/metaekf.v1." + method) - methods.begin());
    if (number == methods.size()) return false;
    called[number] = true;
    WriteFile(directory + "/" + file, testing::ToFrames(number, messages));
    return true;
  };
  for (const Seed& seed : Seeds()) {
    std::string name = "metaekf.v1." + seed.method;
    std::replace(name.begin(), name.end(), '/', '.');
    const auto* method = DescriptorPool::generated_pool()->FindMethodByName(name);
    std::vector<std::string> messages;
    for (const std::string& text : seed.messages) {
      if (method == nullptr) break;
      const std::unique_ptr<google::protobuf::Message> message(
          MessageFactory::generated_factory()->GetPrototype(method->input_type())->New());
      if (!TextFormat::ParseFromString(text, message.get())) return std::fprintf(stderr, "%s: not a message\n", seed.file.c_str()), 1;
      messages.push_back(message->SerializeAsString());
    }
    if (!write(seed.file, seed.method, messages)) return std::fprintf(stderr, "%s: no such method\n", seed.file.c_str()), 1;
  }
  const std::string model = nssm::WriteModelFile(server::TinyBundle());
  v1::ImportModelVersionRequest header, chunk;
  header.mutable_header()->set_parent("models/seed");
  header.mutable_header()->set_size_bytes(model.size());
  header.mutable_header()->set_sha256(store::Sha256Hex(model));
  chunk.set_chunk(model);
  write("import", "ModelService/ImportModelVersion", {header.SerializeAsString(), chunk.SerializeAsString()});
  for (size_t m = 0; m < methods.size(); ++m) {
    if (!called[m]) return std::fprintf(stderr, "no seed calls %s\n", methods[m].c_str()), 1;
  }
  return 0;
}

}  // namespace
}  // namespace metaekf

int main(int argc, char** argv) {
  if (argc != 2) return std::fprintf(stderr, "usage: write_seeds DIRECTORY\n"), 2;
  const std::string seeds = argv[1];
  metaekf::WriteFile(seeds + "/model_file/io", metaekf::nssm::WriteModelFile(metaekf::server::TinyBundle()));
  metaekf::WriteFile(seeds + "/model_file/states", metaekf::nssm::WriteModelFile(metaekf::server::TinyStateBundle()));
  metaekf::WriteMat(seeds + "/mat/plain", MAT_COMPRESSION_NONE);
  metaekf::WriteMat(seeds + "/mat/compressed", MAT_COMPRESSION_ZLIB);
  return metaekf::WriteRequests(seeds + "/requests");
}
