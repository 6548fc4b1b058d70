#pragma once

#include <gtest/gtest.h>

#include <string>

#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // as where the code is
#include <hwy/highway.h>

namespace metaekf::support {

/// A test that runs in every instruction set that this machine knows.
class InstructionSetTest : public testing::TestWithParam<int64_t> {
 protected:
  void SetUp() override {
    hwy::SetSupportedTargetsForTest(GetParam());
    hwy::GetChosenTarget().Update(hwy::SupportedTargets());
  }
  void TearDown() override {
    hwy::SetSupportedTargetsForTest(0);
    hwy::GetChosenTarget().Update(hwy::SupportedTargets());
  }
};

inline auto InstructionSets() { return testing::ValuesIn(hwy::SupportedAndGeneratedTargets()); }
inline std::string NameOfInstructionSet(const testing::TestParamInfo<int64_t>& target) { return hwy::TargetName(target.param); }

}  // namespace metaekf::support
