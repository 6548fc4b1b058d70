// The models that ship: each must load, and still do what deploy/zoo/README.md says of it.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>

#include "core/base/executor.h"
#include "core/data/split.h"
#include "core/experiments/filter_run.h"
#include "core/experiments/localization_data.h"
#include "core/meta/adapt.h"
#include "core/nssm/model_file.h"
#include "core/nssm/predict.h"
#include "core/sim/simulate.h"

namespace metaekf {
namespace {

using data::Trajectory;

const std::string kZoo = std::string(METAEKF_SOURCE_DIR) + "/deploy/zoo";

std::string Contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream bytes;
  bytes << file.rdbuf();
  return bytes.str();
}

Trajectory Simulated(const std::string& system, uint64_t seed, std::optional<int64_t> steps,
                     const std::map<std::string, std::string>& settings) {
  const auto executor = base::MakeThreadExecutor(1);
  const auto fleet = sim::Simulate(
      {.system = system, .systems = 1, .seed = seed, .steps = steps, .settings = settings}, *executor);
  EXPECT_TRUE(fleet.ok()) << fleet.status();
  return fleet->dataset.trajectories[0];
}

TEST(ZooTest, EveryModelLoadsAndSaysHowItWasMade) {
  int models = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kZoo)) {
    if (entry.path().extension() != ".safetensors") continue;
    ++models;
    const auto bundle = nssm::ReadModelFile(Contents(entry.path()));
    ASSERT_TRUE(bundle.ok()) << entry.path() << ": " << bundle.status();
    EXPECT_TRUE(meta::DefaultAdaptation(*bundle).ok()) << entry.path();
    EXPECT_TRUE(bundle->training->contains("seed")) << entry.path();
  }
  EXPECT_GE(models, 1);
}

/// Root mean square errors in m, one step ahead and in free run, on a noise-free multisine of the nominal oscillator, after
/// adaptation to the first samples of another, noisy one.
struct BoucWenErrors {
  double one_step, simulate;
};

BoucWenErrors AdaptedBoucWen(int64_t samples) {
  const auto bundle = nssm::ReadModelFile(Contents(kZoo + "/bouc-wen.safetensors"));
  EXPECT_TRUE(bundle.ok()) << bundle.status();
  const Trajectory context =
      *data::FirstSamples(Simulated("bouc-wen", 4242, {}, {{"nominal", "1"}, {"noise_std", "7.5e-6"}}), samples);
  const Trajectory test = Simulated("bouc-wen", 4243, {}, {{"nominal", "1"}, {"period", "2048"}});
  const auto adapted = meta::AdaptedBundle(*bundle, context, *meta::DefaultAdaptation(*bundle));
  EXPECT_TRUE(adapted.ok()) << adapted.status();
  const auto error = [&](nssm::PredictionMode mode) {
    return nssm::ScorePredictions({test.outputs}, {nssm::Predict(*adapted, test, mode)->outputs}).rmse[0];
  };
  return {error(nssm::PredictionMode::kOneStep), error(nssm::PredictionMode::kSimulate)};
}

// The limits are those that the project has set itself for the measured signal.
TEST(ZooTest, BoucWenAdaptsToFiveHundredSamples) { EXPECT_LE(AdaptedBoucWen(500).simulate, 1.2e-5); }

TEST(ZooTest, BoucWenAdaptsToOnePeriod) {
  const BoucWenErrors errors = AdaptedBoucWen(8192);
  EXPECT_LE(errors.simulate, 3.5e-6);
  EXPECT_LE(errors.one_step, 3.5e-6);
}

/// Sum of squared errors of both states over 3,000 samples in free run, after adaptation to the first 400 noisy ones.
double AdaptedVanDerPol(uint64_t seed) {
  const auto bundle = nssm::ReadModelFile(Contents(kZoo + "/van-der-pol.safetensors"));
  EXPECT_TRUE(bundle.ok()) << bundle.status();
  const Trajectory noisy = Simulated("van-der-pol", seed, 3400, {{"noise_std", "0.005"}});
  const Trajectory clean = Simulated("van-der-pol", seed, 3400, {});
  const auto adapted = meta::AdaptedBundle(*bundle, *data::FirstSamples(noisy, 400), *meta::DefaultAdaptation(*bundle));
  EXPECT_TRUE(adapted.ok()) << adapted.status();
  const Trajectory later = *data::SamplesFrom(clean, 399);
  const Eigen::MatrixXd states = nssm::Predict(*adapted, later, nssm::PredictionMode::kSimulate)->states;
  return (states - later.states).rightCols(3000).squaredNorm();
}

// From noisy samples, where the best of the supervised and transferred models lies near 9,000 even without noise.
TEST(ZooTest, VanDerPolAdaptsToFourHundredSamples) {
  std::vector<double> errors;
  for (uint64_t seed = 4242; seed < 4249; ++seed) errors.push_back(AdaptedVanDerPol(seed));
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 1000);
}

/// Of vehicles that the model has not seen, adapted to the first 8 s of a drive: Σ ‖x̂ − x‖ over the 32 s that follow, the median, and the
/// share of the states within bounds of 95 %.
TEST(ZooTest, LocalizationFollowsVehiclesAndSaysHowWell) {
  const auto bundle = nssm::ReadModelFile(Contents(kZoo + "/localization.safetensors"));
  ASSERT_TRUE(bundle.ok()) << bundle.status();
  const std::shared_ptr<const filter::FilterModel> functions = filter::FilterModel::Create(*bundle);
  const auto executor = base::MakeThreadExecutor(1);
  const sim::Fleet fleet = *experiments::Vehicles(15, 4242, executor.get());
  std::vector<double> errors;
  double held = 0;
  for (const Trajectory& vehicle : fleet.dataset.trajectories) {
    const auto adapted = experiments::AdaptForFilter(*bundle, vehicle, experiments::kLocalizationContext);
    ASSERT_TRUE(adapted.ok()) << adapted.status();
    const auto run = experiments::FilterAfterContext(*adapted, functions, vehicle, experiments::kLocalizationContext);
    ASSERT_TRUE(run.ok()) << run.status();
    const Eigen::MatrixXd off = experiments::StateErrors(run->means, vehicle.states.rightCols(run->means.cols()));
    errors.push_back(experiments::SummedError(off));
    held += experiments::Coverage(*run, off, 1.96) / static_cast<double>(fleet.dataset.trajectories.size());
  }
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 208.0 / 3);  // 208: dead reckoning with the true geometry (core/experiments/README.md)
  EXPECT_GT(held, 0.9);
  EXPECT_LT(held, 0.99);
}

/// Root mean square error of the states in their deviations over the fleet, behind the context.
double RelativeError(const nssm::Bundle& bundle, const experiments::FilterRun& run, const Trajectory& truth) {
  const Eigen::VectorXd inverse = bundle.normaliser.states.scale.cwiseInverse();
  const Eigen::MatrixXd off = inverse.asDiagonal() * (run.means - truth.states.rightCols(run.means.cols()));
  return std::sqrt(off.squaredNorm() / static_cast<double>(off.size()));
}

TEST(ZooTest, VaporCompressionGainsByAdaptingAndKeepsPressuresInOrder) {
  constexpr int64_t kContext = 200;
  const auto bundle = nssm::ReadModelFile(Contents(kZoo + "/vapor-compression.safetensors"));
  ASSERT_TRUE(bundle.ok()) << bundle.status();
  const std::shared_ptr<const filter::FilterModel> functions = filter::FilterModel::Create(*bundle);
  const Trajectory cycle =
      Simulated("vapor-compression", 4242, 700, {{"pressure_noise_std", "1000"}, {"temperature_noise_std", "0.1"}});
  const auto adapted = experiments::AdaptForFilter(*bundle, cycle, kContext);
  ASSERT_TRUE(adapted.ok()) << adapted.status();
  const auto with = experiments::FilterAfterContext(*adapted, functions, cycle, kContext);
  const auto without = experiments::FilterAfterContext(*bundle, functions, cycle, kContext);
  ASSERT_TRUE(with.ok()) << with.status();
  ASSERT_TRUE(without.ok()) << without.status();
  EXPECT_LT(RelativeError(*bundle, *with, cycle), RelativeError(*bundle, *without, cycle) / 2);
  const Eigen::MatrixXd rise = with->means.middleRows(1, 7) - with->means.topRows(7);  // along the flow, Pa
  EXPECT_LE(rise.maxCoeff(), 0);
}

}  // namespace
}  // namespace metaekf
