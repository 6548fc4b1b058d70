#pragma once

#include <fstream>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <utility>

#include "core/base/executor.h"
#include "core/data/split.h"
#include "core/filter/ekf.h"
#include "core/nssm/model_file.h"
#include "core/sim/simulate.h"

namespace metaekf::benchmark {

/// A model that ships.
inline nssm::Bundle ZooModel(const std::string& name) {
  std::ifstream file(METAEKF_SOURCE_DIR "/deploy/zoo/" + name + ".safetensors", std::ios::binary);
  std::ostringstream bytes;
  bytes << file.rdbuf();
  return nssm::ReadModelFile(bytes.str()).value();
}

inline data::Trajectory Simulated(const std::string& system, int64_t steps, const std::map<std::string, std::string>& settings) {
  const auto executor = base::MakeThreadExecutor(1);
  return sim::Simulate({.system = system, .systems = 1, .seed = 1, .steps = steps, .settings = settings}, *executor)
      .value()
      .dataset.trajectories[0];
}

/// What the van der Pol model that ships is for; a column per step.
inline Eigen::MatrixXd Oscillation(int64_t steps) { return Simulated("van-der-pol", steps, {{"noise_std", "0.005"}}).outputs; }

/// A filter that takes the columns of `outputs` one after the other, and again from the first on.
class FilterSteps {
 public:
  FilterSteps(const nssm::Bundle& bundle, Eigen::MatrixXd outputs)
      : model_(filter::FilterModel::Create(bundle)),
        ekf_(filter::Ekf::Create(bundle, model_, model_->Prepare(bundle), {}).value()),
        scratch_(model_->MakeScratch()),
        estimate_(ekf_.MakeEstimate()),
        input_(Eigen::VectorXd::Constant(ekf_.input_size(), 0.3)),
        outputs_(std::move(outputs)) {
    Step();  // the first has no time update
  }

  void Step() {
    (void)ekf_.Step(input_, outputs_.col(next_), scratch_.get(), &estimate_);
    if (++next_ == outputs_.cols()) next_ = 0;
  }

 private:
  std::shared_ptr<const filter::FilterModel> model_;
  filter::Ekf ekf_;
  std::unique_ptr<filter::FilterModel::Scratch> scratch_;
  filter::Estimate estimate_;
  Eigen::VectorXd input_;
  Eigen::MatrixXd outputs_;
  Eigen::Index next_ = 0;
};

}  // namespace metaekf::benchmark
