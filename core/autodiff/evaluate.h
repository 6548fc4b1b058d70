#pragma once

#include <array>
#include <cstddef>
#include <memory>
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

/// A program with its constants in place and a kernel for each instruction: what runs. Never changes, so threads may share it.
template <typename T>
class Executable {
 public:
  explicit Executable(Program program);

  const Program& program() const { return program_; }
  const std::vector<Kernel<T>>& kernels() const { return kernels_; }
  const std::vector<std::vector<Kernel<T>>>& loop_kernels() const { return loop_kernels_; }
  const T* constants() const { return constants_.data(); }

 private:
  Program program_;
  std::vector<Kernel<T>> kernels_;
  std::vector<std::vector<Kernel<T>>> loop_kernels_;
  AlignedBuffer<T> constants_;
};

/// Scratch memory for any of a few executables, one at a time.
template <typename T>
class Arena {
 public:
  explicit Arena(const std::vector<const Executable<T>*>& users);
  T* data() const { return memory_.data(); }
  /// One for each instruction of a loop.
  Walk<T>* walks() const { return walks_.data(); }

 private:
  AlignedBuffer<T> memory_;
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

/// Runs a program on the CPU, in the calling thread, without allocating.
template <typename T>
void Evaluate(const Executable<T>& executable, const Slots<T>& slots, const Arena<T>& arena);

}  // namespace metaekf::autodiff
