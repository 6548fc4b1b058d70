#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "core/autodiff/graph.h"
#include "core/base/executor.h"

namespace metaekf::nn {

/// One named tensor inside a model's flat parameter vector ω: row-major, out × in, PyTorch's nn.Linear layout.
/// A bias has in = 1.
struct Tensor {
  std::string name;  ///< e.g. "encoder.0.weight"
  int32_t out = 0;
  int32_t in = 0;
  int64_t offset = 0;
  bool is_bias = false;

  int64_t size() const { return int64_t{out} * in; }
};

/// The tensors of a model, in the order in which they stand in ω.
class ParameterLayout {
 public:
  /// Appends a tensor and returns its index.
  size_t Add(std::string name, int32_t out, int32_t in, bool is_bias = false);

  const std::vector<Tensor>& tensors() const { return tensors_; }
  int64_t size() const { return size_; }

 private:
  std::vector<Tensor> tensors_;
  int64_t size_ = 0;
};

/// The tensor of a name within ω, out × in, to read and to write; 0 × 0 where the layout has none.
using TensorMap = Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>;
TensorMap TensorIn(const ParameterLayout& layout, const std::string& name, std::span<double> parameters);

/// Which tensors adapt: one flag per tensor of a layout.
using Mask = std::vector<bool>;

/// Reads a mask such as "encoder.4-5,transition,*_decoder".
///
/// Items are separated by commas; an item names tensors by leading components, where `*` matches any run of
/// characters and a component `4-5` the layers 4 and 5. "" and "*" mean all.
/// Errors: InvalidArgument naming the item that matches nothing, with the names there are.
absl::StatusOr<Mask> ParseMask(const std::string& text, const ParameterLayout& layout);

/// Offset and size in ω of each tensor whose flag in the mask is `flag`, in the layout's order.
using Pieces = std::vector<std::pair<int64_t, int64_t>>;
Pieces PiecesOf(const ParameterLayout& layout, const Mask& mask, bool flag);

/// Calls work(piece, begin, end) for elements begin … end − 1 of ω, until all of the pieces are done: those of large models side by side.
/// For work on one element after the other: what it does to one must not depend on where parts begin.
void ForParts(const Pieces& pieces, base::Executor* executor, absl::FunctionRef<void(size_t piece, int64_t begin, int64_t end)> work);

/// Parameters as values of a graph, one per tensor, each stored in × out (the transpose of the tensor).
using ParameterValues = std::vector<autodiff::Value>;

/// Appends one input per tensor, read from the flat vector in `slot`.
ParameterValues BindParameters(const ParameterLayout& layout, int32_t slot, autodiff::Graph* graph);

}  // namespace metaekf::nn
