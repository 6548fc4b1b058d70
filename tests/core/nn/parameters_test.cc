#include "core/nn/parameters.h"

#include <gtest/gtest.h>

namespace metaekf::nn {
namespace {

ParameterLayout SomeLayout() {
  ParameterLayout layout;
  for (const char* name : {"encoder.0.weight", "encoder.0.bias", "encoder.3.weight", "encoder.10.weight",
                           "transition.0.weight", "transition.state_bypass.weight", "state_decoder.0.weight",
                           "output_decoder.0.weight"}) {
    layout.Add(name, 2, 3);
  }
  return layout;
}

std::string Chosen(const std::string& text) {
  const absl::StatusOr<Mask> mask = ParseMask(text, SomeLayout());
  if (!mask.ok()) return std::string(mask.status().message());
  std::string digits;
  for (const bool chosen : *mask) digits += chosen ? '1' : '0';
  return digits;
}

TEST(ParametersTest, MasksChooseByNameGlobAndLayerRange) {
  EXPECT_EQ(Chosen("*"), "11111111");
  EXPECT_EQ(Chosen(""), "11111111");
  EXPECT_EQ(Chosen("encoder"), "11110000");
  EXPECT_EQ(Chosen("encoder.3-10"), "00110000");
  EXPECT_EQ(Chosen("encoder.0"), "11000000");
  EXPECT_EQ(Chosen("encoder.0.weight"), "10000000");
  EXPECT_EQ(Chosen("*_decoder, transition"), "00001111");
  EXPECT_EQ(Chosen("transition.state_bypass"), "00000100");
}

TEST(ParametersTest, AnItemThatMatchesNothingIsNamedWithWhatThereIs) {
  EXPECT_EQ(Chosen("encoder,encoder.7"),
            "adapted mask: \"encoder.7\" matches no parameter of the model; there are encoder.0, encoder.10, encoder.3, "
            "output_decoder.0, state_decoder.0, transition.0, transition.state_bypass");
}

TEST(ParametersTest, TensorsFollowEachOther) {
  const ParameterLayout layout = SomeLayout();
  EXPECT_EQ(layout.size(), 8 * 6);
  EXPECT_EQ(layout.tensors()[3].offset, 18);
}

}  // namespace
}  // namespace metaekf::nn
