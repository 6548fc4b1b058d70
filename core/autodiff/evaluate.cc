#include "core/autodiff/evaluate.h"

#include <algorithm>
#include <cstdlib>
#include <new>

#include "absl/container/inlined_vector.h"
#include "core/autodiff/kernel.h"
#include "core/linalg/packed_product.h"

namespace metaekf::autodiff {
namespace {

constexpr int64_t kArenaAlignment = 128;  // bytes
constexpr std::align_val_t kAlignment{kArenaAlignment};

template <typename T>
std::vector<Step<T>> StepsOf(const std::vector<Instruction>& instructions) {
  std::vector<Step<T>> steps;
  for (const Instruction& i : instructions) steps.push_back(Memory<T>::StepOf(i, SelectKernel<T>(i)));
  return steps;
}

template <typename T>
std::vector<Kernel<T>> SelectKernels(const std::vector<Instruction>& instructions) {
  std::vector<Kernel<T>> kernels;
  for (const Instruction& i : instructions) kernels.push_back(SelectKernel<T>(i));
  return kernels;
}

/// Whether each element of out is made of the elements of a, and of b, at the same place.
bool IsElementwise(const Instruction& i) {
  switch (i.op) {
    case Opcode::kAdd:
    case Opcode::kSub:
    case Opcode::kMul:
    case Opcode::kScale:
    case Opcode::kActivation:
      return i.a.tile_width == 0 && i.b.tile_width == 0;
    default:
      return false;
  }
}

/// Whether `elements` at two places are the same ones or have none in common.
bool SameOrApart(const Operand& one, const Operand& other, int64_t elements) {
  return one.slot != other.slot || one.offset == other.offset || std::abs(one.offset - other.offset) >= elements;
}

bool ReadsTwo(const Instruction& i) {
  if (i.op == Opcode::kActivation) return i.activation == Activation::kSwish;
  return i.op != Opcode::kScale;
}

/// Whether an elementwise instruction may begin before another is done, of which the same elements are.
bool MayFollow(const Instruction& i, const Instruction& before, int64_t elements) {
  const auto apart = [elements](const Instruction& reader, const Operand& out) {
    return SameOrApart(reader.a, out, elements) && (!ReadsTwo(reader) || SameOrApart(reader.b, out, elements));
  };
  return apart(i, before.out) && apart(before, i.out) && SameOrApart(i.out, before.out, elements);
}

/// Of the same values on less: the first so many elements.
Instruction PieceOf(Instruction i, int64_t elements) {
  i.rows = static_cast<int32_t>(elements);
  i.cols = 1;
  return i;
}

std::vector<Chain> ChainsOf(const std::vector<Instruction>& all) {
  std::vector<Chain> chains;
  const auto elements = [&all](size_t k) { return int64_t{all[k].rows} * all[k].cols; };
  for (size_t first = 0; first < all.size();) {
    size_t end = first;
    const auto goes_on = [&] {
      if (end == all.size() || !IsElementwise(all[end]) || elements(end) != elements(first)) return false;
      return std::all_of(all.begin() + static_cast<ptrdiff_t>(first), all.begin() + static_cast<ptrdiff_t>(end),
                         [&](const Instruction& before) { return MayFollow(all[end], before, elements(first)); });
    };
    while (goes_on()) ++end;
    if (end - first > 1 && elements(first) > Chain::kPiece) {
      Chain chain{.first = first, .length = end - first, .elements = elements(first)};
      for (size_t k = first; k < end; ++k) {
        chain.pieces.push_back(PieceOf(all[k], Chain::kPiece));
        chain.ends.push_back(PieceOf(all[k], chain.elements % Chain::kPiece));
      }
      chains.push_back(std::move(chain));
    }
    first = std::max(end, first + 1);
  }
  return chains;
}

template <typename T>
void RunChain(const Chain& chain, const Step<T>* steps, const Memory<T>& memory) {
  const auto run = [&](const std::vector<Instruction>& instructions, int64_t begin) {
    for (size_t k = 0; k < chain.length; ++k) {
      Places<T> at = memory.PlacesOf(steps[k]);
      at.out += begin;
      at.a += begin;
      at.b += begin;
      steps[k].run(instructions[k], at);
    }
  };
  int64_t begin = 0;
  for (; begin + Chain::kPiece <= chain.elements; begin += Chain::kPiece) run(chain.pieces, begin);
  if (begin < chain.elements) run(chain.ends, begin);
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

template <typename T>
void RunPacked(const Instruction& i, const Places<T>& at, const T* factor) {
  const bool add = i.op == Opcode::kMatMulAdd;
  if (add) CopyAddend(i, at);
  linalg::PackedMatMul(!i.transpose_a, i.rows, i.cols, i.inner, factor, at.b, i.b.ld, at.out, i.out.ld, add);
}

/// The products of several runs with one factor, as one.
template <typename T>
void RunPackedTogether(const Instruction& i, std::span<const Places<T>> runs, const T* factor, T* gathered) {
  const int64_t columns = int64_t{i.cols} * static_cast<int64_t>(runs.size());
  T* const results = gathered + columns * i.inner;
  T* to = gathered;
  for (const Places<T>& at : runs) {
    for (int64_t j = 0; j < i.cols; ++j, to += i.inner) std::copy_n(at.b + j * i.b.ld, i.inner, to);
  }
  linalg::PackedMatMul(!i.transpose_a, i.rows, static_cast<int32_t>(columns), i.inner, factor, gathered, i.inner, results, i.rows, false);
  const T* from = results;
  for (const Places<T>& at : runs) {
    const bool add = i.op == Opcode::kMatMulAdd;
    if (add) CopyAddend(i, at);
    for (int64_t j = 0; j < i.cols; ++j, from += i.rows) {
      T* const out = at.out + j * i.out.ld;
      for (int32_t r = 0; r < i.rows; ++r) out[r] = add ? out[r] + from[r] : from[r];
    }
  }
}

template <typename T>
const T* FactorOf(const Packed<T>* packed, size_t instruction) {
  return packed == nullptr ? nullptr : (*packed)[instruction];
}

template <typename T>
using Memories = absl::InlinedVector<Memory<T>, 8>;

/// One product of every run.
template <typename T>
void RunProducts(const Step<T>& step, size_t k, const Memories<T>& memories, std::span<const Run<T>> runs, T* gathered) {
  absl::InlinedVector<bool, 8> done(runs.size(), false);
  for (size_t first = 0; first < runs.size(); ++first) {
    if (done[first]) continue;
    const T* const factor = FactorOf(runs[first].packed, k);
    if (factor == nullptr) {
      step.run(*step.instruction, memories[first].PlacesOf(step));
      continue;
    }
    absl::InlinedVector<Places<T>, 8> sharing;
    for (size_t run = first; run < runs.size(); ++run) {
      if (FactorOf(runs[run].packed, k) != factor) continue;
      sharing.push_back(memories[run].PlacesOf(step));
      done[run] = true;
    }
    if (sharing.size() == 1) {
      RunPacked(*step.instruction, sharing.front(), factor);
    } else {
      RunPackedTogether(*step.instruction, std::span<const Places<T>>(sharing), factor, gathered);
    }
  }
}

template <typename T>
void RunStep(const Executable<T>& executable, const Step<T>& step, const Memory<T>& memory, const Arena<T>& arena) {
  if (step.run != nullptr) return step.run(*step.instruction, memory.PlacesOf(step));
  const size_t loop = static_cast<size_t>(step.instruction->loop);
  RunLoop(executable.program().loops[loop], executable.loop_kernels()[loop], memory, arena.walks());
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
    : program_(std::move(program)), steps_(StepsOf<T>(program_.instructions)), chains_(ChainsOf(program_.instructions)), constants_(program_.constants_size) {
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
Arena<T>::Arena(const std::vector<const Executable<T>*>& users, size_t runs) : size_(0), memory_(0), gathered_(0) {
  int64_t gathered = 0;
  size_t walks = 0;
  for (const Executable<T>* user : users) {
    const Program& program = user->program();
    size_ = std::max(size_, program.arena_size);
    for (const Loop& loop : program.loops) walks = std::max(walks, loop.instructions.size());
    for (const Instruction& i : program.instructions) {
      if (i.op == Opcode::kMatMul || i.op == Opcode::kMatMulAdd) gathered = std::max(gathered, (int64_t{i.inner} + i.rows) * i.cols);
    }
  }
  constexpr int64_t kAligned = kArenaAlignment / static_cast<int64_t>(sizeof(T));
  size_ = (size_ + kAligned - 1) / kAligned * kAligned;
  memory_ = AlignedBuffer<T>(size_ * static_cast<int64_t>(runs));
  if (runs > 1) gathered_ = AlignedBuffer<T>(gathered * static_cast<int64_t>(runs));
  walks_.resize(walks);
}

template <typename T>
void Evaluate(const Executable<T>& executable, const Slots<T>& slots, const Arena<T>& arena, const Packed<T>* packed) {
  const Memory<T> memory(arena.data(), executable.constants(), slots);
  if (packed == nullptr) {
    const Step<T>* const steps = executable.steps().data();
    size_t next = 0;
    for (const Chain& chain : executable.chains()) {
      for (; next < chain.first; ++next) RunStep(executable, steps[next], memory, arena);
      RunChain(chain, steps + next, memory);
      next += chain.length;
    }
    for (; next < executable.steps().size(); ++next) RunStep(executable, steps[next], memory, arena);
    return;
  }
  const T* const* factor = packed->data();
  for (const Step<T>& step : executable.steps()) {
    if (*factor != nullptr) {
      RunPacked(*step.instruction, memory.PlacesOf(step), *factor);
    } else {
      RunStep(executable, step, memory, arena);
    }
    ++factor;
  }
}

template <typename T>
void EvaluateTogether(const Executable<T>& executable, std::span<const Run<T>> runs, const Arena<T>& arena) {
  if (runs.size() == 1) return Evaluate(executable, runs[0].slots, arena, runs[0].packed);
  Memories<T> memories;
  for (size_t run = 0; run < runs.size(); ++run) memories.emplace_back(arena.data(run), executable.constants(), runs[run].slots);
  for (size_t k = 0; k < executable.steps().size(); ++k) {
    const Step<T>& step = executable.steps()[k];
    const Opcode op = step.instruction->op;
    if (op == Opcode::kMatMul || op == Opcode::kMatMulAdd) {
      RunProducts(step, k, memories, runs, arena.gathered());
    } else {
      for (const Memory<T>& memory : memories) RunStep(executable, step, memory, arena);
    }
  }
}

template class AlignedBuffer<float>;
template class AlignedBuffer<double>;
template class Executable<float>;
template class Executable<double>;
template class Arena<float>;
template class Arena<double>;
template void Evaluate(const Executable<float>&, const Slots<float>&, const Arena<float>&, const Packed<float>*);
template void Evaluate(const Executable<double>&, const Slots<double>&, const Arena<double>&, const Packed<double>*);
template void EvaluateTogether(const Executable<float>&, std::span<const Run<float>>, const Arena<float>&);
template void EvaluateTogether(const Executable<double>&, std::span<const Run<double>>, const Arena<double>&);

}  // namespace metaekf::autodiff
