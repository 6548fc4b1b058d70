// The training specifications that ship: each must be one, and the shipped models must be what theirs says.
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <google/protobuf/text_format.h>
#include <nlohmann/json.hpp>
#include <sstream>

#include "core/nssm/model_file.h"
#include "server/convert/spec.h"

namespace metaekf {
namespace {

const std::filesystem::path kDeploy = std::filesystem::path(METAEKF_SOURCE_DIR) / "deploy";

std::string Contents(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream bytes;
  bytes << file.rdbuf();
  return bytes.str();
}

absl::StatusOr<meta::TrainingSpec> ReadSpec(const std::filesystem::path& path) {
  v1::TrainingSpec message;
  if (!google::protobuf::TextFormat::ParseFromString(Contents(path), &message)) {
    return absl::InvalidArgumentError("is no TrainingSpec in text form");
  }
  return server::ToCore("spec", message);
}

TEST(SpecsTest, EverySpecificationIsAccepted) {
  int specs = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kDeploy / "specs")) {
    ++specs;
    const auto spec = ReadSpec(entry.path());
    EXPECT_TRUE(spec.ok()) << entry.path() << ": " << spec.status();
  }
  EXPECT_GE(specs, 4);
}

TEST(SpecsTest, EveryShippedModelIsTrainedAsItsSpecificationSays) {
  int models = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kDeploy / "zoo")) {
    if (entry.path().extension() != ".safetensors") continue;
    ++models;
    const auto spec = ReadSpec(kDeploy / "specs" / entry.path().filename().replace_extension(".textproto"));
    ASSERT_TRUE(spec.ok()) << entry.path() << ": " << spec.status();
    const auto bundle = nssm::ReadModelFile(Contents(entry.path()));
    ASSERT_TRUE(bundle.ok()) << entry.path() << ": " << bundle.status();
    nlohmann::json expected = meta::ToJson(*spec), trained = meta::ToJson(*meta::ReadTrainingSpec(*bundle->training));
    for (nlohmann::json* one : {&expected, &trained}) {  // what comes from the data
      for (const char* size : {"input_size", "output_size", "state_size"}) (*one)["model"].erase(size);
      one->erase("sample_period_s");
    }
    EXPECT_EQ(trained, expected) << entry.path() << ": " << nlohmann::json::diff(expected, trained);
  }
  EXPECT_GE(models, 1);
}

}  // namespace
}  // namespace metaekf
