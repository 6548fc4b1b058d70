#include "core/autodiff/activation.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "tests/core/autodiff/reference_activation.h"

namespace metaekf::autodiff {
namespace {

constexpr Activation kAll[] = {Activation::kIdentity, Activation::kRelu,  Activation::kLeakyRelu,
                               Activation::kElu,      Activation::kSelu,  Activation::kTanh,
                               Activation::kSwish,    Activation::kMish,  Activation::kSoftplus, Activation::kSine, Activation::kSigmoid, Activation::kTanhSlope};

double Value(Activation activation, int order, double z, double a) {
  double out;
  ApplyActivation(activation, order, a, &z, &out, 1);
  return out;
}

// By hand: max(z, 0), 0.01 z, eᶻ − 1 and tanh z at z = 0.7 and −1.3.
TEST(ActivationTest, ValuesMatchHandComputedOnes) {
  const struct {
    Activation activation;
    double positive, negative;
  } expected[] = {
      {Activation::kRelu, 0.7, 0},
      {Activation::kLeakyRelu, 0.7, -0.013},
      {Activation::kElu, 0.7, -0.7274682069659875},
      {Activation::kTanh, 0.6043677771171635, -0.8617231593133063},
  };
  for (const auto& e : expected) {
    EXPECT_NEAR(Value(e.activation, 0, 0.7, DefaultParameter(e.activation)), e.positive, 1e-15);
    EXPECT_NEAR(Value(e.activation, 0, -1.3, DefaultParameter(e.activation)), e.negative, 1e-15);
  }
}

// Identities that define the functions: swish z·s(z), softplus log(1 + eᶻ), mish z·tanh(softplus z), with
// SELU's published constants.
TEST(ActivationTest, ValuesMatchTheirDefinitions) {
  for (const double z : {-3.0, -0.4, 0.0, 0.9, 4.0}) {
    const double softplus = std::log(1 + std::exp(z));
    EXPECT_NEAR(Value(Activation::kSwish, 0, z, 0), z / (1 + std::exp(-z)), 1e-15);
    EXPECT_NEAR(Value(Activation::kSoftplus, 0, z, 0), softplus, 1e-15);
    EXPECT_NEAR(Value(Activation::kMish, 0, z, 0), z * std::tanh(softplus), 1e-15);
    const double selu = z > 0 ? 1.0507009873554805 * z : 1.0507009873554805 * 1.6732632423543772 * (std::exp(z) - 1);
    EXPECT_NEAR(Value(Activation::kSelu, 0, z, 0), selu, 1e-15);
  }
}

// Oracle: the formulas one element at a time with the standard library; its functions and Highway's differ by a few ulp.
TEST(ActivationTest, VectorsEqualTheReferenceWhereverAnElementStands) {
  for (const Activation activation : kAll) {
    const double a = DefaultParameter(activation);
    for (int order = 0; order <= kMaxDerivative; ++order) {
      std::vector<double> z, out;
      for (double v = -30; v < 30; v += 0.173) z.push_back(v);
      out.resize(z.size());
      for (const size_t count : {z.size(), z.size() - 1, z.size() - 3}) {
        ApplyActivation(activation, order, a, z.data(), out.data(), count);
        for (size_t i = 0; i < count; ++i) {
          const double expected = reference::Apply(activation, order, a, z[i]);
          EXPECT_NEAR(out[i], expected, 1e-13 * (1 + std::fabs(z[i]) + std::fabs(expected)))
              << "activation " << static_cast<int>(activation) << " order " << order << " z " << z[i];
          EXPECT_EQ(out[i], Value(activation, order, z[i], a));
        }
      }
    }
  }
}

TEST(ActivationTest, EachDerivativeIsTheSlopeOfTheOneBelow) {
  for (const Activation activation : kAll) {
    const double a = activation == Activation::kElu ? 0.8 : DefaultParameter(activation);
    for (int order = 1; order <= kMaxDerivative; ++order) {
      for (double z = -4.05; z < 4; z += 0.1) {  // never at the kink
        const double h = 1e-5;
        const double slope = (Value(activation, order - 1, z + h, a) - Value(activation, order - 1, z - h, a)) / (2 * h);
        EXPECT_NEAR(Value(activation, order, z, a), slope, 1e-8)
            << "activation " << static_cast<int>(activation) << " order " << order << " z " << z;
      }
    }
  }
}

// In float tanh is a quotient of polynomials of our own.
TEST(ActivationTest, TanhInFloatIsTanhToItsRounding) {
  for (float z = 1e-30f; z < 1e6f; z *= 1.0007f) {
    for (const float signed_z : {z, -z}) {
      float out;
      ApplyActivation(Activation::kTanh, 0, 0.0f, &signed_z, &out, 1);
      const double expected = std::tanh(static_cast<double>(signed_z));
      ASSERT_NEAR(out, expected, 4e-7 * std::fabs(expected)) << signed_z;
      ASSERT_LE(std::fabs(out), 1.0f) << signed_z;
    }
  }
}

TEST(ActivationTest, WhatIsNoNumberStaysNone) {
  for (const Activation activation : kAll) {
    const float none = std::nanf("");
    float out;
    ApplyActivation(activation, 0, 0.0f, &none, &out, 1);
    EXPECT_TRUE(std::isnan(out)) << static_cast<int>(activation);
    EXPECT_TRUE(std::isnan(Value(activation, 0, std::nan(""), 0))) << static_cast<int>(activation);
  }
}

TEST(ActivationTest, ExtremeArgumentsStayFinite) {
  for (const Activation activation : kAll) {
    for (int order = 0; order <= kMaxDerivative; ++order) {
      for (const double z : {-750.0, -80.0, 80.0, 750.0}) {
        EXPECT_TRUE(std::isfinite(Value(activation, order, z, DefaultParameter(activation))))
            << "activation " << static_cast<int>(activation) << " order " << order << " z " << z;
        float zf = static_cast<float>(z), out;
        ApplyActivation(activation, order, static_cast<float>(DefaultParameter(activation)), &zf, &out, 1);
        EXPECT_TRUE(std::isfinite(out)) << "float, activation " << static_cast<int>(activation) << " order " << order;
      }
    }
  }
}

}  // namespace
}  // namespace metaekf::autodiff
