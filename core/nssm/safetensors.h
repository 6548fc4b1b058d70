#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace metaekf::nssm {

/// The safetensors container: a JSON header (names, types, shapes, offsets, text metadata) before the raw values.
struct Safetensors {
  struct Tensor {
    std::string name;
    std::vector<int64_t> shape;
    bool is_float32 = false;     ///< F32 in the file, else F64
    std::vector<double> values;  ///< row-major
  };
  std::vector<Tensor> tensors;
  std::map<std::string, std::string> metadata;
};

std::string WriteSafetensors(const Safetensors& file);

/// Reads bytes from a stranger: the header may have 1 MiB and 4,096 tensors at most, offsets must be contiguous and
/// inside the file, names unique, values finite.
/// Errors: InvalidArgument naming the tensor and what is wrong with it.
absl::StatusOr<Safetensors> ReadSafetensors(const std::string& bytes);

}  // namespace metaekf::nssm
