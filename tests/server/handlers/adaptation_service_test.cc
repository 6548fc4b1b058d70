#include <cmath>
#include <functional>
#include <set>

#include "core/meta/adapt.h"
#include "core/nssm/safetensors.h"
#include "server/convert/samples.h"
#include "server/convert/spec.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;
using ::testing::SizeIs;

constexpr auto kInvalid = absl::StatusCode::kInvalidArgument;

std::vector<v1::AdaptRequest> AdaptRequests(uint32_t samples) {
  std::vector<v1::AdaptRequest> requests(2);
  requests[0].mutable_options()->set_model("models/robot");
  *requests[1].mutable_samples() = TinyContext(samples);
  return requests;
}

data::Trajectory Assemble(const v1::Samples& samples) {
  TrajectoryAssembler assembler({.channels = {1, 1, 0}, .max_samples = 1000});
  EXPECT_TRUE(assembler.Add(samples).ok());
  return assembler.Finish().value();
}

class AdaptationServiceTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Import("robot", TinyBundle());
  }
};

TEST_F(AdaptationServiceTest, TheResultIsThatOfCore) {
  const auto reply = client_->Adapt(AdaptRequests(100));
  ASSERT_TRUE(reply.ok()) << reply;
  const v1::Adaptation& result = reply.value.back().result();

  const nssm::Bundle bundle = TinyBundle();
  const auto options = meta::DefaultAdaptation(bundle).value();
  const auto expected = meta::Adapt(bundle, Assemble(TinyContext(100)), options, nullptr).value();
  EXPECT_EQ(result.name(), "adaptations/a1");
  EXPECT_EQ(result.model_version(), "models/robot/versions/1");
  EXPECT_EQ(result.method(), v1::Adaptation::GRADIENT_DESCENT);
  EXPECT_EQ(result.inner_loop().steps(), 5u);  // TinySpec
  EXPECT_EQ(result.inner_loop().learning_rate(), 0.01);
  EXPECT_EQ(result.inner_loop().adapted_mask(), "*");
  EXPECT_EQ(result.context_samples(), 100u);
  EXPECT_EQ(result.context_loss_before(), expected.context_loss_before);
  EXPECT_EQ(result.context_loss_after(), expected.context_loss_after);
  EXPECT_EQ(result.held_out().samples(), 20u);  // a fifth
  EXPECT_EQ(result.held_out().after().simulate(0), expected.after.simulate[0]);
  EXPECT_EQ(result.held_out().arx().one_step(0), expected.arx.one_step[0]);

  // Each step is told unless the client is slow; the last one always.
  ASSERT_GE(reply.value.size(), 2u);
  const auto& progress = reply.value[reply.value.size() - 2].progress();
  EXPECT_EQ(progress.step(), 5u);
  EXPECT_EQ(progress.steps(), 5u);
  EXPECT_EQ(progress.loss(), expected.context_loss_after);

  const auto got = client_->Call(Named<v1::GetAdaptationRequest>("adaptations/a1"));
  EXPECT_EQ(got.value.SerializeAsString(), result.SerializeAsString());
}

TEST_F(AdaptationServiceTest, OptionsOverrideTheModelsOwn) {
  auto requests = AdaptRequests(60);
  v1::AdaptRequest::Options& options = *requests[0].mutable_options();
  options.set_adaptation_id("mine");
  options.set_method(v1::Adaptation::ADAM);
  options.mutable_inner_loop()->set_steps(2);
  options.mutable_inner_loop()->set_learning_rate(0.5);
  options.mutable_inner_loop()->set_adapted_mask("output_decoder");
  auto reply = client_->Adapt(requests);
  ASSERT_TRUE(reply.ok()) << reply;
  const v1::Adaptation adapted = reply.value.back().result();
  EXPECT_EQ(adapted.name(), "adaptations/mine");
  EXPECT_EQ(adapted.method(), v1::Adaptation::ADAM);
  EXPECT_EQ(adapted.inner_loop().steps(), 2u);
  EXPECT_EQ(adapted.inner_loop().learning_rate(), 0.5);
  EXPECT_EQ(adapted.inner_loop().adapted_mask(), "output_decoder");
  ExpectError(client_->Adapt(requests), absl::StatusCode::kAlreadyExists);

  options.set_adaptation_id("scratch");
  options.set_method(v1::Adaptation::FROM_SCRATCH);
  options.set_seed(3);
  reply = client_->Adapt(requests);
  ASSERT_TRUE(reply.ok()) << reply;
  EXPECT_EQ(reply.value.back().result().method(), v1::Adaptation::FROM_SCRATCH);
  EXPECT_EQ(reply.value.back().result().seed(), 3u);
}

TEST_F(AdaptationServiceTest, OnlyTheAdaptedSubsetIsStored) {
  auto requests = AdaptRequests(60);
  requests[0].mutable_options()->mutable_inner_loop()->set_adapted_mask("output_decoder");
  ASSERT_TRUE(client_->Adapt(requests).ok());
  std::set<std::string> names;
  const auto digests = store::ListDirectory(directory_.path() + "/blobs").value();
  for (const std::string& digest : digests) {
    const auto file =
        nssm::ReadSafetensors(*store::ReadFile(directory_.path() + "/blobs/" + digest)).value();
    if (file.metadata.count("metaekf") > 0) continue;  // the base
    for (const auto& tensor : file.tensors) names.insert(tensor.name);
  }
  EXPECT_EQ(names, (std::set<std::string>{"output_decoder.0.weight", "output_decoder.0.bias", "noise.process", "noise.measurement"}));
}

TEST_F(AdaptationServiceTest, ARequestIdSentTwiceMakesOneAdaptation) {
  auto requests = AdaptRequests(60);
  requests[0].mutable_options()->set_request_id("once");
  const auto first = client_->Adapt(requests);
  ASSERT_TRUE(first.ok()) << first;
  const auto second = client_->Adapt(requests);
  ASSERT_TRUE(second.ok()) << second;
  ASSERT_THAT(second.value, SizeIs(1));  // at once, without progress
  EXPECT_EQ(second.value[0].result().SerializeAsString(),
            first.value.back().result().SerializeAsString());
  requests[1].mutable_samples()->set_outputs(3, 0.5);
  ExpectError(client_->Adapt(requests), absl::StatusCode::kAlreadyExists);
}

TEST_F(AdaptationServiceTest, TooShortAContextIsToldHowManySamplesItNeeds) {
  const auto reply = client_->Adapt(AdaptRequests(5));
  ExpectError(reply, absl::StatusCode::kFailedPrecondition);
  const auto spec = ToCore("", TinySpec(1)).value();
  EXPECT_THAT(reply.message,
              HasSubstr(std::to_string(meta::ContextSamplesNeeded(spec.model, spec.loss))));
}

TEST_F(AdaptationServiceTest, WrongRequestsAreRefusedWithTheField) {
  const auto adapt = [&](const std::function<void(std::vector<v1::AdaptRequest>&)>& spoil) {
    auto requests = AdaptRequests(60);
    spoil(requests);
    return client_->Adapt(requests);
  };
  const auto options = [&](const std::function<void(v1::AdaptRequest::Options&)>& spoil) {
    return adapt([&](auto& r) { spoil(*r[0].mutable_options()); });
  };
  ExpectError(options([](auto& o) { o.set_model("robot"); }), kInvalid, {"options.model"});
  ExpectError(options([](auto& o) { o.set_model("adaptations/a1"); }), kInvalid, {"options.model"});
  ExpectError(options([](auto& o) { o.set_model("models/other"); }), absl::StatusCode::kNotFound);
  ExpectError(options([](auto& o) { o.set_adaptation_id("Bad Id"); }), kInvalid,
              {"options.adaptation_id"});
  ExpectError(options([](auto& o) { o.mutable_inner_loop()->set_learning_rate(-1); }), kInvalid,
              {"options.inner_loop.learning_rate"});
  ExpectError(options([](auto& o) { o.mutable_inner_loop()->set_steps(1'000'000'000); }), kInvalid,
              {"options.inner_loop.steps"});
  ExpectError(options([](auto& o) { o.mutable_inner_loop()->set_adapted_mask("brain"); }), kInvalid,
              {"options.inner_loop.adapted_mask"});
  ExpectError(
      options([](auto& o) { o.mutable_inner_loop()->set_optimiser(v1::InnerLoopSpec::ADAM); }),
      kInvalid, {"options.inner_loop.optimiser"});
  ExpectError(options([](auto& o) { o.set_method(static_cast<v1::Adaptation::Method>(9)); }),
              kInvalid, {"options.method"});
  ExpectError(options([](auto& o) {
                o.mutable_channels()->add_inputs()->set_name("u1");
                o.mutable_channels()->add_outputs()->set_name("force");
              }),
              kInvalid, {"options.channels.outputs"});
  ExpectError(adapt([](auto& r) { r.erase(r.begin()); }), kInvalid, {"options"});
  ExpectError(adapt([](auto& r) { r.clear(); }), kInvalid, {"options"});
  ExpectError(adapt([](auto& r) { r.resize(1); }), kInvalid, {"samples"});
  ExpectError(adapt([](auto& r) { r.push_back(r[0]); }), kInvalid, {"samples"});
  ExpectError(adapt([](auto& r) { r[1].mutable_samples()->set_outputs(7, INFINITY); }), kInvalid,
              {"samples.outputs[7]"});
  ExpectError(adapt([](auto& r) { r[1].mutable_samples()->set_sample_period_s(0.3); }), kInvalid,
              {"samples.sample_period_s"});
  ExpectError(adapt([](auto& r) {
                r.push_back(r[1]);
                r[2].mutable_samples()->set_trajectory("another");
              }),
              kInvalid, {"samples.trajectory"});
  EXPECT_THAT(client_->Call(v1::ListAdaptationsRequest()).value.adaptations(), SizeIs(0));
}

TEST_F(AdaptationServiceTest, TooManySamplesAreRefused) {
  Stop();
  options_.limits.samples_per_call = 50;
  options_.limits.sample_bytes = 1024;
  Start();
  ExpectError(client_->Adapt(AdaptRequests(60)), absl::StatusCode::kResourceExhausted);
  const auto reply = client_->Adapt(AdaptRequests(40));
  ExpectError(reply, absl::StatusCode::kResourceExhausted);
  EXPECT_NE(reply.message.find("limits.sample_bytes"), std::string::npos) << reply;
}

TEST_F(AdaptationServiceTest, ACancelledAdaptationStopsAndStoresNothing) {
  auto requests = AdaptRequests(60);
  requests[0].mutable_options()->mutable_inner_loop()->set_steps(20'000);
  requests[0].mutable_options()->mutable_inner_loop()->set_learning_rate(1e-6);
  const auto reply = client_->Adapt(requests, [](const v1::AdaptResponse&) { return false; });
  EXPECT_EQ(reply.code, absl::StatusCode::kCancelled);
  // The thread is free again: the only one adapts the next.
  EXPECT_TRUE(client_->Adapt(AdaptRequests(60)).ok());
  EXPECT_THAT(client_->Call(v1::ListAdaptationsRequest()).value.adaptations(), SizeIs(1));
}

TEST_F(AdaptationServiceTest, AdaptationsAreListedAndDeleted) {
  for (const char* id : {"b", "c", "a"}) {
    auto requests = AdaptRequests(60);
    requests[0].mutable_options()->set_adaptation_id(id);
    ASSERT_TRUE(client_->Adapt(requests).ok());
  }
  v1::ListAdaptationsRequest list;
  list.set_page_size(2);
  auto page = client_->Call(list);
  ASSERT_THAT(page.value.adaptations(), SizeIs(2));
  EXPECT_EQ(page.value.adaptations(0).name(), "adaptations/a");
  list.set_page_token(page.value.next_page_token());
  page = client_->Call(list);
  ASSERT_THAT(page.value.adaptations(), SizeIs(1));
  EXPECT_EQ(page.value.adaptations(0).name(), "adaptations/c");

  const auto remove = Named<v1::DeleteAdaptationRequest>("adaptations/a");
  EXPECT_TRUE(client_->Call(remove).ok());
  ExpectError(client_->Call(remove), absl::StatusCode::kNotFound);
  ExpectError(client_->Call(Named<v1::GetAdaptationRequest>("adaptations/a")),
              absl::StatusCode::kNotFound);
  ExpectError(client_->Call(Named<v1::GetAdaptationRequest>("a")), kInvalid, {"name"});
  // A version with an adaptation stays.
  ExpectError(client_->Call(Named<v1::DeleteModelVersionRequest>("models/robot/versions/1")),
              absl::StatusCode::kFailedPrecondition);
}

}  // namespace
}  // namespace metaekf::server
