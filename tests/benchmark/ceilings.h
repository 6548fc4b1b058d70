#pragma once

#include <cstdint>

namespace metaekf::benchmark {

/// What one core of this machine can do at best, measured: fused multiply-adds in registers, and reading memory that lies so near.
class Ceilings {
 public:
  static const Ceilings& Measured();

  /// Operations per second in float or double; a fused multiply-add is two.
  template <typename T>
  double operations() const {
    return sizeof(T) == 4 ? float_operations_ : double_operations_;
  }
  /// Bytes per second of a working set of this size.
  double bandwidth(int64_t working_set) const;
  /// The least time that so many operations on so many bytes take: the roofline (Williams et al., 2009).
  template <typename T>
  double Seconds(double operations_done, double bytes) const {
    const double computing = operations_done / operations<T>(), reading = bytes / bandwidth(static_cast<int64_t>(bytes));
    return computing > reading ? computing : reading;
  }

 private:
  Ceilings();

  static constexpr int kLevels = 3;
  struct Level {
    int64_t bytes;
    double bandwidth;
  };
  double float_operations_, double_operations_;
  Level levels_[kLevels];
};

}  // namespace metaekf::benchmark
