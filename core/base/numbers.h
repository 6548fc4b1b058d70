#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace metaekf::base {

/// The shortest decimal text that reads back as exactly `value`; "nan", "inf", "-inf" otherwise.
std::string FormatExact(double value);

/// `value` with `digits` significant digits, for people.
std::string FormatShort(double value, int digits = 4);

/// The number that the whole of `text` spells, surrounding blanks aside; nothing if it spells none.
/// Independent of the locale. "nan", "NaN" and "inf" are numbers.
std::optional<double> ParseDouble(std::string_view text);

/// The value below which a share of `sorted`, which ascends and is not empty, lies: linear between two of them; at an
/// infinite one, that one.
double Quantile(const std::vector<double>& sorted, double share);

}  // namespace metaekf::base
