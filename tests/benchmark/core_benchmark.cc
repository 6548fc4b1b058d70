// See README.md beside this file.

#include <sys/resource.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <functional>
#include <map>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include "core/base/json_fields.h"
#include "core/filter/ekf.h"
#include "core/meta/meta_gradient.h"
#include "tests/benchmark/networks.h"
#include "tests/benchmark/report.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf {
namespace {

constexpr int kRounds = 3;  // beside a peer

double MedianSeconds(int repeats, const std::function<void()>& work) {
  work();
  std::vector<double> seconds;
  for (int i = 0; i < repeats; ++i) {
    const auto start = std::chrono::steady_clock::now();
    work();
    seconds.push_back(std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return benchmark::Median(std::move(seconds));
}

/// Filters of so many adaptations that have all but their decoders in common.
class EkfSteps {
 public:
  explicit EkfSteps(size_t filters) {
    nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(benchmark::LocalisationSpec()));
    bundle.parameters = bundle.model.InitialParameters(1);
    model_ = filter::FilterModel::Create(bundle);
    scratch_ = model_->MakeScratch();
    const std::shared_ptr<const filter::FilterModel::Parameters> base = model_->Prepare(bundle.parameters);
    const nn::Mask adapted = *nn::ParseMask("*_decoder", bundle.model.layout());
    for (size_t i = 0; i < filters; ++i) {
      std::vector<double> own = bundle.parameters;
      for (const auto& [offset, size] : nn::PiecesOf(bundle.model.layout(), adapted, true)) {
        for (int64_t k = offset; k < offset + size; ++k) own[static_cast<size_t>(k)] *= 1 + 1e-3 * static_cast<double>(i + 1);
      }
      filters_.push_back(*filter::Ekf::Create(bundle, model_, model_->Prepare(own, Eigen::MatrixXd(), base.get()), {}));
      estimates_.push_back(filters_.back().MakeEstimate());
    }
    for (size_t i = 0; i < filters; ++i) samples_.push_back({&filters_[i], u_.data(), y_.data(), nullptr, &estimates_[i], absl::OkStatus()});
    StepTogether();  // the first step has no time update
  }

  void StepEach() {
    for (filter::NextSample& sample : samples_) filter::StepTogether({&sample, 1}, scratch_.get());
  }
  void StepTogether() { filter::StepTogether(std::span<filter::NextSample>(samples_), scratch_.get()); }

 private:
  const Eigen::VectorXd u_ = Eigen::VectorXd::Constant(3, 0.3), y_ = Eigen::VectorXd::Constant(2, 0.1);
  std::shared_ptr<const filter::FilterModel> model_;
  std::unique_ptr<filter::FilterModel::Scratch> scratch_;
  std::vector<filter::Ekf> filters_;
  std::vector<filter::Estimate> estimates_;
  std::vector<filter::NextSample> samples_;
};

struct MetaSeconds {
  double adapt, maml, fomaml;
};

MetaSeconds LocalisationLearning() {
  constexpr int kSamples = 81;  // 80 one-step predictions
  constexpr int kSteps = 10;
  const nssm::ModelSpec spec = benchmark::LocalisationSpec();
  const nssm::Model model = *nssm::Model::Create(spec);
  const nssm::LossSpec loss{.horizon = 1, .rollout = nssm::RolloutMode::kState};
  const nssm::LossShape shape = *nssm::ShapeOfLoss(spec, loss, kSamples);
  const data::Trajectory trajectory = nssm::RandomTrajectory(spec, 2 * kSamples, 1);
  const auto context = nssm::CutLossData<float>(spec, loss, trajectory, 0, shape);
  const auto target = nssm::CutLossData<float>(spec, loss, trajectory, kSamples, shape);
  const std::vector<double> initial = model.InitialParameters(1);
  const std::vector<float> parameters(initial.begin(), initial.end());
  const int64_t size = model.layout().size();

  MetaSeconds seconds{};
  const nn::Mask adapted = *nn::ParseMask("encoder.5-6,transition,*_decoder", model.layout());
  const nssm::LossFunction<float> context_loss(model, loss, shape, adapted, adapted);
  const auto executor = base::MakeThreadExecutor(std::max(1U, std::thread::hardware_concurrency()));
  auto scratch = context_loss.MakeScratch(executor.get());
  std::vector<float> gradient(static_cast<size_t>(size));
  const meta::InnerLoop<float> loop(model.layout(), adapted, meta::Optimiser::kGradientDescent, kSteps, 0,
                                    meta::InnerRecord::kResult);
  meta::InnerLoop<float>::Trace trace(loop, false, executor.get());
  const std::vector<double> rates(loop.tensors(), 1e-6);
  const auto context_gradient = [&](const float* at, float* result) { context_loss.Gradient(at, context, result, &scratch); };
  seconds.adapt = MedianSeconds(7, [&] { loop.Run(parameters.data(), rates, context_gradient, &trace); });
  const nn::Mask all(model.layout().tensors().size(), true);
  for (const bool second_order : {true, false}) {
    meta::TrainingSpec training{.loss = loss};
    training.algorithm = second_order ? meta::Algorithm::kMaml : meta::Algorithm::kFirstOrderMaml;
    training.inner_loop = {.steps = kSteps, .learning_rate = 1e-3};
    const meta::MetaGradient<float> meta(model, training, shape, shape, all);
    meta::MetaGradient<float>::Scratch meta_scratch(meta, executor.get());
    (second_order ? seconds.maml : seconds.fomaml) = MedianSeconds(
        5, [&] { meta.Compute(parameters.data(), context, target, gradient.data(), &meta_scratch); });
  }
  return seconds;
}

double SmallRolloutSeconds() {
  benchmark::SmallRollout rollout(4096);
  return MedianSeconds(51, [&] { rollout.ComputeGradient(); });
}

double PeakRssMib() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<double>(usage.ru_maxrss) / 1024;
}

/// The JSON that the peer prints, or null if it cannot be run.
nlohmann::json RunPeer(const std::string& script) {
  std::string text;
  if (FILE* pipe = popen(("/usr/bin/python3 '" + script + "'").c_str(), "r")) {
    std::array<char, 4096> buffer;
    while (const size_t got = fread(buffer.data(), 1, buffer.size(), pipe)) text.append(buffer.data(), got);
    if (pclose(pipe) != 0) text.clear();
  }
  nlohmann::json result;
  return base::ParseJson(text, &result).ok() ? result["best"] : nlohmann::json();
}

int Main(const std::string& peer_script, const std::string& json) {
  std::map<std::string, std::vector<double>> ours, peers;
  std::vector<double> one_by_one, together;
  for (int round = 0; round < (peer_script.empty() ? 1 : kRounds); ++round) {
    const MetaSeconds learning = LocalisationLearning();
    {
      EkfSteps one(1);
      ours["ekf_step_us"].push_back(1e6 * MedianSeconds(2000, [&] { one.StepEach(); }));
    }
    ours["adapt_ms"].push_back(1e3 * learning.adapt);
    ours["maml_ms"].push_back(1e3 * learning.maml);
    ours["fomaml_ms"].push_back(1e3 * learning.fomaml);
    ours["rollout_grad_ms"].push_back(1e3 * SmallRolloutSeconds());
    if (round == 0) ours["peak_rss_mib"].push_back(PeakRssMib());  // of what the peer does, too
    EkfSteps eight(8);
    one_by_one.push_back(1e6 * MedianSeconds(250, [&] { eight.StepEach(); }));
    together.push_back(1e6 * MedianSeconds(250, [&] { eight.StepTogether(); }));
    if (peer_script.empty()) break;
    const nlohmann::json peer = RunPeer(peer_script);
    if (peer.is_null()) {
      std::fprintf(stderr, "the peer could not be run (it needs Debian's python3-torch): its column is empty\n");
      break;
    }
    for (const auto& [key, value] : peer.items()) peers[key].push_back(value.get<double>());
  }
  std::vector<benchmark::Row> rows;
  const auto add = [&](const char* what, const char* unit, const std::string& key, const char* ratio_key) {
    const double own = benchmark::Median(ours[key]), peer = benchmark::Median(peers[key]);
    rows.push_back({what, unit, own, peer, peer / own, ratio_key});
  };
  add("EKF step", "µs", "ekf_step_us", "ekf_step");
  rows.push_back({"EKF steps of eight adaptations, together (beside: one by one)", "µs", benchmark::Median(together), benchmark::Median(one_by_one),
                  benchmark::Median(one_by_one) / benchmark::Median(together), ""});
  add("adaptation, M = 10, N = 80", "ms", "adapt_ms", "adapt");
  add("meta-gradient of one task, second order", "ms", "maml_ms", "maml");
  add("meta-gradient of one task, first order", "ms", "fomaml_ms", "fomaml");
  add("gradient of a small rollout, 4,096 steps", "ms", "rollout_grad_ms", "rollout_grad");
  add("peak memory of all of this", "MiB", "peak_rss_mib", "peak_memory");
  benchmark::Print("Compute", rows);
  if (json.empty() || benchmark::AddToJson(json, rows)) return 0;
  std::fprintf(stderr, "%s cannot be written\n", json.c_str());
  return 1;
}

}  // namespace
}  // namespace metaekf

int main(int argc, char** argv) {
  std::map<std::string, std::string> options = {{"--peer", ""}, {"--json", ""}};
  for (int i = 1; i + 1 < argc; i += 2) {
    if (const auto option = options.find(argv[i]); option != options.end()) option->second = argv[i + 1];
  }
  if (argc % 2 == 0 || argc > 5 || (argc > 1 && options["--peer"].empty() && options["--json"].empty())) {
    std::fprintf(stderr, "usage: %s [--peer SCRIPT] [--json FILE]\n", argv[0]);
    return 2;
  }
  return metaekf::Main(options["--peer"], options["--json"]);
}
