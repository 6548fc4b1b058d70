#include "core/autodiff/evaluate.h"

#include <algorithm>
#include <new>

#include "core/autodiff/kernel.h"

namespace metaekf::autodiff {
namespace {

constexpr std::align_val_t kAlignment{128};

template <typename T>
std::vector<Kernel<T>> SelectKernels(const std::vector<Instruction>& instructions) {
  std::vector<Kernel<T>> kernels;
  for (const Instruction& i : instructions) kernels.push_back(SelectKernel<T>(i));
  return kernels;
}

template <typename T>
void RunLoop(const Loop& loop, const std::vector<Kernel<T>>& kernels, const Memory<T>& memory, Walk<T>* walks) {
  const size_t size = loop.instructions.size();
  const int64_t first = loop.reverse ? loop.length - 1 : 0, by = loop.reverse ? -1 : 1;
  for (size_t k = 0; k < size; ++k) {
    const Instruction& i = loop.instructions[k];
    Places<T> at = memory.PlacesOf(i);
    if (i.panel >= 0) MakePanel(i, at);
    at.out += first * i.out.step_stride;
    at.a += first * i.a.step_stride;
    at.b += first * i.b.step_stride;
    at.c += first * i.c.step_stride;
    walks[k] = {at, by * i.out.step_stride, by * i.a.step_stride, by * i.b.step_stride, by * i.c.step_stride};
  }
  const Instruction* const instructions = loop.instructions.data();
  const Kernel<T>* const run = kernels.data();
  for (int64_t n = 0; n < loop.length; ++n) {
    for (size_t k = 0; k < size; ++k) {
      Walk<T>& walk = walks[k];
      run[k](instructions[k], walk.at);
      walk.at.out += walk.out;
      walk.at.a += walk.a;
      walk.at.b += walk.b;
      walk.at.c += walk.c;
    }
  }
}

}  // namespace

template <typename T>
void AlignedBuffer<T>::Free::operator()(T* memory) const {
  ::operator delete[](memory, kAlignment);
}

template <typename T>
AlignedBuffer<T>::AlignedBuffer(int64_t elements)
    : memory_(static_cast<T*>(
          ::operator new[](sizeof(T) * static_cast<size_t>(std::max<int64_t>(elements, 1)), kAlignment))) {}

template <typename T>
Executable<T>::Executable(Program program)
    : program_(std::move(program)), kernels_(SelectKernels<T>(program_.instructions)), constants_(program_.constants_size) {
  for (const Loop& loop : program_.loops) loop_kernels_.push_back(SelectKernels<T>(loop.instructions));
  for (const Program::ConstantBlock& block : program_.constants) {
    T* target = constants_.data() + block.offset;
    if (block.data) {
      std::copy(block.data->begin(), block.data->end(), target);
    } else {
      std::fill(target, target + block.size, static_cast<T>(block.scalar));
    }
  }
}

template <typename T>
Arena<T>::Arena(const std::vector<const Executable<T>*>& users)
    : memory_((*std::max_element(users.begin(), users.end(), [](const Executable<T>* a, const Executable<T>* b) {
                return a->program().arena_size < b->program().arena_size;
              }))->program().arena_size) {
  size_t walks = 0;
  for (const Executable<T>* user : users) {
    for (const Loop& loop : user->program().loops) walks = std::max(walks, loop.instructions.size());
  }
  walks_.resize(walks);
}

template <typename T>
void Evaluate(const Executable<T>& executable, const Slots<T>& slots, const Arena<T>& arena) {
  const Program& program = executable.program();
  const Memory<T> memory(arena.data(), executable.constants(), slots);
  for (size_t k = 0; k < program.instructions.size(); ++k) {
    const Instruction& i = program.instructions[k];
    if (i.op == Opcode::kLoop) {
      const size_t loop = static_cast<size_t>(i.loop);
      RunLoop(program.loops[loop], executable.loop_kernels()[loop], memory, arena.walks());
    } else {
      executable.kernels()[k](i, memory.PlacesOf(i));
    }
  }
}

template class AlignedBuffer<float>;
template class AlignedBuffer<double>;
template class Executable<float>;
template class Executable<double>;
template class Arena<float>;
template class Arena<double>;
template void Evaluate(const Executable<float>&, const Slots<float>&, const Arena<float>&);
template void Evaluate(const Executable<double>&, const Slots<double>&, const Arena<double>&);

}  // namespace metaekf::autodiff
