#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "core/nssm/model_file.h"
#include "core/nssm/predict.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::nssm {
namespace {

using ::testing::HasSubstr;
using nlohmann::json;

absl::StatusOr<ModelSpec> Read(const json& constraints) {
  json spec = {{"case", "STATE_INPUT_OUTPUT"}, {"latent_size", 2}, {"input_size", 1}, {"output_size", 1}, {"state_size", 2}};
  spec.merge_patch(constraints);
  return ReadModelSpec(base::JsonFields(spec, "model"));
}

TEST(ConstraintSpecTest, WhatIsWrittenReadsBack) {
  const json order = {{"polyhedron", {{"matrix", {-1, 1}}, {"bounds", {0.5}}}}}, quadrant = {{"polyhedron", {{"rays", {1, 0, 0, 1}}}}};
  for (const json& constraint : {order, quadrant}) {
    const absl::StatusOr<ModelSpec> spec = Read({{"state_constraint", constraint}});
    ASSERT_TRUE(spec.ok()) << spec.status();
    EXPECT_EQ(ToJson(*spec)["state_constraint"], constraint);
    EXPECT_EQ(ToJson(*ReadModelSpec(base::JsonFields(ToJson(*spec), "model"))), ToJson(*spec));
  }
}

TEST(ConstraintSpecTest, WhatIsWrongIsNamed) {
  const auto message = [](const json& constraints) { return std::string(Read(constraints).status().message()); };
  const auto state = [](const json& polyhedron) { return json{{"state_constraint", {{"polyhedron", polyhedron}}}}; };
  EXPECT_THAT(message(state({{"matrix", {1, 2, 3}}})), HasSubstr("model.state_constraint.polyhedron: matrix: 3 numbers"));
  EXPECT_THAT(message(state({{"matrix", {1, 2}}, {"bounds", {1, 2}}})), HasSubstr("bounds: 2 for 1 rows"));
  EXPECT_THAT(message(state({{"matrix", {1, 0, -1, 0}}, {"bounds", {1, -2}}})), HasSubstr("row 2 excludes"));
  EXPECT_THAT(message(state({{"matrix", {1, 0}}, {"rays", {1, 0}}})), HasSubstr("model.state_constraint.polyhedron.rays"));
  const json both = {{"curl_free", {{"position_states", {0, 1}}}}, {"polyhedron", {{"matrix", {1}}}}};
  EXPECT_THAT(message({{"output_constraint", both}}), HasSubstr("model.output_constraint.polyhedron: stands instead of curl_free"));
  EXPECT_THAT(message(state(json::object())), HasSubstr("model.state_constraint.polyhedron.matrix"));
  EXPECT_THAT(message({{"state_constraint", {{"curl_free", {{"position_states", {0, 1}}}}}}}), HasSubstr("model.state_constraint.curl_free"));
  EXPECT_THAT(message({{"case", "INPUT_OUTPUT"}, {"state_size", 0}, {"state_constraint", {{"polyhedron", {{"rays", {1}}}}}}}),
              HasSubstr("model.state_constraint"));
}

TEST(SpecTest, OnlySwishHasABeta) {
  const auto message = [](const json& decoder) { return std::string(Read({{"output_decoder", decoder}}).status().message()); };
  EXPECT_EQ(message({{"hidden_widths", {3}}, {"activation", "SWISH"}, {"activation_parameter", 0.5}, {"trained_beta", true}}), "");
  EXPECT_THAT(message({{"hidden_widths", {3}}, {"activation", "TANH"}, {"trained_beta", true}}), HasSubstr("model.output_decoder.trained_beta"));
  EXPECT_THAT(message({{"hidden_widths", {3}}, {"activation", "SWISH"}, {"activation_parameter", -1}}), HasSubstr("model.output_decoder.activation_parameter"));
}

TEST(SpecTest, AnglesAreStatesThatExist) {
  const auto message = [](const json& angles) { return std::string(Read({{"angle_states", angles}}).status().message()); };
  EXPECT_EQ(message({1}), "");
  EXPECT_EQ(ToJson(*Read({{"angle_states", {1}}}))["angle_states"], json({1}));
  EXPECT_THAT(message({2}), HasSubstr("angle_states: state 2 does not exist"));
  EXPECT_THAT(message({0, 0}), HasSubstr("state 0 stands there twice"));
  EXPECT_THAT(std::string(Read({{"case", "INPUT_OUTPUT"}, {"state_size", 0}, {"angle_states", {0}}}).status().message()), HasSubstr("angle_states"));
}

// A file gives the layer its units back: the same parameters give the same predictions.
TEST(ConstraintSpecTest, AModelFileKeepsTheConstraint) {
  for (const ModelCase& c : ModelCases()) {
    if (c.model.state_set.empty() && c.model.output_set.empty()) continue;
    data::Normaliser normaliser = support::UnitBundle(*Model::Create(c.model)).normaliser;
    normaliser.outputs = {Eigen::Vector2d(0.3, -0.4), Eigen::Vector2d(2, 0.5)};
    if (!c.model.is_case_one()) normaliser.states = {Eigen::Vector2d(5, 4), Eigen::Vector2d(0.5, 3)};
    ModelSpec spec = c.model;
    TakeUnits(normaliser, &spec);
    Bundle bundle = support::UnitBundle(*Model::Create(spec));
    bundle.normaliser = normaliser;
    bundle.parameters = RandomParameters(bundle.model, 3);
    const absl::StatusOr<Bundle> read = ReadModelFile(WriteModelFile(bundle));
    ASSERT_TRUE(read.ok()) << c.name << ": " << read.status();
    const data::Trajectory t = RandomTrajectory(c.model, 20, 4);
    const Prediction before = *Predict(bundle, t, PredictionMode::kOneStep), after = *Predict(*read, t, PredictionMode::kOneStep);
    const Eigen::Index from = c.model.warmup();
    EXPECT_EQ(before.outputs.rightCols(20 - from), after.outputs.rightCols(20 - from)) << c.name;
  }
}

}  // namespace
}  // namespace metaekf::nssm
