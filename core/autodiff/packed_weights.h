#pragma once

#include <cstdint>
#include <initializer_list>
#include <map>
#include <memory>
#include <tuple>
#include <vector>

#include "core/autodiff/evaluate.h"

namespace metaekf::autodiff {

/// Large factors of products as linalg::Pack lays them out, of weights that many runs of a few executables read: their transposes, which a
/// layer multiplies with. Immutable.
template <typename T>
class PackedWeights {
 public:
  /// @param slot  of the users' inputs: the weights. @param weights  what it holds; it must outlive this.
  /// @param like  other weights of the same users, or null: what is the same in both is kept once, and products with it can be run
  ///   together (EvaluateTogether).
  PackedWeights(std::initializer_list<const Executable<T>*> users, int32_t slot, const T* weights, const PackedWeights* like);

  /// For each instruction of a user, by its place among them, its first factor; null where it reads the slot.
  const Packed<T>& Of(size_t user) const { return packed_[user]; }
  /// The same without factors of which elements `changed` says so: of a run whose weights are others there.
  /// @param changed  one flag for each element of the slot.
  Packed<T> Without(size_t user, const std::vector<bool>& changed) const;

 private:
  /// offset in the slot, ld, rows and columns
  using Key = std::tuple<int64_t, int32_t, int32_t, int32_t>;
  using Buffer = std::shared_ptr<const AlignedBuffer<T>>;
  static Key KeyOf(const Instruction& i);
  Buffer Find(const Key& key, const PackedWeights* like) const;

  const T* const weights_;
  std::vector<const Executable<T>*> users_;
  std::map<Key, Buffer> factors_;
  std::vector<Packed<T>> packed_;
};

}  // namespace metaekf::autodiff
