#pragma once

#include <cstddef>
#include <type_traits>

namespace metaekf::base {

/// function(count), where a count of at most four is a constant: loops of so few turns, which small filters are made of, are then laid
/// out when this is compiled.
template <typename Function>
decltype(auto) WithCount(std::ptrdiff_t count, Function&& function) {
  switch (count) {
    case 1:
      return function(std::integral_constant<std::ptrdiff_t, 1>());
    case 2:
      return function(std::integral_constant<std::ptrdiff_t, 2>());
    case 3:
      return function(std::integral_constant<std::ptrdiff_t, 3>());
    case 4:
      return function(std::integral_constant<std::ptrdiff_t, 4>());
    default:
      return function(count);
  }
}

}  // namespace metaekf::base
