#include "core/autodiff/activation.h"

namespace metaekf::autodiff {
bool IsSmooth(Activation activation) {
  switch (activation) {
    case Activation::kIdentity:
    case Activation::kTanh:
    case Activation::kSwish:
    case Activation::kMish:
    case Activation::kSoftplus:
    case Activation::kSine:
    case Activation::kSigmoid:
    case Activation::kTanhSlope:
      return true;
    default:
      return false;
  }
}

bool DerivativeIsZero(Activation activation, int order) {
  const bool piecewise_linear = activation == Activation::kIdentity || activation == Activation::kRelu ||
                                activation == Activation::kLeakyRelu;
  return (piecewise_linear && order >= 2) || (activation == Activation::kTanhSlope && order >= 3);
}

double DefaultParameter(Activation activation) {
  return activation == Activation::kLeakyRelu ? 0.01 : activation == Activation::kElu || activation == Activation::kSwish ? 1.0 : 0.0;
}

}  // namespace metaekf::autodiff
