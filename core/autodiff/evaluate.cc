#include "core/autodiff/evaluate.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <new>

#include "core/linalg/products.h"

namespace metaekf::autodiff {
namespace {

constexpr std::align_val_t kAlignment{128};

template <typename T>
class Machine {
 public:
  Machine(const Executable<T>& executable, T* const* slots, T* arena)
      : program_(executable.program()),
        bases_(slots),
        arena_(arena),
        constants_(const_cast<T*>(executable.constants())) {}

  void Run() {
    for (const Instruction& i : program_.instructions) {
      if (i.op != Opcode::kLoop) {
        Execute(i, 0);
        continue;
      }
      const Loop& loop = program_.loops[static_cast<size_t>(i.loop)];
      for (const Instruction& inner : loop.instructions) {
        if (inner.panel >= 0) linalg::MakePanel(inner.transpose_a, inner.rows, inner.inner, At(inner.a, 0), inner.a.ld, arena_ + inner.panel);
      }
      for (int64_t step = 0; step < loop.length; ++step) {
        const int64_t t = loop.reverse ? loop.length - 1 - step : step;
        for (const Instruction& inner : loop.instructions) Execute(inner, t);
      }
    }
  }

 private:
  T* At(const Operand& operand, int64_t t) const {
    T* base = operand.slot >= 0 ? bases_[operand.slot] : operand.slot == Operand::kArena ? arena_ : constants_;
    return base + operand.offset + t * operand.step_stride;
  }

  /// out = function(a, b) elementwise; at most one of the two is tiled.
  template <typename Function>
  void Binary(const Instruction& i, int64_t t, Function function) const {
    T* out = At(i.out, t);
    const T* a = At(i.a, t);
    const T* b = At(i.b, t);
    if (i.a.tile_width == 0 && i.b.tile_width == 0) {
      const int64_t size = int64_t{i.rows} * i.cols;
      for (int64_t k = 0; k < size; ++k) out[k] = function(a[k], b[k]);
    } else if (i.b.tile_width != 0) {
      ForEachTile(i, i.b, [&](int64_t at, int64_t from, int64_t size) {
        for (int64_t k = 0; k < size; ++k) out[at + k] = function(a[at + k], b[from + k]);
      });
    } else {
      ForEachTile(i, i.a, [&](int64_t at, int64_t from, int64_t size) {
        for (int64_t k = 0; k < size; ++k) out[at + k] = function(a[from + k], b[at + k]);
      });
    }
  }

  /// Calls visit(place in the result, place in the tiled operand, elements) for every tile.
  template <typename Visit>
  static void ForEachTile(const Instruction& i, const Operand& tiled, Visit visit) {
    const int64_t size = int64_t{i.rows} * tiled.tile_width;
    const int64_t blocks = i.cols / (int64_t{tiled.tile_width} * tiled.tile_count);
    int64_t at = 0;
    for (int64_t block = 0; block < blocks; ++block) {
      for (int32_t repeat = 0; repeat < tiled.tile_count; ++repeat, at += size) visit(at, block * size, size);
    }
  }

  void Copy(const Instruction& i, const Operand& from, int64_t t) const {
    T* out = At(i.out, t);
    const T* a = At(from, t);
    if (from.tile_width == 0) {
      if (out != a) std::memcpy(out, a, sizeof(T) * static_cast<size_t>(int64_t{i.rows} * i.cols));
    } else {
      ForEachTile(i, from, [&](int64_t at, int64_t source, int64_t size) {
        std::memcpy(out + at, a + source, sizeof(T) * static_cast<size_t>(size));
      });
    }
  }

  void Product(const Instruction& i, int64_t t, bool accumulate) const {
    linalg::MatMul(i.transpose_a, i.transpose_b, i.rows, i.cols, i.inner, At(i.a, t), i.a.ld, At(i.b, t), i.b.ld, At(i.out, t), i.out.ld,
                   accumulate);
  }

  void PanelProduct(const Instruction& i, int64_t t, const T* addend, int32_t ld) const {
    linalg::PanelProduct(i.rows, i.cols, i.inner, arena_ + i.panel, At(i.b, t), i.b.ld, addend, ld, At(i.out, t), i.out.ld);
  }

  void Execute(const Instruction& i, int64_t t) const {
    switch (i.op) {
      case Opcode::kCopy:
        return Copy(i, i.a, t);
      case Opcode::kFill: {
        T* out = At(i.out, t);
        std::fill(out, out + int64_t{i.rows} * i.cols, T(i.scalar));
        return;
      }
      case Opcode::kMatMul:
        return i.panel >= 0 ? PanelProduct(i, t, nullptr, 0) : Product(i, t, false);
      case Opcode::kMatMulAdd:
        if (i.panel >= 0 && i.c.tile_width == 0) return PanelProduct(i, t, At(i.c, t), i.c.ld);
        Copy(i, i.c, t);
        return i.panel >= 0 ? PanelProduct(i, t, At(i.out, t), i.out.ld) : Product(i, t, true);
      case Opcode::kAdd:
        return Binary(i, t, [](T a, T b) { return a + b; });
      case Opcode::kSub:
        return Binary(i, t, [](T a, T b) { return a - b; });
      case Opcode::kMul:
        return Binary(i, t, [](T a, T b) { return a * b; });
      case Opcode::kScale:
        return Scaled(i, T(i.scalar), At(i.a, t), t);
      case Opcode::kScaleBy:
        return Scaled(i, *At(i.a, t), At(i.b, t), t);
      case Opcode::kDot:
        return Dot(i, t);
      case Opcode::kActivation:
        return ApplyActivation(i.activation, i.order, T(i.scalar), At(i.a, t), At(i.out, t),
                               static_cast<size_t>(int64_t{i.rows} * i.cols));
      case Opcode::kSoftmax:
        return Softmax(i, t);
      case Opcode::kSumTiles:
        return SumTiles(i, t);
      case Opcode::kCopyRows: {
        T* out = At(i.out, t) + i.first;
        const T* a = At(i.a, t);
        for (int32_t col = 0; col < i.cols; ++col) {
          std::copy_n(a + int64_t{col} * i.a.ld, i.rows, out + int64_t{col} * i.out.ld);
        }
        return;
      }
      case Opcode::kSliceRows: {
        T* out = At(i.out, t);
        const T* a = At(i.a, t) + i.first;
        for (int32_t col = 0; col < i.cols; ++col) {
          std::copy_n(a + int64_t{col} * i.a.ld, i.rows, out + int64_t{col} * i.out.ld);
        }
        return;
      }
      case Opcode::kLoop:
        return;  // loops do not nest
    }
  }

  void Scaled(const Instruction& i, T factor, const T* a, int64_t t) const {
    T* out = At(i.out, t);
    const int64_t size = int64_t{i.rows} * i.cols;
    for (int64_t k = 0; k < size; ++k) out[k] = factor * a[k];
  }

  /// Sums in blocks, so that long sums in float keep their digits.
  void Dot(const Instruction& i, int64_t t) const {
    const T* a = At(i.a, t);
    const T* b = At(i.b, t);
    const int64_t size = int64_t{i.rows} * i.cols;
    double sum = 0;
    for (int64_t begin = 0; begin < size; begin += 64) {
      const int64_t end = std::min(size, begin + 64);
      T partial = 0;
      for (int64_t k = begin; k < end; ++k) partial += a[k] * b[k];
      sum += static_cast<double>(partial);
    }
    *At(i.out, t) = static_cast<T>(sum);
  }

  /// Less the largest of a column, so that nothing overflows.
  void Softmax(const Instruction& i, int64_t t) const {
    for (int32_t col = 0; col < i.cols; ++col) {
      const T* a = At(i.a, t) + int64_t{col} * i.a.ld;
      T* out = At(i.out, t) + int64_t{col} * i.out.ld;
      const T largest = *std::max_element(a, a + i.rows);
      T sum = 0;
      for (int32_t k = 0; k < i.rows; ++k) sum += out[k] = std::exp(a[k] - largest);
      for (int32_t k = 0; k < i.rows; ++k) out[k] /= sum;
    }
  }

  void SumTiles(const Instruction& i, int64_t t) const {
    T* out = At(i.out, t);
    const T* a = At(i.a, t);
    const int64_t size = int64_t{i.rows} * i.width;
    const int64_t blocks = i.cols / (int64_t{i.width} * i.count);
    for (int64_t block = 0; block < blocks; ++block) {
      T* sum = out + block * size;
      std::copy_n(a, size, sum);
      a += size;
      for (int32_t repeat = 1; repeat < i.count; ++repeat, a += size) {
        for (int64_t k = 0; k < size; ++k) sum[k] += a[k];
      }
    }
  }

  const Program& program_;
  T* const* bases_;
  T* arena_;
  T* constants_;
};

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
Executable<T>::Executable(Program program) : program_(std::move(program)), constants_(program_.constants_size) {
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
              }))->program().arena_size) {}

template <typename T>
void Evaluate(const Executable<T>& executable, const Slots<T>& slots, const Arena<T>& arena) {
  Machine<T>(executable, slots.data(), arena.data()).Run();
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
