#include "core/nssm/model_file.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <nlohmann/json.hpp>

#include "core/nssm/safetensors.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::nssm {
namespace {

Bundle SomeBundle(const ModelCase& c) {
  Bundle bundle = support::UnitBundle(*Model::Create(c.model));
  bundle.parameters = RandomParameters(bundle.model, 3);
  RoundToPrecision(c.model.precision, &bundle.parameters);
  bundle.normaliser.outputs.mean.setConstant(0.1);
  bundle.training = nlohmann::json{{"seed", 3}};
  return bundle;
}

TEST(ModelFileTest, EveryKindOfModelReadsBackExactly) {
  for (ModelCase c : ModelCases()) {
    for (const Precision precision : {Precision::kFloat32, Precision::kFloat64}) {
      c.model.precision = precision;
      const Bundle bundle = SomeBundle(c);
      const std::string bytes = WriteModelFile(bundle);
      const absl::StatusOr<Bundle> back = ReadModelFile(bytes);
      ASSERT_TRUE(back.ok()) << c.name << ": " << back.status();
      EXPECT_EQ(back->parameters, bundle.parameters);
      EXPECT_EQ(back->normaliser.outputs.mean, bundle.normaliser.outputs.mean);
      EXPECT_EQ(back->noise.process, bundle.noise.process);
      EXPECT_EQ(*back->training, *bundle.training);
      EXPECT_EQ(WriteModelFile(*back), bytes);
    }
  }
}

TEST(ModelFileTest, AnAdaptedSubsetGoesOverItsBase) {
  const Bundle base = SomeBundle(ModelCases().front());
  Bundle adapted = base;
  for (double& value : adapted.parameters) value += 1;
  const nn::Mask mask = *nn::ParseMask("output_decoder", base.model.layout());
  const std::string subset = WriteAdaptedSubset(adapted, mask);
  EXPECT_LT(subset.size(), WriteModelFile(base).size() / 2);
  Bundle restored = base;
  ASSERT_TRUE(ApplyAdaptedSubset(subset, &restored).ok());
  for (size_t i = 0; i < mask.size(); ++i) {
    const nn::Tensor& tensor = base.model.layout().tensors()[i];
    for (size_t k = static_cast<size_t>(tensor.offset); k < static_cast<size_t>(tensor.offset + tensor.size()); ++k) {
      EXPECT_EQ(restored.parameters[k], mask[i] ? adapted.parameters[k] : base.parameters[k]) << tensor.name;
    }
  }
}

TEST(ModelFileTest, APosteriorGoesWithTheAdaptedSubset) {
  const Bundle base = SomeBundle(ModelCases().front());
  const nn::Mask mask = *nn::ParseMask("output_decoder.0.bias", base.model.layout());
  Bundle adapted = base;
  const Eigen::Index p = base.model.spec().output_size;
  const Eigen::MatrixXd root = Eigen::MatrixXd::Random(p, p);
  adapted.posterior.emplace().information = root * root.transpose() + Eigen::MatrixXd::Identity(p, p);
  const std::string subset = WriteAdaptedSubset(adapted, mask);
  Bundle restored = base;
  ASSERT_TRUE(ApplyAdaptedSubset(subset, &restored).ok());
  ASSERT_TRUE(restored.posterior.has_value());
  EXPECT_EQ(restored.posterior->information, adapted.posterior->information);
  Safetensors file = *ReadSafetensors(subset);
  const auto posterior = std::find_if(file.tensors.begin(), file.tensors.end(), [](const Safetensors::Tensor& tensor) {
    return tensor.name == "posterior.information";
  });
  ASSERT_NE(posterior, file.tensors.end());
  posterior->values.push_back(1);
  posterior->shape[0] += 1;
  const absl::Status refused = ApplyAdaptedSubset(WriteSafetensors(file), &restored);
  EXPECT_NE(std::string(refused.message()).find("posterior.information"), std::string::npos) << refused;
}

TEST(ModelFileTest, TheNoiseOfAnAdaptedModelGoesWithIt) {
  const Bundle base = SomeBundle(ModelCases().front());
  Bundle adapted = base;
  adapted.noise.process *= 3;
  adapted.noise.measurement *= 0.5;
  const nn::Mask mask = *nn::ParseMask("output_decoder.0.bias", base.model.layout());
  const std::string subset = WriteAdaptedSubset(adapted, mask);
  Bundle restored = base;
  ASSERT_TRUE(ApplyAdaptedSubset(subset, &restored).ok());
  EXPECT_EQ(restored.noise.process, adapted.noise.process);
  EXPECT_EQ(restored.noise.measurement, adapted.noise.measurement);
  EXPECT_EQ(restored.noise.initial, base.noise.initial);
  for (const auto& [damage, reason] : {std::pair{-1.0, "is not a covariance"}, std::pair{0.0, "is not 1 × 1"}}) {
    Safetensors file = *ReadSafetensors(subset);
    for (Safetensors::Tensor& tensor : file.tensors) {
      if (tensor.name == "noise.process" && damage < 0) tensor.values[0] = damage;
    }
    Bundle other = base;
    if (damage == 0) other.noise.process = Eigen::MatrixXd::Identity(1, 1);
    const absl::Status refused = ApplyAdaptedSubset(WriteSafetensors(file), &other);
    EXPECT_NE(std::string(refused.message()).find(reason), std::string::npos) << refused;
  }
}

TEST(ModelFileTest, ErrorsThatLastAreKeptInBothKindsOfFile) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    Bundle base = SomeBundle(c);
    const Eigen::Index n = base.noise.process.rows(), n_y = base.noise.measurement.rows();
    base.noise.process_bias = {Eigen::MatrixXd::Random(n, 2), 0.9};
    base.noise.measurement_bias = {Eigen::MatrixXd::Random(n_y, 1), 0.1};
    base.noise.parameter_std = 0.3;
    base.noise.own_widening = 0.7;
    const absl::StatusOr<Bundle> back = ReadModelFile(WriteModelFile(base));
    ASSERT_TRUE(back.ok()) << back.status();
    EXPECT_EQ(back->noise.process_bias.loadings, base.noise.process_bias.loadings);
    EXPECT_EQ(back->noise.process_bias.correlation, 0.9);
    EXPECT_EQ(back->noise.measurement_bias.loadings, base.noise.measurement_bias.loadings);
    EXPECT_EQ(back->noise.parameter_std, 0.3);
    EXPECT_EQ(back->noise.own_widening, 0.7);
    Bundle adapted = base;
    adapted.noise.process_bias.loadings *= 2;
    adapted.noise.process_bias.correlation = 0.95;
    const std::string subset = WriteAdaptedSubset(adapted, nn::Mask(base.model.layout().tensors().size(), false));
    Bundle restored = base;
    ASSERT_TRUE(ApplyAdaptedSubset(subset, &restored).ok());
    EXPECT_EQ(restored.noise.process_bias.loadings, adapted.noise.process_bias.loadings);
    EXPECT_EQ(restored.noise.process_bias.correlation, 0.95);
    EXPECT_EQ(restored.noise.measurement_bias.loadings, base.noise.measurement_bias.loadings);
  }
}

TEST(ModelFileTest, ErrorsThatLastButCannotAreRefused) {
  const Bundle base = SomeBundle(ModelCases().front());
  const Eigen::Index n = base.noise.process.rows();
  const std::vector<GaussMarkov> wrong = {{Eigen::MatrixXd::Ones(n + 1, 1), 0.5},
                                          {Eigen::MatrixXd::Ones(n, 1), 1},
                                          {Eigen::MatrixXd::Ones(n, 1), -0.5},
                                          {Eigen::MatrixXd::Constant(n, 1, std::numeric_limits<double>::quiet_NaN()), 0.5}};
  for (const GaussMarkov& bias : wrong) {
    Bundle bundle = base;
    bundle.noise.process_bias = bias;
    const absl::Status refused = ReadModelFile(WriteModelFile(bundle)).status();
    EXPECT_NE(std::string(refused.message()).find("process_bias"), std::string::npos) << refused;
    Bundle restored = base;
    const absl::Status unfit = ApplyAdaptedSubset(WriteAdaptedSubset(bundle, nn::Mask(base.model.layout().tensors().size(), false)), &restored);
    EXPECT_NE(std::string(unfit.message()).find("noise.process_bias"), std::string::npos) << unfit;
    EXPECT_EQ(restored.noise.process_bias.loadings.size(), 0);
  }
}

TEST(ModelFileTest, CoordinatesNeedTheDirectionsOfTheirBase) {
  Bundle base = SomeBundle(ModelCases().front());
  const nn::Mask mask = *nn::ParseMask("output_decoder.0.bias", base.model.layout());
  const Eigen::Index p = base.model.spec().output_size;
  base.prior.emplace();
  base.prior->loadings = Eigen::MatrixXd::Random(p, 1);
  Bundle adapted = base;
  adapted.posterior.emplace(GaussianPosterior{Eigen::MatrixXd::Identity(1, 1), Eigen::VectorXd::Constant(1, 0.5)});
  const std::string subset = WriteAdaptedSubset(adapted, mask);
  Bundle restored = base;
  ASSERT_TRUE(ApplyAdaptedSubset(subset, &restored).ok());
  const auto bias = std::find_if(base.model.layout().tensors().begin(), base.model.layout().tensors().end(),
                                 [](const nn::Tensor& tensor) { return tensor.name == "output_decoder.0.bias"; });
  for (Eigen::Index i = 0; i < p; ++i) {
    const size_t place = static_cast<size_t>(bias->offset + i);
    const double moved = base.parameters[place] + 0.5 * base.prior->loadings(i, 0);
    EXPECT_NEAR(restored.parameters[place], moved, 1e-6);  // the model's own precision is single
    restored.parameters[place] = base.parameters[place];
  }
  EXPECT_EQ(restored.parameters, base.parameters);
  Bundle other = base;
  other.prior->loadings = Eigen::MatrixXd::Random(p, 2);
  for (Bundle* wrong : {&other, &restored}) {
    if (wrong == &restored) wrong->prior.reset();
    const absl::Status refused = ApplyAdaptedSubset(subset, wrong);
    EXPECT_NE(std::string(refused.message()).find("posterior.coordinates"), std::string::npos) << refused;
  }
}

TEST(ModelFileTest, WhatIsMissingOrDamagedIsNamed) {
  const Bundle bundle = SomeBundle(ModelCases().front());
  const auto message_without = [&](auto change) {
    Safetensors file = *ReadSafetensors(WriteModelFile(bundle));
    change(&file);
    return std::string(ReadModelFile(WriteSafetensors(file)).status().message());
  };
  EXPECT_NE(message_without([](Safetensors* f) { f->tensors.pop_back(); }).find("is missing"), std::string::npos);
  EXPECT_NE(message_without([](Safetensors* f) { f->tensors[0].name = "other"; }).find("\"other\" is not part"), std::string::npos);
  EXPECT_NE(message_without([](Safetensors* f) { f->tensors[0].values[0] = std::nan(""); }).find("value 0 is not finite"), std::string::npos);
  EXPECT_NE(message_without([](Safetensors* f) { f->metadata.clear(); }).find("no \"metaekf\" metadata"), std::string::npos);
  const auto with_metadata = [&](const std::string& from, const std::string& to) {
    return message_without([&](Safetensors* f) {
      std::string& text = f->metadata["metaekf"];
      const size_t at = text.find(from);
      ASSERT_NE(at, std::string::npos) << from;
      text.replace(at, from.size(), to);
    });
  };
  EXPECT_NE(with_metadata("\"format_version\":1", "\"format_version\":2").find("format version 2"), std::string::npos);
  EXPECT_NE(with_metadata("\"hidden_widths\":[4]", "\"hidden_widths\":[5]").find("\"encoder.0.weight\" has not the shape"), std::string::npos);
  EXPECT_EQ(with_metadata("sample_period_s", "sample_period"), "metadata.sample_period_s: is missing");
  EXPECT_NE(with_metadata("\"measurement_cov\":[[1.0", "\"measurement_cov\":[[-1.0").find("measurement_cov"), std::string::npos);
}

std::string Container(const std::string& header, size_t data_bytes) {
  std::string bytes(8, '\0');
  const uint64_t size = header.size();
  std::memcpy(bytes.data(), &size, 8);
  return bytes + header + std::string(data_bytes, '\0');
}

TEST(SafetensorsTest, HostileFilesAreRefused) {
  const std::string tensor = R"("a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]})";
  EXPECT_TRUE(ReadSafetensors(Container("{" + tensor + "}", 8)).ok());
  const std::string bad[] = {
      "",
      "1234567",
      std::string(8, '\xff'),
      Container("{" + tensor + "}", 7),
      Container("{" + tensor + "}", 9),
      Container("{" + tensor + "," + tensor + "}", 8),
      Container("[1]", 0),
      Container("{", 0),
      Container(R"({"a":{"dtype":"I64","shape":[1],"data_offsets":[0,8]}})", 8),
      Container(R"({"a":{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}})", 8),
      Container(R"({"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}})", 0),
      Container(R"({"a":{"dtype":"F32","shape":[1099511627776,1099511627776],"data_offsets":[0,0]}})", 0),
      Container(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]}})", 8),
      Container(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}})", 12),
      Container(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}})", 12),
      Container(R"({"a":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}})", 0),
      Container(R"({"__metadata__":{"k":3}})", 0),
  };
  for (const std::string& bytes : bad) {
    EXPECT_EQ(ReadSafetensors(bytes).status().code(), absl::StatusCode::kInvalidArgument) << bytes;
  }
}

}  // namespace
}  // namespace metaekf::nssm
