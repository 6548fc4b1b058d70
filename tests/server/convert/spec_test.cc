#include "server/convert/spec.h"

#include <gmock/gmock.h>
#include <google/protobuf/util/message_differencer.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

namespace metaekf::server {
namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;
using ::testing::HasSubstr;
using ::testing::StartsWith;

/// Fills every field with a value that is no default and that core takes: positive integers
/// counted up, numbers between 0 and 1, the last enumerator, true.
void FillAll(Message* message, int* counter) {
  const auto* reflection = message->GetReflection();
  const auto* descriptor = message->GetDescriptor();
  for (int i = 0; i < descriptor->field_count(); ++i) {
    const FieldDescriptor* field = descriptor->field(i);
    if (field->is_map()) {
      FillAll(reflection->AddMessage(message, field), counter);
      continue;
    }
    if (field->is_repeated() && field->cpp_type() == FieldDescriptor::CPPTYPE_DOUBLE) {
      reflection->AddDouble(message, field, ++*counter / 1024.0);
      continue;
    }
    if (field->is_repeated()) {
      reflection->AddUInt32(message, field, static_cast<uint32_t>(++*counter));
      reflection->AddUInt32(message, field, static_cast<uint32_t>(++*counter));
      continue;
    }
    switch (field->cpp_type()) {
      case FieldDescriptor::CPPTYPE_MESSAGE:
        FillAll(reflection->MutableMessage(message, field), counter);
        break;
      case FieldDescriptor::CPPTYPE_UINT32:
        reflection->SetUInt32(message, field, static_cast<uint32_t>(++*counter));
        break;
      case FieldDescriptor::CPPTYPE_UINT64:
        reflection->SetUInt64(message, field, static_cast<uint64_t>(++*counter));
        break;
      case FieldDescriptor::CPPTYPE_DOUBLE:
        reflection->SetDouble(message, field, ++*counter / 1024.0);
        break;
      case FieldDescriptor::CPPTYPE_BOOL:
        reflection->SetBool(message, field, true);
        break;
      case FieldDescriptor::CPPTYPE_ENUM: {
        const auto* values = field->enum_type();
        reflection->SetEnum(message, field, values->value(values->value_count() - 1));
        break;
      }
      case FieldDescriptor::CPPTYPE_STRING:
        reflection->SetString(message, field, "encoder");
        break;
      default:
        FAIL() << "a kind of field that this test does not know: " << field->full_name();
    }
  }
}

/// Everything at once is not allowed; what must differ is set here, with the reason.
v1::TrainingSpec FullSpec() {
  v1::TrainingSpec spec;
  int counter = 10;
  FillAll(&spec, &counter);
  v1::ModelSpec& model = *spec.mutable_model();
  model.set_window(1);                                                      // Case II has none
  model.mutable_transition()->clear_input_block();                          // JOINT has none
  model.mutable_transition()->set_input_time(v1::TransitionSpec::CURRENT);  // NEXT is Case I's
  model.mutable_output_constraint()->mutable_curl_free()->add_position_states(0);  // instead of a polyhedron
  model.mutable_output_constraint()->mutable_curl_free()->add_position_states(1);
  model.set_output_size(2);  // as many as positions
  model.clear_angle_states();
  model.add_angle_states(2);  // one that there is
  for (v1::BlockSpec* block : {model.mutable_encoder(), model.mutable_transition()->mutable_block(), model.mutable_state_decoder(),
                               model.mutable_output_decoder()}) {
    block->set_activation(v1::BlockSpec::SWISH);  // the only one with a beta
  }
  model.mutable_encoder()->clear_hidden_widths();  // as linear_start has them
  model.mutable_state_decoder()->clear_hidden_widths();
  model.set_latent_size(model.state_size() + model.input_size() + 2);
  auto* polyhedron = model.mutable_state_constraint()->mutable_polyhedron();
  polyhedron->clear_rays();  // stand instead of the others
  while (polyhedron->matrix_size() < static_cast<int>(model.state_size())) polyhedron->add_matrix(-1);  // whole rows
  spec.mutable_inner_loop()->set_optimiser(v1::InnerLoopSpec::GRADIENT_DESCENT);  // whose curvature_rates
  spec.set_algorithm(v1::TrainingSpec::FIRST_ORDER_MAML);             // the last learns no rates
  model.set_start(v1::ModelSpec::ENCODED);  // FITTED is Case I's
  spec.set_iterations(spec.warmup_iterations() + spec.horizon_growth_iterations() + 1);  // at least
  spec.set_screening_iterations(spec.iterations());  // at most
  // Read as the whole set, which has no number.
  spec.mutable_loss()->clear_horizon();
  return spec;
}

TEST(SpecTest, AFullyPopulatedSpecificationComesBackAsItWas) {
  const v1::TrainingSpec message = FullSpec();
  const auto core = ToCore("spec", message);
  ASSERT_TRUE(core.ok()) << core.status();
  const auto back = ToTrainingSpecMessage(meta::ToJson(*core));
  ASSERT_TRUE(back.ok()) << back.status();
  google::protobuf::util::MessageDifferencer differencer;
  std::string differences;
  differencer.ReportDifferencesToString(&differences);
  EXPECT_TRUE(differencer.Compare(message, *back)) << differences;
}

TEST(SpecTest, TheFieldsOfCaseOneComeBackToo) {
  v1::TrainingSpec message;
  v1::ModelSpec& model = *message.mutable_model();
  model.set_case_(v1::ModelSpec::INPUT_OUTPUT);
  model.set_latent_size(3);
  model.set_window(7);
  model.mutable_transition()->set_form(v1::TransitionSpec::ADDITIVE);
  model.mutable_transition()->mutable_input_block()->add_hidden_widths(9);
  model.mutable_transition()->set_input_time(v1::TransitionSpec::NEXT);
  message.mutable_loss()->set_horizon(12);
  const auto core = ToCore("spec", message);
  ASSERT_TRUE(core.ok()) << core.status();
  const auto back = ToTrainingSpecMessage(meta::ToJson(*core)).value();
  EXPECT_EQ(back.model().window(), 7u);
  EXPECT_EQ(back.model().transition().input_block().hidden_widths(0), 9u);
  EXPECT_EQ(back.model().transition().input_time(), v1::TransitionSpec::NEXT);
  EXPECT_EQ(back.loss().horizon(), 12u);
  EXPECT_EQ(back.inner_loop().steps(), 10u);  // defaults are spelt out
}

TEST(SpecTest, WhatCoreRefusesIsAViolationOfTheField) {
  v1::TrainingSpec message = FullSpec();
  message.mutable_model()->mutable_output_decoder()->set_hidden_widths(1, 0);
  const absl::Status status = ToCore("header.spec", message).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()),
              StartsWith("header.spec.model.output_decoder.hidden_widths[1]: "));
}

TEST(SpecTest, ErrorsWithoutAPathAreTheWholeField) {
  const absl::Status status = InField("spec", absl::InvalidArgumentError("is no good: at all"));
  EXPECT_EQ(status.message(), "spec: is no good: at all");
  EXPECT_EQ(InField("spec", absl::NotFoundError("gone")).code(), absl::StatusCode::kNotFound);
}

TEST(SpecTest, OtherJsonIsRefused) {
  EXPECT_FALSE(ToTrainingSpecMessage({{"model", "robot"}}).ok());
}

}  // namespace
}  // namespace metaekf::server
