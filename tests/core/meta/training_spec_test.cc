#include "core/meta/training_spec.h"

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

namespace metaekf::meta {
namespace {

using nlohmann::json;

json WithModel(json spec) {
  spec["model"] = {{"case", "INPUT_OUTPUT"}, {"latent_size", 2}};
  return spec;
}

TEST(TrainingSpecTest, EveryAlgorithmIsReadAndWritten) {
  for (const char* name : {"MAML", "FIRST_ORDER_MAML", "SUPERVISED", "GAUSSIAN_PRIOR", "REPTILE", "IMPLICIT_MAML"}) {
    const auto spec = ReadTrainingSpec(WithModel({{"algorithm", name}}));
    ASSERT_TRUE(spec.ok()) << spec.status();
    EXPECT_EQ(ToJson(*spec)["algorithm"], name);
  }
}

TEST(TrainingSpecTest, WhatIsWrittenReadsBack) {
  const json inner = {{"learned_rates", true}, {"optimiser", "ADAM"}, {"tensor_rates", {{"encoder.0.weight", 0.5}}}};
  const json spec = WithModel({{"inner_loop", inner},
                               {"implicit_maml", {{"cg_steps", 7}, {"cg_tolerance", 0.125}}},
                               {"restarts", 3},
                               {"screening_iterations", 40}});
  const auto read = ReadTrainingSpec(spec);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_TRUE(read->inner_loop.learned_rates);
  EXPECT_TRUE(read->adaptation.learned_rates);
  EXPECT_EQ(read->inner_loop.tensor_rates.at("encoder.0.weight"), 0.5);
  EXPECT_EQ(read->implicit_maml.cg_steps, 7);
  EXPECT_EQ(read->restarts, 3);
  EXPECT_EQ(read->screening_iterations, 40);
  EXPECT_EQ(ToJson(*ReadTrainingSpec(ToJson(*read))), ToJson(*read));
}

TEST(TrainingSpecTest, ImplicitMamlTakesLevenbergMarquardtAndSoDoesItsAdaptation) {
  const json inner = {{"optimiser", "LEVENBERG_MARQUARDT"}, {"steps", 20}, {"proximal", 0.5}};
  const auto spec = ReadTrainingSpec(WithModel({{"algorithm", "IMPLICIT_MAML"}, {"inner_loop", inner}}));
  ASSERT_TRUE(spec.ok()) << spec.status();
  EXPECT_EQ(spec->adaptation.optimiser, Optimiser::kLevenbergMarquardt);
  EXPECT_EQ(spec->adaptation.steps, 20);
  EXPECT_EQ(spec->adaptation.proximal, 0.5);
}

TEST(TrainingSpecTest, EveryStructureOfAPriorsCovarianceIsReadAndWritten) {
  for (const auto& [name, rank] : {std::pair{"FULL", 0}, {"LOW_RANK", 3}, {"BLOCK", 0}, {"MANIFOLD", 2}}) {
    const auto spec = ReadTrainingSpec(WithModel({{"gaussian_prior", {{"covariance", name}, {"rank", rank}}}}));
    ASSERT_TRUE(spec.ok()) << spec.status();
    EXPECT_EQ(spec->gaussian_prior.rank, rank);
    EXPECT_EQ(ToJson(*spec)["gaussian_prior"]["covariance"], name);
    EXPECT_EQ(ToJson(*ReadTrainingSpec(ToJson(*spec))), ToJson(*spec));
  }
  EXPECT_EQ(ReadTrainingSpec(WithModel({}))->gaussian_prior.covariance, PriorCovariance::kFull);
}

TEST(TrainingSpecTest, AdaptationTakesItsRatesFromTheInnerLoopUnlessItHasItsOwn) {
  const json inner = {{"learned_rates", true}, {"tensor_rates", {{"a", 1}}}};
  const auto own = ReadTrainingSpec(WithModel({{"inner_loop", inner}, {"adaptation", {{"tensor_rates", {{"b", 2}}}}}}));
  EXPECT_EQ(own->adaptation.tensor_rates, (std::map<std::string, double>{{"b", 2}}));
  // The rates of one optimiser are nothing to another.
  const auto other = ReadTrainingSpec(WithModel({{"inner_loop", inner}, {"adaptation", {{"optimiser", "ADAM"}}}}));
  EXPECT_TRUE(other->adaptation.tensor_rates.empty());
  EXPECT_FALSE(other->adaptation.learned_rates);
}

TEST(TrainingSpecTest, WhatAnAlgorithmCannotUseIsRefusedByName) {
  const auto expect_refused = [](const json& spec, const std::string& field) {
    const std::string message(ReadTrainingSpec(WithModel(spec)).status().message());
    EXPECT_EQ(message.rfind(field + ": ", 0), 0u) << message;
  };
  const json learned = {{"learned_rates", true}};
  expect_refused({{"algorithm", "REPTILE"}, {"inner_loop", learned}}, "inner_loop.learned_rates");
  expect_refused({{"algorithm", "REPTILE"}, {"inner_loop", {{"steps", 0}}}}, "inner_loop.steps");
  expect_refused({{"algorithm", "IMPLICIT_MAML"}, {"inner_loop", {{"proximal", 0}}}}, "inner_loop.proximal");
  const json least_squares = {{"optimiser", "LEVENBERG_MARQUARDT"}};
  for (const char* name : {"MAML", "FIRST_ORDER_MAML", "SUPERVISED", "GAUSSIAN_PRIOR", "REPTILE"}) {
    expect_refused({{"algorithm", name}, {"inner_loop", least_squares}}, "inner_loop.optimiser");
  }
  expect_refused({{"algorithm", "IMPLICIT_MAML"}, {"inner_loop", least_squares}, {"loss", {{"reconstruction_weight", 0.5}}}},
                 "loss.reconstruction_weight");
  expect_refused({{"inner_loop", {{"learned_rates", true}, {"learning_rate", 0}}}}, "inner_loop.learning_rate");
  expect_refused({{"inner_loop", {{"curvature_rates", true}}}}, "inner_loop.curvature_rates");
  expect_refused({{"inner_loop", {{"curvature_rates", true}, {"learned_rates", true}, {"optimiser", "ADAM"}}}},
                 "inner_loop.curvature_rates");
  expect_refused({{"inner_loop", {{"tensor_rates", {{"a", -1}}}}}}, "inner_loop.tensor_rates.a");
  expect_refused({{"inner_loop", {{"tensor_rates", 3}}}}, "inner_loop.tensor_rates");
  expect_refused({{"implicit_maml", {{"cg_tolerance", 2}}}}, "implicit_maml.cg_tolerance");
  expect_refused({{"iterations", 100}, {"warmup_iterations", 60}, {"horizon_growth_iterations", 40}}, "horizon_growth_iterations");
  expect_refused({{"algorithm", "GAUSSIAN_PRIOR"}, {"horizon_growth_iterations", 10}}, "horizon_growth_iterations");
  const json by_curvature = {{"curvature_rates", true}, {"learned_rates", true}};
  expect_refused({{"inner_loop", by_curvature}, {"iterations", 10}, {"warmup_iterations", 10}}, "warmup_iterations");
  expect_refused({{"inner_loop", by_curvature}, {"restarts", 2}, {"screening_iterations", 10}, {"warmup_iterations", 10}},
                 "screening_iterations");
  expect_refused({{"restarts", 2}}, "screening_iterations");
  expect_refused({{"restarts", 2}, {"screening_iterations", 101}, {"iterations", 100}}, "screening_iterations");
  expect_refused({{"restarts", 2}, {"screening_iterations", 10}, {"validation_share", 0}}, "validation_share");
  expect_refused({{"algorithm", "GAUSSIAN_PRIOR"}, {"restarts", 2}, {"screening_iterations", 10}}, "restarts");
  expect_refused({{"algorithm", "MIXED_EFFECTS"}, {"restarts", 2}, {"screening_iterations", 10}}, "restarts");
  expect_refused({{"algorithm", "GAUSSIAN_PRIOR"}, {"gaussian_prior", {{"meta_algorithm", "REPTILE"}}}}, "gaussian_prior.meta_algorithm");
  const json mixed = {{"meta_iterations", 10}, {"meta_algorithm", "MIXED_EFFECTS"}};
  expect_refused({{"algorithm", "GAUSSIAN_PRIOR"}, {"gaussian_prior", mixed}, {"inner_loop", {{"adapted_mask", "encoder"}}}, {"adaptation", {{"adapted_mask", "transition"}}}},
                 "adaptation.adapted_mask");
  expect_refused({{"algorithm", "GAUSSIAN_PRIOR"}, {"gaussian_prior", mixed}, {"inner_loop", learned}}, "inner_loop.learned_rates");
  expect_refused({{"gaussian_prior", {{"rank", 2}}}}, "gaussian_prior.rank");
  expect_refused({{"gaussian_prior", {{"covariance", "BLOCK"}, {"rank", 2}}}}, "gaussian_prior.rank");
  expect_refused({{"gaussian_prior", {{"covariance", "LOW_RANK"}}}}, "gaussian_prior.rank");
  expect_refused({{"gaussian_prior", {{"covariance", "MANIFOLD"}}}}, "gaussian_prior.rank");
  expect_refused({{"gaussian_prior", {{"covariance", "DIAGONAL"}}}}, "gaussian_prior.covariance");
}

TEST(TrainingSpecTest, ALinearStartNeedsAModelThatHasOne) {
  const json block = {{"bypass", "LINEAR"}};
  const json model = {{"case", "STATE_INPUT_OUTPUT"}, {"latent_size", 5}, {"transition", block}};
  const auto spec = ReadTrainingSpec({{"model", model}, {"linear_start", true}});
  ASSERT_TRUE(spec.ok()) << spec.status();
  EXPECT_TRUE(spec->linear_start);
  EXPECT_EQ(ToJson(*ReadTrainingSpec(ToJson(*spec))), ToJson(*spec));
  const auto wrong = ReadTrainingSpec(WithModel({{"linear_start", true}}));
  EXPECT_NE(std::string(wrong.status().message()).find("linear_start: a linear start needs states"), std::string::npos) << wrong.status();
  const auto none = ReadTrainingSpec({{"model", model}, {"linear_start", true}, {"algorithm", "GAUSSIAN_PRIOR"}});
  EXPECT_NE(std::string(none.status().message()).find("meta_iterations"), std::string::npos) << none.status();
}

}  // namespace
}  // namespace metaekf::meta
