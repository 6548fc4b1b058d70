// Runs one hot path by name, for callgrind to count its instructions (check_instruction_counts).

#include <hwy/nanobenchmark.h>

#include <cstdio>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "core/meta/adapt.h"
#include "server/session/session.h"
#include "tests/benchmark/filter_steps.h"
#include "tests/benchmark/networks.h"
#include "tests/support/bundles.h"

/// What callgrind counts: it collects inside the function of this name only.
extern "C" [[gnu::noipa]] void MeasuredHotPath(const std::function<void()>& work) { work(); }

/// In the place of the library's, which it calls as it loads and nobody here needs: that one executes rdtscp, which valgrind refuses where
/// the processor does not announce it, as in some virtual machines.
uint64_t hwy::platform::TimerResolution() { return 1; }

namespace metaekf {
namespace {

using benchmark::Oscillation;
using benchmark::Simulated;
using benchmark::ZooModel;

void Steps(const nssm::Bundle& bundle, const Eigen::MatrixXd& outputs) {
  benchmark::FilterSteps filter(bundle, outputs);
  MeasuredHotPath([&] {
    for (Eigen::Index t = 1; t < outputs.cols(); ++t) filter.Step();
  });
}

void SmallStep() { Steps(ZooModel("van-der-pol"), Oscillation(201)); }

void LargeStep() {
  nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(benchmark::LocalisationSpec()));
  bundle.parameters = bundle.model.InitialParameters(1);
  Steps(bundle, Eigen::MatrixXd::Constant(2, 5, 0.1));
}

void RolloutGradient() {
  benchmark::SmallRollout rollout(512);
  rollout.ComputeGradient();
  MeasuredHotPath([&] { rollout.ComputeGradient(); });
}

/// Exact second-order fits under the learned prior.
void Adaptation() {
  const nssm::Bundle bundle = ZooModel("bouc-wen");
  const data::Trajectory context = Simulated("bouc-wen", 100, {{"nominal", "1"}, {"noise_std", "7.5e-6"}});
  const auto spec = meta::DefaultAdaptation(bundle).value();
  MeasuredHotPath([&] { (void)meta::AdaptedBundle(bundle, context, spec).value(); });
}

/// Reads so much that what was in the caches is no more, callgrind's too.
void EmptyCaches() {
  static std::vector<char> large(size_t{64} << 20);
  for (size_t i = 0; i < large.size(); i += 64) ++large[i];
}

/// A batch of a stream, from the bytes of its request to those of its response; once it has run, and again after `before`.
void Estimate(int samples, const std::function<void()>& before) {
  auto model = std::make_shared<server::ServedModel>(server::ServedModel{.bundle = ZooModel("van-der-pol")});
  model->filter_model = filter::FilterModel::Create(model->bundle);
  model->filter_parameters = model->filter_model->Prepare(model->bundle);
  const auto scratch = model->filter_model->MakeScratch();
  v1::OpenSession open;
  open.set_covariance_format(v1::OpenSession::DIAGONAL);
  const auto session = server::Session::Open(model, open).value();
  const Eigen::MatrixXd outputs = Oscillation(2 * samples);
  uint64_t next = 1;
  const auto apply = [&] {
    v1::EstimateRequest request;
    request.mutable_samples()->set_first_seq(next);
    const double* const from = outputs.col(static_cast<Eigen::Index>(next) - 1).data();
    request.mutable_samples()->mutable_outputs()->Add(from, from + outputs.rows() * samples);
    const std::string bytes = request.SerializeAsString();
    v1::EstimateRequest received;
    v1::EstimateResponse response;
    if (!received.ParseFromString(bytes) ||
        !session->Apply(received.samples(), false, scratch.get(), response.mutable_estimates()).ok()) {
      std::exit(1);
    }
    (void)response.SerializeAsString();
    next += static_cast<uint64_t>(samples);
  };
  apply();
  before();
  MeasuredHotPath(apply);
}

void EstimateBatch() { Estimate(64, [] {}); }

void EstimateCold() { Estimate(1, EmptyCaches); }

int Main(const std::string& name) {
  const std::map<std::string, std::function<void()>> paths = {{"ekf-step-small", SmallStep},
                                                              {"ekf-step-large", LargeStep},
                                                              {"rollout-gradient", RolloutGradient},
                                                              {"adaptation", Adaptation},
                                                              {"estimate-batch", EstimateBatch},
                                                              {"estimate-cold", EstimateCold}};
  const auto path = paths.find(name);
  if (path == paths.end()) {
    std::fprintf(stderr, "usage: hot_paths NAME, which is one of");
    for (const auto& [known, run] : paths) std::fprintf(stderr, " %s", known.c_str());
    std::fprintf(stderr, "\n");
    return 2;
  }
  path->second();
  return 0;
}

}  // namespace
}  // namespace metaekf

int main(int argc, char** argv) { return metaekf::Main(argc == 2 ? argv[1] : ""); }
