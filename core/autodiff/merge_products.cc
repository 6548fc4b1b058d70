#include "core/autodiff/merge_products.h"

#include <algorithm>
#include <map>
#include <tuple>

namespace metaekf::autodiff {
namespace {

constexpr int32_t kMostColumns = 8;      // of a merged product
constexpr int64_t kLeastElements = 256;  // of a factor that is worth reading once less

class Merger {
 public:
  Merger(const Graph& graph, const std::vector<Output>& outputs) : graph_(graph), group_(static_cast<size_t>(graph.size())) {
    std::vector<bool> needed(group_.size(), false);
    for (const Output& output : outputs) needed[static_cast<size_t>(output.value)] = true;
    for (Value v = graph.size() - 1; v >= 0; --v) {
      if (!needed[static_cast<size_t>(v)]) continue;
      needed_.push_back(v);
      recurs_ = recurs_ || graph.node(v).op == Op::kScan;
      for (const Value input : graph.node(v).inputs) needed[static_cast<size_t>(input)] = true;
    }
    std::reverse(needed_.begin(), needed_.end());
  }

  std::optional<MergedGraph> Run(const std::vector<Output>& outputs) {
    if (recurs_) return std::nullopt;
    FindGroups();
    if (!merged_) return std::nullopt;
    place_.assign(group_.size(), kNoValue);
    for (const Value v : needed_) Place(v);
    MergedGraph result{std::move(built_), outputs};
    for (Output& output : result.outputs) output.value = place_[static_cast<size_t>(output.value)];
    return result;
  }

 private:
  using Members = std::vector<Value>;

  bool IsCandidate(const Node& node) const {
    if (node.op != Op::kMatMul || node.transpose_b || node.cols > kMostColumns) return false;
    const Node& factor = graph_.node(node.inputs[0]);
    return int64_t{factor.rows} * factor.cols >= kLeastElements;
  }

  void FindGroups() {
    std::map<std::pair<Value, bool>, std::vector<size_t>> groups_of;  // of a factor, transposed or not
    for (const Value v : needed_) {
      const Node& node = graph_.node(v);
      if (!IsCandidate(node)) continue;
      std::vector<size_t>& groups = groups_of[{node.inputs[0], node.transpose_a}];
      const auto takes = [&](size_t g) {
        return Columns(groups_[g]) + node.cols <= kMostColumns && !DependsOn({v}, groups_[g]) && !DependsOn(groups_[g], {v});
      };
      const auto group = std::find_if(groups.begin(), groups.end(), takes);
      if (group == groups.end()) {
        group_[static_cast<size_t>(v)] = groups_.size();
        groups.push_back(groups_.size());
        groups_.push_back({v});
      } else {
        group_[static_cast<size_t>(v)] = *group;
        groups_[*group].push_back(v);
        merged_ = true;
      }
    }
  }

  int32_t Columns(const Members& members) const {
    int32_t sum = 0;
    for (const Value v : members) sum += graph_.node(v).cols;
    return sum;
  }

  const Members* GroupOf(Value v) const {
    const std::optional<size_t>& group = group_[static_cast<size_t>(v)];
    return group ? &groups_[*group] : nullptr;
  }

  /// Whether `later` reads, over whatever way, what `earlier` computes. Who waits for one of a group waits for all of it.
  bool DependsOn(const Members& later, const Members& earlier) const {
    std::vector<bool> seen(group_.size(), false);
    Members open = later;
    while (!open.empty()) {
      const Value v = open.back();
      open.pop_back();
      for (const Value input : graph_.node(v).inputs) {
        if (std::find(earlier.begin(), earlier.end(), input) != earlier.end()) return true;
        if (seen[static_cast<size_t>(input)]) continue;
        const Members* group = GroupOf(input);
        for (const Value member : group ? *group : Members{input}) {
          if (std::find(earlier.begin(), earlier.end(), member) != earlier.end()) return true;
          if (!seen[static_cast<size_t>(member)]) open.push_back(member);
          seen[static_cast<size_t>(member)] = true;
        }
      }
    }
    return false;
  }

  /// Appends what `v` needs, and it.
  Value Place(Value v) {
    Value& place = place_[static_cast<size_t>(v)];
    if (place != kNoValue) return place;
    const Members* group = GroupOf(v);
    if (group != nullptr && group->size() > 1) {
      PlaceGroup(*group);
      return place;
    }
    Node node = graph_.node(v);
    for (Value& input : node.inputs) input = Place(input);
    return place = built_.Append(std::move(node));
  }

  void PlaceGroup(const Members& group) {
    Node product = graph_.node(group.front());
    std::vector<Value> columns;
    for (const Value member : group) columns.push_back(Place(graph_.node(member).inputs[1]));
    product.cols = Columns(group);
    product.inputs = {Place(product.inputs[0]), built_.ConcatCols(columns)};
    const Value whole = built_.Append(std::move(product));
    int32_t first = 0;
    for (const Value member : group) {
      place_[static_cast<size_t>(member)] = built_.SliceCols(whole, first, graph_.node(member).cols);
      first += graph_.node(member).cols;
    }
  }

  const Graph& graph_;
  Members needed_;  // in their order
  bool recurs_ = false, merged_ = false;
  std::vector<std::optional<size_t>> group_;  // of each value: index into groups_
  std::vector<Members> groups_;
  Graph built_;
  std::vector<Value> place_;  // of each value, in what is built
};

}  // namespace

std::optional<MergedGraph> MergeProducts(const Graph& graph, const std::vector<Output>& outputs) {
  return Merger(graph, outputs).Run(outputs);
}

}  // namespace metaekf::autodiff
