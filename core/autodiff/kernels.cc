// The kernels that need no vectors of their own, and which instruction has which.

#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/autodiff/kernel.h"
#include "core/linalg/products.h"

namespace metaekf::autodiff {
namespace {

/// @param from  where `operand` lies.
template <typename T>
void CopyOperand(const Instruction& i, const Operand& operand, const T* from, T* out) {
  if (operand.tile_width == 0) {
    if (out != from) std::memcpy(out, from, sizeof(T) * static_cast<size_t>(int64_t{i.rows} * i.cols));
  } else {
    ForEachTile(i, operand, [&](int64_t to, int64_t source, int64_t size) {
      std::memcpy(out + to, from + source, sizeof(T) * static_cast<size_t>(size));
    });
  }
}

template <typename T>
void Copy(const Instruction& i, const Places<T>& at) {
  CopyOperand(i, i.a, at.a, at.out);
}

template <typename T>
void Fill(const Instruction& i, const Places<T>& at) {
  std::fill_n(at.out, int64_t{i.rows} * i.cols, T(i.scalar));
}

template <bool accumulate, typename T>
void Product(const Instruction& i, const Places<T>& at) {
  if (accumulate) CopyOperand(i, i.c, at.c, at.out);
  linalg::MatMul(i.transpose_a, i.transpose_b, i.rows, i.cols, i.inner, at.a, i.a.ld, at.b, i.b.ld,
                 at.out, i.out.ld, accumulate);
}

/// Sums in blocks, so that long sums in float keep their digits.
template <typename T>
void Dot(const Instruction& i, const Places<T>& at) {
  const T* a = at.a;
  const T* b = at.b;
  const int64_t size = int64_t{i.rows} * i.cols;
  double sum = 0;
  for (int64_t begin = 0; begin < size; begin += 64) {
    const int64_t end = std::min(size, begin + 64);
    T partial = 0;
    for (int64_t k = begin; k < end; ++k) partial += a[k] * b[k];
    sum += static_cast<double>(partial);
  }
  *at.out = static_cast<T>(sum);
}

/// Less the largest of a column, so that nothing overflows.
template <typename T>
void Softmax(const Instruction& i, const Places<T>& at) {
  for (int32_t col = 0; col < i.cols; ++col) {
    const T* a = at.a + int64_t{col} * i.a.ld;
    T* out = at.out + int64_t{col} * i.out.ld;
    const T largest = *std::max_element(a, a + i.rows);
    T sum = 0;
    for (int32_t k = 0; k < i.rows; ++k) sum += out[k] = std::exp(a[k] - largest);
    for (int32_t k = 0; k < i.rows; ++k) out[k] /= sum;
  }
}

/// The sum of `count` stretches of `size` elements. Short ones are summed side by side, a whole number of them in a wide one: one after
/// the other, each sum would wait for the last.
template <typename T>
void SumStretches(const T* a, int64_t size, int64_t count, T* sum) {
  constexpr int64_t kWide = 64;
  T wide[kWide];
  const int64_t beside = std::min(kWide / size, count);
  if (beside >= 2) {
    const int64_t width = beside * size, rows = count / beside;
    std::copy_n(a, width, wide);
    const T* row = a + width;
    for (int64_t r = 1; r < rows; ++r, row += width) {
      for (int64_t k = 0; k < width; ++k) wide[k] += row[k];
    }
    std::copy_n(wide, size, sum);
    for (int64_t stretch = 1; stretch < beside; ++stretch) {
      for (int64_t k = 0; k < size; ++k) sum[k] += wide[stretch * size + k];
    }
    a = row;
    count -= rows * beside;
  } else {
    std::copy_n(a, size, sum);
    a += size;
    --count;
  }
  for (; count > 0; --count, a += size) {
    for (int64_t k = 0; k < size; ++k) sum[k] += a[k];
  }
}

template <typename T>
void SumTiles(const Instruction& i, const Places<T>& at) {
  T* out = at.out;
  const T* a = at.a;
  const int64_t size = int64_t{i.rows} * i.width;
  const int64_t blocks = i.cols / (int64_t{i.width} * i.count);
  for (int64_t block = 0; block < blocks; ++block) SumStretches(a + block * size * i.count, size, i.count, out + block * size);
}

template <typename T>
void CopyRows(const Instruction& i, const Places<T>& at) {
  T* out = at.out + i.first;
  const T* a = at.a;
  for (int32_t col = 0; col < i.cols; ++col) std::copy_n(a + int64_t{col} * i.a.ld, i.rows, out + int64_t{col} * i.out.ld);
}

template <typename T>
void SliceRows(const Instruction& i, const Places<T>& at) {
  T* out = at.out;
  const T* a = at.a + i.first;
  for (int32_t col = 0; col < i.cols; ++col) std::copy_n(a + int64_t{col} * i.a.ld, i.rows, out + int64_t{col} * i.out.ld);
}

}  // namespace

template <typename T>
void CopyAddend(const Instruction& i, const Places<T>& at) {
  CopyOperand(i, i.c, at.c, at.out);
}
template void CopyAddend(const Instruction&, const Places<float>&);
template void CopyAddend(const Instruction&, const Places<double>&);

template <typename T>
Kernel<T> SelectKernel(const Instruction& i) {
  if (const Kernel<T> kernel = SelectVectorKernel<T>(i)) return kernel;
  switch (i.op) {
    case Opcode::kCopy:
      return Copy<T>;
    case Opcode::kFill:
      return Fill<T>;
    case Opcode::kMatMul:
      return Product<false, T>;
    case Opcode::kMatMulAdd:
      return Product<true, T>;
    case Opcode::kDot:
      return Dot<T>;
    case Opcode::kActivation:
      return SelectActivationKernel<T>(i.activation, i.order);
    case Opcode::kSoftmax:
      return Softmax<T>;
    case Opcode::kSumTiles:
      return SumTiles<T>;
    case Opcode::kCopyRows:
      return CopyRows<T>;
    case Opcode::kSliceRows:
      return SliceRows<T>;
    case Opcode::kAdd:  // these have vector kernels
    case Opcode::kSub:
    case Opcode::kMul:
    case Opcode::kScale:
    case Opcode::kScaleBy:
    case Opcode::kLoop:  // runs its instructions' kernels
      break;
  }
  return nullptr;
}

template Kernel<float> SelectKernel(const Instruction&);
template Kernel<double> SelectKernel(const Instruction&);

}  // namespace metaekf::autodiff
