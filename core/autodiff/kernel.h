#pragma once

#include <algorithm>
#include <array>
#include <cstdint>

#include "core/autodiff/evaluate.h"
#include "core/autodiff/program.h"

namespace metaekf::autodiff {

/// The memory of a running program, in which instructions find their operands.
template <typename T>
class Memory {
 public:
  Memory(T* arena, const T* constants, const Slots<T>& slots) {
    bases_[kBefore + Operand::kArena] = arena;
    bases_[kBefore + Operand::kConstants] = const_cast<T*>(constants);
    std::copy_n(slots.data(), Slots<T>::kMaxSlots, bases_.begin() + kBefore);
  }

  static Step<T> StepOf(const Instruction& i, Kernel<T> kernel) {
    const auto operand = [](const Operand& o) { return typename Step<T>::Operand{int64_t{kBefore} + o.slot, o.offset}; };
    return {kernel, &i, operand(i.out), operand(i.a), operand(i.b), operand(i.c)};
  }

  Places<T> PlacesOf(const Step<T>& step) const {
    const auto at = [this](const typename Step<T>::Operand& o) { return bases_[static_cast<size_t>(o.base)] + o.offset; };
    return {.out = at(step.out), .a = at(step.a), .b = at(step.b), .c = at(step.c), .panel = nullptr};
  }

  /// Of an instruction in a loop.
  Places<T> PlacesOf(const Instruction& i) const {
    return {.out = At(i.out), .a = At(i.a), .b = At(i.b), .c = At(i.c), .panel = bases_[kBefore + Operand::kArena] + std::max<int64_t>(i.panel, 0)};
  }

 private:
  T* At(const Operand& operand) const { return bases_[static_cast<size_t>(kBefore + operand.slot)] + operand.offset; }

  static constexpr int32_t kBefore = 2;
  std::array<T*, kBefore + Slots<T>::kMaxSlots> bases_;
};

/// Calls visit(place in the result, place in the tiled operand, elements) for every tile.
template <typename Visit>
void ForEachTile(const Instruction& i, const Operand& tiled, Visit visit) {
  const int64_t size = int64_t{i.rows} * tiled.tile_width;
  const int64_t blocks = i.cols / (int64_t{tiled.tile_width} * tiled.tile_count);
  int64_t at = 0;
  for (int64_t block = 0; block < blocks; ++block) {
    for (int32_t repeat = 0; repeat < tiled.tile_count; ++repeat, at += size) visit(at, block * size, size);
  }
}

/// The kernel of an instruction, for its shape and for the processor at hand.
template <typename T>
Kernel<T> SelectKernel(const Instruction& i);

/// Of an elementwise operation, of a product with a panel or of few elements: in vectors. Null for others.
template <typename T>
Kernel<T> SelectVectorKernel(const Instruction& i);
/// Of an activation.
template <typename T>
Kernel<T> SelectActivationKernel(Activation activation, int order);

/// out ← C of a kMatMulAdd.
template <typename T>
void CopyAddend(const Instruction& i, const Places<T>& at);

/// Elements of the panel of a product: op(A), column by column, each with zeros below it up to whole vectors.
int64_t PanelSize(int32_t rows, int32_t inner);
/// Lays out the first factor of a product that has a panel.
template <typename T>
void MakePanel(const Instruction& i, const Places<T>& at);

}  // namespace metaekf::autodiff
