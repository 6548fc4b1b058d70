#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

#include "core/filter/replay.h"
#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Every kind of model, with layers that are large enough to be packed.
nssm::ModelSpec Large(nssm::ModelSpec spec, nssm::Precision precision) {
  for (nn::BlockSpec* block : {&spec.encoder, &spec.transition.block, &spec.state_decoder, &spec.output_decoder}) {
    if (!block->hidden_widths.empty()) block->hidden_widths = {70, 130, 70};
  }
  spec.precision = precision;
  return spec;
}

/// Parameters of a model and what may become of them when it is adapted.
struct Adaptations {
  explicit Adaptations(const nssm::Bundle& bundle) : model(FilterModel::Create(bundle)) {
    const nn::ParameterLayout& layout = bundle.model.layout();
    base::Rng rng(8);
    const auto changed = [&](double share) {
      std::vector<double> values = bundle.parameters;
      for (const nn::Tensor& tensor : layout.tensors()) {
        if (static_cast<double>(tensor.offset) < (1 - share) * static_cast<double>(layout.size())) continue;
        for (int64_t i = 0; i < tensor.size(); ++i) values[static_cast<size_t>(tensor.offset + i)] += 1e-2 * rng.Normal();
      }
      nssm::RoundToPrecision(bundle.model.spec().precision, &values);
      return values;
    };
    MatrixXd unknown = MatrixXd::Zero(layout.size(), 2);
    const nn::Tensor& last = layout.tensors().back();
    unknown.middleRows(last.offset, last.size()).setConstant(1e-3);
    const std::shared_ptr<const FilterModel::Parameters> base = model->Prepare(bundle.parameters);
    all = {base, base, model->Prepare(changed(0.3), MatrixXd(), base.get()), model->Prepare(changed(0.3), MatrixXd(), base.get()),
           model->Prepare(changed(0.3), unknown, base.get()), model->Prepare(changed(1), MatrixXd(), base.get())};
    while (all.size() < 11) all.push_back(all[all.size() - 4]);
  }

  std::shared_ptr<FilterModel> model;
  std::vector<std::shared_ptr<const FilterModel::Parameters>> all;
};

void ExpectSame(const Estimate& a, const Estimate& b) {
  const auto same = [](const MatrixXd& x, const MatrixXd& y) {
    return std::equal(x.reshaped().begin(), x.reshaped().end(), y.reshaped().begin(),
                      [](double left, double right) { return left == right || (std::isnan(left) && std::isnan(right)); });
  };
  EXPECT_TRUE(same(a.mean, b.mean));
  EXPECT_TRUE(same(a.cov, b.cov));
  EXPECT_TRUE(same(a.innovation, b.innovation));
  EXPECT_TRUE(same(a.innovation_cov, b.innovation_cov));
  EXPECT_EQ(a.health, b.health);
}

// Filters that begin at different times, miss measurements and are given nonsense, together and each alone.
TEST(StepTogetherTest, FiltersDoToTheBitWhatTheyDoAlone) {
  for (const auto precision : {nssm::Precision::kFloat32, nssm::Precision::kFloat64}) {
    for (const nssm::ModelCase& c : nssm::ModelCases()) {
      SCOPED_TRACE(c.name);
      nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(Large(c.model, precision)));
      bundle.parameters = nssm::RandomParameters(bundle.model, 3);
      for (double& value : bundle.parameters) value *= 0.2;
      nssm::RoundToPrecision(precision, &bundle.parameters);
      const Adaptations adaptations(bundle);
      EXPECT_EQ(adaptations.model->is_large(), c.name != "Case I, linear blocks");
      const size_t count = adaptations.all.size();
      std::vector<ReplayFilter> together, alone;
      for (size_t i = 0; i < count; ++i) {
        for (auto* filters : {&together, &alone}) {
          filters->emplace_back(*Ekf::Create(bundle, adaptations.model, adaptations.all[i], {}), static_cast<int64_t>(i % 2));
        }
      }
      std::vector<Estimate> estimates(count, together.front().ekf().MakeEstimate());
      Estimate estimate = estimates.front();
      const auto scratch = adaptations.model->MakeScratch(), other_scratch = adaptations.model->MakeScratch();
      base::Rng rng(2);
      const MatrixXd R = 0.3 * MatrixXd::Identity(c.model.output_size, c.model.output_size);
      for (size_t t = 0; t < 8; ++t) {
        std::vector<VectorXd> inputs(count), outputs(count);
        std::vector<NextReplaySample> samples;
        for (size_t i = t == 0 ? 3 : 0; i < count; ++i) {
          inputs[i] = RandomVector(&rng, c.model.input_size);
          outputs[i] = RandomVector(&rng, c.model.output_size);
          if ((t + i) % 5 == 4) outputs[i].head(1 + static_cast<Eigen::Index>(i % 2)).setConstant(std::numeric_limits<double>::quiet_NaN());
          if (t == 5 && i == 1) outputs[i][0] = std::numeric_limits<double>::infinity();
          samples.push_back({&together[i], inputs[i].data(), outputs[i].data(), i % 3 == 0 ? &R : nullptr, &estimates[i], absl::OkStatus()});
        }
        StepTogether(std::span<NextReplaySample>(samples), scratch.get());
        for (const NextReplaySample& sample : samples) {
          const size_t i = static_cast<size_t>(sample.filter - together.data());
          SCOPED_TRACE(i);
          const absl::Status status = alone[i].Step(inputs[i], outputs[i], other_scratch.get(), &estimate, i % 3 == 0 ? &R : nullptr);
          EXPECT_EQ(sample.status, status);
          EXPECT_EQ(status.ok(), t != 5 || i != 1);
          EXPECT_EQ(together[i].remembered(), alone[i].remembered());
          if (status.ok()) ExpectSame(estimates[i], estimate);
        }
      }
    }
  }
}

}  // namespace
}  // namespace metaekf::filter
