#include "core/nn/parameters.h"

#include <set>

#include "absl/strings/ascii.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::nn {
namespace {

bool GlobMatches(const char* pattern, const char* text) {
  if (*pattern == '\0') return *text == '\0';
  if (*pattern == '*') return GlobMatches(pattern + 1, text) || (*text != '\0' && GlobMatches(pattern, text + 1));
  return *pattern == *text && GlobMatches(pattern + 1, text + 1);
}

bool IsNumber(const std::string& text) {
  return !text.empty() && text.size() < 6 && text.find_first_not_of("0123456789") == std::string::npos;
}

/// "4-5" against "4"; anything else as a glob.
bool ComponentMatches(const std::string& pattern, const std::string& component) {
  const size_t dash = pattern.find('-');
  if (dash != std::string::npos && IsNumber(component)) {
    const std::string low = pattern.substr(0, dash), high = pattern.substr(dash + 1);
    if (!IsNumber(low) || !IsNumber(high)) return false;
    const int layer = std::stoi(component);
    return layer >= std::stoi(low) && layer <= std::stoi(high);
  }
  return GlobMatches(pattern.c_str(), component.c_str());
}

bool ItemMatches(const std::vector<std::string>& item, const std::vector<std::string>& name) {
  if (item.size() > name.size()) return false;
  for (size_t i = 0; i < item.size(); ++i) {
    if (!ComponentMatches(item[i], name[i])) return false;
  }
  return true;
}

std::string BlockNames(const ParameterLayout& layout) {
  std::set<std::string> names;
  for (const Tensor& tensor : layout.tensors()) names.insert(tensor.name.substr(0, tensor.name.rfind('.')));
  return absl::StrJoin(names, ", ");
}

}  // namespace

size_t ParameterLayout::Add(std::string name, int32_t out, int32_t in, bool is_bias) {
  tensors_.push_back({std::move(name), out, in, size_, is_bias});
  size_ += tensors_.back().size();
  return tensors_.size() - 1;
}

TensorMap TensorIn(const ParameterLayout& layout, const std::string& name, std::span<double> parameters) {
  for (const Tensor& tensor : layout.tensors()) {
    if (tensor.name == name) return TensorMap(parameters.data() + tensor.offset, tensor.out, tensor.in);
  }
  return TensorMap(nullptr, 0, 0);
}

absl::StatusOr<Mask> ParseMask(const std::string& text, const ParameterLayout& layout) {
  Mask mask(layout.tensors().size(), false);
  const std::vector<std::string> items = absl::StrSplit(text.empty() ? "*" : text, ',');
  for (std::string item : items) {
    absl::StripAsciiWhitespace(&item);
    const std::vector<std::string> components = absl::StrSplit(item, '.');
    bool any = false;
    for (size_t i = 0; i < mask.size(); ++i) {
      const std::vector<std::string> name = absl::StrSplit(layout.tensors()[i].name, '.');
      if (!ItemMatches(components, name)) continue;
      mask[i] = true;
      any = true;
    }
    if (!any) {
      return absl::InvalidArgumentError(absl::StrCat("adapted mask: \"", item, "\" matches no parameter of the model; there are ",
                                                     BlockNames(layout)));
    }
  }
  return mask;
}

Pieces PiecesOf(const ParameterLayout& layout, const Mask& mask, bool flag) {
  Pieces pieces;
  for (size_t i = 0; i < mask.size(); ++i) {
    const Tensor& tensor = layout.tensors()[i];
    if (mask[i] == flag) pieces.push_back({tensor.offset, tensor.size()});
  }
  return pieces;
}

void ForParts(const Pieces& pieces, base::Executor* executor, absl::FunctionRef<void(size_t, int64_t, int64_t)> work) {
  constexpr int64_t kWorthAThread = 1 << 16;  // elements
  int64_t size = 0;
  for (const auto& piece : pieces) size += piece.second;
  const int64_t parts = size < kWorthAThread ? 1 : static_cast<int64_t>(executor->concurrency());
  const auto run = [&](int64_t part) {
    for (size_t i = 0; i < pieces.size(); ++i) {
      const auto [offset, count] = pieces[i];
      work(i, offset + count * part / parts, offset + count * (part + 1) / parts);
    }
  };
  if (parts == 1) return run(0);
  executor->ParallelFor(static_cast<size_t>(parts), [&](size_t part, size_t) { run(static_cast<int64_t>(part)); });
}

ParameterValues BindParameters(const ParameterLayout& layout, int32_t slot, autodiff::Graph* graph) {
  ParameterValues values;
  for (const Tensor& tensor : layout.tensors()) {
    // A row-major out × in matrix is a column-major in × out one. A bias is a column of `out` rows.
    values.push_back(tensor.is_bias ? graph->Input(slot, tensor.offset, tensor.out, 1)
                                    : graph->Input(slot, tensor.offset, tensor.in, tensor.out));
  }
  return values;
}

}  // namespace metaekf::nn
