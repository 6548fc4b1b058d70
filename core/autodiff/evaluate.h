#pragma once

#include <array>
#include <cstddef>
#include <memory>
#include <span>
#include <vector>

#include "core/autodiff/program.h"

namespace metaekf::autodiff {

/// Memory aligned for the widest vector instructions.
template <typename T>
class AlignedBuffer {
 public:
  explicit AlignedBuffer(int64_t elements);
  T* data() const { return memory_.get(); }

 private:
  struct Free {
    void operator()(T* memory) const;
  };
  std::unique_ptr<T[], Free> memory_;
};

/// Where an instruction finds its operands, in a loop at the step at hand.
template <typename T>
struct Places {
  T* out;
  const T *a, *b, *c;
  T* panel;
};

/// An instruction's way through a loop: where it is, and how many elements on each operand's next step lies.
template <typename T>
struct Walk {
  Places<T> at;
  int64_t out, a, b, c;
};

/// Runs an instruction.
template <typename T>
using Kernel = void (*)(const Instruction& i, const Places<T>& at);

/// An instruction with what it takes to run it, close together: small programs spend their time on finding their way.
template <typename T>
struct Step {
  struct Operand {
    int64_t base;    ///< index of its memory (Memory)
    int64_t offset;  ///< elements
  };
  Kernel<T> run;  ///< null for a loop
  const Instruction* instruction;
  Operand out, a, b, c;
};

/// Elementwise instructions on as many elements each, one behind the other in a program, which run piece by piece: what one of them makes
/// is then still near when the next reads it.
struct Chain {
  size_t first = 0, length = 0;  ///< instructions
  std::vector<Instruction> pieces, ends;  ///< on kPiece elements, and on what is left then
  int64_t elements = 0;
  static constexpr int64_t kPiece = 1024;
};

/// A program with its constants in place and a kernel for each instruction: what runs. Never changes, so threads may share it.
template <typename T>
class Executable {
 public:
  explicit Executable(Program program);

  const Program& program() const { return program_; }
  const std::vector<Step<T>>& steps() const { return steps_; }
  const std::vector<std::vector<Kernel<T>>>& loop_kernels() const { return loop_kernels_; }
  const std::vector<Chain>& chains() const { return chains_; }
  const T* constants() const { return constants_.data(); }

 private:
  Program program_;
  std::vector<Step<T>> steps_;
  std::vector<std::vector<Kernel<T>>> loop_kernels_;
  std::vector<Chain> chains_;
  AlignedBuffer<T> constants_;
};

/// Scratch memory for any of a few executables, one at a time.
template <typename T>
class Arena {
 public:
  /// @param runs  of an executable side by side, at most.
  explicit Arena(const std::vector<const Executable<T>*>& users, size_t runs = 1);
  T* data(size_t run = 0) const { return memory_.data() + static_cast<int64_t>(run) * size_; }
  /// One for each instruction of a loop.
  Walk<T>* walks() const { return walks_.data(); }
  /// Where there are several runs, for second factors and results of a product of all of them.
  T* gathered() const { return gathered_.data(); }

 private:
  int64_t size_;  // of each run
  AlignedBuffer<T> memory_, gathered_;
  mutable std::vector<Walk<T>> walks_;
};

/// Which memory each slot is. Inputs are only read.
template <typename T>
class Slots {
 public:
  static constexpr size_t kMaxSlots = 16;

  Slots& Input(int32_t slot, const T* memory) { return Output(slot, const_cast<T*>(memory)); }
  Slots& Output(int32_t slot, T* memory) {
    pointers_[static_cast<size_t>(slot)] = memory;
    return *this;
  }
  T* const* data() const { return pointers_.data(); }

 private:
  std::array<T*, kMaxSlots> pointers_{};
};

/// For each instruction of an executable its first factor, transposed, as linalg::Pack lays it out, or null: it is read where it lies.
template <typename T>
using Packed = std::vector<const T*>;

/// Runs a program on the CPU, in the calling thread, without allocating.
/// @param packed  or null: nothing is packed.
template <typename T>
void Evaluate(const Executable<T>& executable, const Slots<T>& slots, const Arena<T>& arena, const Packed<T>* packed = nullptr);

template <typename T>
struct Run {
  Slots<T> slots;
  const Packed<T>* packed;
};

/// Several runs of a program, instruction by instruction, so that packed factors that they share are read once. Each does to the bit what it
/// does alone. Without allocating.
/// @param runs  as many as the arena has at most.
template <typename T>
void EvaluateTogether(const Executable<T>& executable, std::span<const Run<T>> runs, const Arena<T>& arena);

}  // namespace metaekf::autodiff
