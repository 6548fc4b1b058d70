#include "core/autodiff/packed_weights.h"

#include <cstring>

#include "core/linalg/packed_product.h"

namespace metaekf::autodiff {
namespace {

constexpr int64_t kLeastElements = 4096;  // of a factor: smaller ones are at hand anyway

bool IsPackable(const Instruction& i, int32_t slot) {
  return (i.op == Opcode::kMatMul || i.op == Opcode::kMatMulAdd) && i.a.slot == slot && !i.transpose_b && int64_t{i.rows} * i.inner >= kLeastElements;
}

}  // namespace

template <typename T>
typename PackedWeights<T>::Key PackedWeights<T>::KeyOf(const Instruction& i) {
  return {i.a.offset, i.a.ld, i.transpose_a ? i.inner : i.rows, i.transpose_a ? i.rows : i.inner};
}

template <typename T>
PackedWeights<T>::PackedWeights(std::initializer_list<const Executable<T>*> users, int32_t slot, const T* weights, const PackedWeights* like)
    : weights_(weights), users_(users) {
  for (const Executable<T>* user : users_) {
    Packed<T> of_user;
    for (const Instruction& i : user->program().instructions) {
      if (!IsPackable(i, slot)) {
        of_user.push_back(nullptr);
        continue;
      }
      const Key key = KeyOf(i);
      Buffer& factor = factors_[key];
      if (factor == nullptr) factor = Find(key, like);
      if (factor == nullptr) {
        const auto [offset, ld, rows, columns] = key;
        auto made = std::make_shared<AlignedBuffer<T>>(linalg::PackedSize(columns, rows));
        linalg::Pack(true, columns, rows, weights + offset, ld, made->data());
        factor = std::move(made);
      }
      of_user.push_back(factor->data());
    }
    packed_.push_back(std::move(of_user));
  }
}

template <typename T>
typename PackedWeights<T>::Buffer PackedWeights<T>::Find(const Key& key, const PackedWeights* like) const {
  if (like == nullptr) return nullptr;
  const auto found = like->factors_.find(key);
  if (found == like->factors_.end()) return nullptr;
  const auto [offset, ld, rows, columns] = key;
  for (int64_t column = 0; column < columns; ++column) {
    const int64_t at = offset + column * ld;
    if (std::memcmp(weights_ + at, like->weights_ + at, sizeof(T) * static_cast<size_t>(rows)) != 0) return nullptr;
  }
  return found->second;
}

template <typename T>
Packed<T> PackedWeights<T>::Without(size_t user, const std::vector<bool>& changed) const {
  Packed<T> kept = packed_[user];
  for (size_t k = 0; k < kept.size(); ++k) {
    if (kept[k] == nullptr) continue;
    const auto [offset, ld, rows, columns] = KeyOf(users_[user]->program().instructions[k]);
    for (int64_t e = 0; e < int64_t{rows} * columns; ++e) {
      if (changed[static_cast<size_t>(offset + e / rows * ld + e % rows)]) kept[k] = nullptr;
    }
  }
  return kept;
}

template class PackedWeights<float>;
template class PackedWeights<double>;

}  // namespace metaekf::autodiff
