// See README.md beside this file.

#include <nlohmann/json.hpp>
#include <sys/resource.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <functional>
#include <limits>
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

constexpr int kRounds = 5;  // beside a peer
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

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

/// Learning the localisation network from 80 one-step predictions and judging it by as many.
class LocalisationLearning {
 public:
  LocalisationLearning() {
    const nssm::ModelSpec& spec = model_.spec();
    const data::Trajectory trajectory = nssm::RandomTrajectory(spec, 2 * kSamples, 1);
    context_ = nssm::CutLossData<float>(spec, kLoss, trajectory, 0, shape_);
    target_ = nssm::CutLossData<float>(spec, kLoss, trajectory, kSamples, shape_);
    const std::vector<double> initial = model_.InitialParameters(1);
    parameters_.assign(initial.begin(), initial.end());
  }

  double AdaptSeconds() const {
    const nn::Mask adapted = *nn::ParseMask("encoder.5-6,transition,*_decoder", model_.layout());
    const nssm::LossFunction<float> loss(model_, kLoss, shape_, adapted, adapted, nssm::HessianProducts::kNone);
    auto scratch = loss.MakeScratch(executor_.get());
    const meta::InnerLoop<float> loop(model_.layout(), adapted, meta::Optimiser::kGradientDescent, kSteps, 0,
                                      meta::InnerRecord::kResult);
    meta::InnerLoop<float>::Trace trace(loop, false, executor_.get());
    const std::vector<double> rates(loop.tensors(), 1e-6);
    const auto gradient = [&](int32_t, const float* at, float* result) { loss.Gradient(at, context_, result, &scratch); };
    return MedianSeconds(7, [&] { loop.Run(parameters_.data(), rates, gradient, &trace); });
  }

  double MetaGradientSeconds(meta::Algorithm algorithm) const {
    const nn::Mask all(model_.layout().tensors().size(), true);
    const meta::TrainingSpec training{.loss = kLoss, .algorithm = algorithm, .inner_loop = {.steps = kSteps, .learning_rate = 1e-3}};
    const meta::MetaGradient<float> meta(model_, training, shape_, shape_, all);
    meta::MetaGradient<float>::Scratch scratch(meta, executor_.get());
    std::vector<float> gradient(parameters_.size());
    return MedianSeconds(5, [&] { meta.Compute(parameters_.data(), context_, target_, gradient.data(), &scratch); });
  }

 private:
  static constexpr int kSamples = 81, kSteps = 10;
  inline static const nssm::LossSpec kLoss{.horizon = 1, .rollout = nssm::RolloutMode::kState};
  const nssm::Model model_ = *nssm::Model::Create(benchmark::LocalisationSpec());
  const nssm::LossShape shape_ = *nssm::ShapeOfLoss(model_.spec(), kLoss, kSamples);
  const std::unique_ptr<base::Executor> executor_ = base::MakeThreadExecutor(std::max(1U, std::thread::hardware_concurrency()));
  nssm::LossData<float> context_, target_;
  std::vector<float> parameters_;
};

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
  std::vector<double> one_by_one, together, orders;
  for (int round = 0; round < (peer_script.empty() ? 1 : kRounds); ++round) {
    {
      const LocalisationLearning learning;
      ours["adapt_ms"].push_back(1e3 * learning.AdaptSeconds());
      ours["maml_ms"].push_back(1e3 * learning.MetaGradientSeconds(meta::Algorithm::kMaml));
      ours["fomaml_ms"].push_back(1e3 * learning.MetaGradientSeconds(meta::Algorithm::kFirstOrderMaml));
      orders.push_back(ours["maml_ms"].back() / ours["fomaml_ms"].back());
    }
    {
      EkfSteps one(1);
      ours["ekf_step_us"].push_back(1e6 * MedianSeconds(2000, [&] { one.StepEach(); }));
    }
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
  rows.push_back({"  second order in times of first order", "", benchmark::Median(orders), kNaN, kNaN, ""});
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
