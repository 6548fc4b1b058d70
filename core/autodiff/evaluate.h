#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "core/autodiff/program.h"

namespace metaekf::autodiff {

/// The scratch memory of one running program: an arena, and the program's constants.
template <typename T>
class Workspace {
 public:
  explicit Workspace(const Program& program);

  T* arena() { return arena_.get(); }
  T* constants() { return constants_.get(); }

 private:
  struct Free {
    void operator()(T* memory) const;
  };
  static std::unique_ptr<T[], Free> Allocate(int64_t elements);

  std::unique_ptr<T[], Free> arena_;  // aligned to 128 bytes
  std::unique_ptr<T[], Free> constants_;
};

/// Which memory each slot is. Inputs are only read.
template <typename T>
class Slots {
 public:
  explicit Slots(const Program& program) : pointers_(static_cast<size_t>(program.slots), nullptr) {}

  Slots& Input(int32_t slot, const T* memory) { return Set(slot, const_cast<T*>(memory)); }
  Slots& Output(int32_t slot, T* memory) { return Set(slot, memory); }
  T* const* data() const { return pointers_.data(); }

 private:
  /// A slot that the program turned out not to need is ignored.
  Slots& Set(int32_t slot, T* memory) {
    if (static_cast<size_t>(slot) < pointers_.size()) pointers_[static_cast<size_t>(slot)] = memory;
    return *this;
  }
  std::vector<T*> pointers_;
};

/// Runs a program on the CPU, in the calling thread: no allocation. Programs may be shared between threads,
/// workspaces may not.
template <typename T>
void Evaluate(const Program& program, const Slots<T>& slots, Workspace<T>* workspace);

}  // namespace metaekf::autodiff
