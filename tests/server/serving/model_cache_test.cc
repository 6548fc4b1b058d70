#include "server/serving/model_cache.h"

#include <gmock/gmock.h>

#include <thread>

#include "core/nssm/model_file.h"
#include "tests/server/store/test_store.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

constexpr int64_t kAmple = 1 << 30;

class ModelCacheTest : public store::StoreTest {
 protected:
  void Add(uint64_t seed) { AddVersion("robot", nssm::WriteModelFile(TinyBundle(seed))); }

  /// Stores the output decoder of another model as an adaptation of version 1.
  void Adapt(const std::string& id, uint64_t seed) {
    const nssm::Bundle adapted = TinyBundle(seed);
    const auto mask = nn::ParseMask("output_decoder", adapted.model.layout()).value();
    ASSERT_TRUE(
        store_->Of(store::kDefaultTenant).adaptations()
            .Create({id, "robot", 1, Blob(nssm::WriteAdaptedSubset(adapted, mask)), "{}", {}})
            .ok());
  }
};

TEST_F(ModelCacheTest, NamesLeadToTheirModels) {
  Add(1);
  Add(2);
  ASSERT_TRUE(store_->Of(store::kDefaultTenant).models().SetAlias("robot", "stable", 1).ok());
  ModelCache cache(*store_, kAmple);
  const auto latest = cache.Get(store::kDefaultTenant, "f", "models/robot").value();
  EXPECT_EQ(latest->model_version, "models/robot/versions/2");
  EXPECT_EQ(latest->adaptation, "");
  EXPECT_EQ(latest->bundle.parameters, TinyBundle(2).parameters);
  const auto stable = cache.Get(store::kDefaultTenant, "f", "models/robot/aliases/stable").value();
  EXPECT_EQ(stable->bundle.parameters, TinyBundle(1).parameters);
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "models/robot/versions/1").value(), stable);

  // A name means what it means now.
  ASSERT_TRUE(store_->Of(store::kDefaultTenant).models().SetAlias("robot", "stable", 2).ok());
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "models/robot/aliases/stable").value(), latest);
}

TEST_F(ModelCacheTest, AnAdaptationIsItsBaseWithTheAdaptedSubset) {
  Add(1);
  Adapt("mine", 2);
  ModelCache cache(*store_, kAmple);
  const auto base = cache.Get(store::kDefaultTenant, "f", "models/robot").value();
  const auto adapted = cache.Get(store::kDefaultTenant, "f", "adaptations/mine").value();
  EXPECT_EQ(adapted->model_version, "models/robot/versions/1");
  EXPECT_EQ(adapted->adaptation, "adaptations/mine");
  for (const nn::Tensor& tensor : base->bundle.model.layout().tensors()) {
    const bool is_adapted = tensor.name.rfind("output_decoder", 0) == 0;
    const nssm::Bundle& expected = is_adapted ? TinyBundle(2) : TinyBundle(1);
    for (int64_t i = tensor.offset; i < tensor.offset + tensor.size(); ++i) {
      EXPECT_EQ(adapted->bundle.parameters[static_cast<size_t>(i)],
                expected.parameters[static_cast<size_t>(i)])
          << tensor.name;
    }
  }
  EXPECT_EQ(adapted->filter_model, base->filter_model);
  EXPECT_NE(adapted->filter_parameters, base->filter_parameters);
}

TEST_F(ModelCacheTest, AnIdThatIsUsedAgainMeansTheNewAdaptation) {
  Add(1);
  Adapt("mine", 2);
  ModelCache cache(*store_, kAmple);
  const auto old = cache.Get(store::kDefaultTenant, "f", "adaptations/mine").value();
  ASSERT_TRUE(store_->Of(store::kDefaultTenant).adaptations().Delete("mine").ok());
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "adaptations/mine").status().code(), absl::StatusCode::kNotFound);
  Adapt("mine", 3);
  EXPECT_NE(cache.Get(store::kDefaultTenant, "f", "adaptations/mine").value()->bundle.parameters, old->bundle.parameters);
}

TEST_F(ModelCacheTest, EqualArchitecturesShareTheirFilter) {
  Add(1);
  Add(2);
  AddVersion("state", nssm::WriteModelFile(TinyStateBundle()));
  ModelCache cache(*store_, kAmple);
  const auto first = cache.Get(store::kDefaultTenant, "f", "models/robot/versions/1").value();
  const auto second = cache.Get(store::kDefaultTenant, "f", "models/robot/versions/2").value();
  const auto other = cache.Get(store::kDefaultTenant, "f", "models/state").value();
  EXPECT_EQ(first->filter_model, second->filter_model);
  EXPECT_NE(first->filter_model, other->filter_model);
}

TEST_F(ModelCacheTest, OverTheBudgetOnlyTheLatestAndThoseInUseStay) {
  Add(1);
  Add(2);
  ModelCache cache(*store_, /*budget_bytes=*/1);
  std::weak_ptr<const ServedModel> first = cache.Get(store::kDefaultTenant, "f", "models/robot/versions/1").value();
  EXPECT_FALSE(first.expired());  // the latest
  const auto second = cache.Get(store::kDefaultTenant, "f", "models/robot/versions/2").value();
  EXPECT_TRUE(first.expired());
  (void)cache.Get(store::kDefaultTenant, "f", "models/robot/versions/1").value();
  // No longer the latest, but held here: not loaded again.
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "models/robot/versions/2").value(), second);
}

TEST_F(ModelCacheTest, WhatIsDeletedIsKeptByWhoHoldsItAlone) {
  Add(1);
  Adapt("mine", 2);
  Adapt("mine2", 3);
  ModelCache cache(*store_, kAmple);
  auto held = cache.Get(store::kDefaultTenant, "f", "adaptations/mine").value();
  cache.Get(store::kDefaultTenant, "f", "adaptations/mine2").value();
  const ModelCache::Resident before = cache.resident();
  EXPECT_EQ(before.models, 3);  // with their base
  cache.Forget("another tenant", "adaptations/mine");
  EXPECT_EQ(cache.resident().kept_bytes, before.kept_bytes);
  cache.Forget(store::kDefaultTenant, "adaptations/mine");
  EXPECT_EQ(cache.resident().models, 3);
  EXPECT_LT(cache.resident().kept_bytes, before.kept_bytes);
  held.reset();
  EXPECT_EQ(cache.resident().models, 2);
  cache.Forget(store::kDefaultTenant, "models/robot/versions/1");
  EXPECT_EQ(cache.resident().models, 1);
}

TEST_F(ModelCacheTest, ManyAtOnceGetOneModel) {
  Add(1);
  ModelCache cache(*store_, kAmple);
  std::vector<std::shared_ptr<const ServedModel>> models(8);
  std::vector<std::thread> threads;
  for (auto& model : models) {
    threads.emplace_back([&] { model = cache.Get(store::kDefaultTenant, "f", "models/robot").value(); });
  }
  for (std::thread& thread : threads) thread.join();
  for (const auto& model : models) EXPECT_EQ(model, models[0]);
}

TEST_F(ModelCacheTest, ErrorsAreToldApart) {
  AddVersion("broken", "this is no model file");
  Add(1);
  ModelCache cache(*store_, kAmple);
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "robot").status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "models/none").status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "adaptations/none").status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "models/broken").status().code(), absl::StatusCode::kDataLoss);
  FlipBit(store_->Of(store::kDefaultTenant).models().GetLatest("robot")->digest);
  EXPECT_EQ(cache.Get(store::kDefaultTenant, "f", "models/robot").status().code(), absl::StatusCode::kDataLoss);
}

}  // namespace
}  // namespace metaekf::server
