#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <map>

namespace metaekf::autodiff {

inline constexpr int64_t kAlignment = 16;  // elements: 64 bytes in float, 128 in double

inline int64_t Aligned(int64_t size) { return (size + kAlignment - 1) / kAlignment * kAlignment; }

/// Gives out places in an arena, lowest fit first.
class ArenaAllocator {
 public:
  int64_t Allocate(int64_t size) {
    size = Aligned(std::max<int64_t>(size, 1));
    for (auto it = free_.begin(); it != free_.end(); ++it) {
      if (it->second < size) continue;
      const int64_t offset = it->first;
      const int64_t rest = it->second - size;
      free_.erase(it);
      if (rest > 0) free_[offset + size] = rest;
      return offset;
    }
    const int64_t offset = end_;
    end_ += size;
    return offset;
  }

  void Free(int64_t offset, int64_t size) {
    size = Aligned(std::max<int64_t>(size, 1));
    auto next = free_.lower_bound(offset);
    if (next != free_.begin()) {
      auto previous = std::prev(next);
      if (previous->first + previous->second == offset) {
        offset = previous->first;
        size += previous->second;
        free_.erase(previous);
      }
    }
    next = free_.lower_bound(offset);
    if (next != free_.end() && offset + size == next->first) {
      size += next->second;
      free_.erase(next);
    }
    free_[offset] = size;
  }

  int64_t end() const { return end_; }

 private:
  std::map<int64_t, int64_t> free_;  // offset → size, disjoint and never adjacent
  int64_t end_ = 0;
};

}  // namespace metaekf::autodiff
