#pragma once

#include <cstdint>
#include <vector>

#include "core/autodiff/graph.h"

namespace metaekf::autodiff {

/// Where an instruction finds a matrix: column-major, `ld` elements from one column to the next.
struct Operand {
  int32_t slot = kArena;       ///< a slot of the caller's, kArena or kConstants
  int64_t offset = 0;          ///< elements from the start of the slot, arena or constants
  int64_t step_stride = 0;     ///< in a loop: elements from one step to the next
  int32_t ld = 0;
  int32_t tile_width = 0;      ///< 0: as it lies; else each block of tile_width columns is read tile_count times
  int32_t tile_count = 1;

  static constexpr int32_t kArena = -1;
  static constexpr int32_t kConstants = -2;
};

enum class Opcode : uint8_t {
  kCopy,       // out = a, a possibly tiled
  kFill,       // out = scalar
  kMatMul,     // out = op(a) op(b)
  kMatMulAdd,  // out = c + op(a) op(b), c possibly tiled
  kAdd,        // one operand possibly tiled, here and in the next two
  kSub,
  kMul,
  kScale,
  kScaleBy,
  kDot,
  kActivation,
  kSoftmax,
  kSumTiles,
  kCopyRows,   // out's rows first … = a
  kSliceRows,  // out = a's rows first …
  kLoop,       // runs Program::loops[index]
};

struct Instruction {
  Opcode op{};
  int32_t rows = 0, cols = 0;  ///< of out; of a for kSumTiles, kDot and kCopyRows
  int32_t inner = 0;           ///< of a matrix product
  bool transpose_a = false, transpose_b = false;
  Activation activation{};
  int32_t order = 0;
  int32_t first = 0;
  int32_t width = 0, count = 0;  ///< of summed tiles
  int32_t loop = -1;
  int64_t panel = -1;          ///< of a product in a loop whose `a` stays the same: where in the arena it may be laid out for that
  double scalar = 0;
  Operand out, a, b, c;
};

/// Instructions run for t = 0 … length − 1, or length − 1 … 0 if `reverse`.
struct Loop {
  int32_t length = 0;
  bool reverse = false;
  std::vector<Instruction> instructions;
};

/// What a graph computes, as a flat list: the form that evaluators run, on whatever hardware.
struct Program {
  std::vector<Instruction> instructions;
  std::vector<Loop> loops;
  int64_t arena_size = 0;  ///< elements of scratch that a run needs

  struct ConstantBlock {
    int64_t offset;
    int64_t size;
    double scalar;
    std::shared_ptr<const std::vector<double>> data;  ///< null: `scalar` throughout
  };
  std::vector<ConstantBlock> constants;
  int64_t constants_size = 0;
};

/// A value and the slot it is wanted in. Slots of outputs must not overlap those of inputs.
struct Output {
  Value value;
  int32_t slot;
  int64_t offset = 0;
};

/// Orders what `outputs` need into a program: dead values are dropped, buffers reused once their last reader
/// has run, sums folded into products, slices and tiles read in place where the reader can.
Program Compile(const Graph& graph, const std::vector<Output>& outputs);

}  // namespace metaekf::autodiff
