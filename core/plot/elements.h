#pragma once

#include <string>

#include "core/plot/svg.h"

namespace metaekf::plot {

/// The head of a document, white, with the font that all texts have; "</svg>" ends it.
std::string BeginDocument(double width, double height);

/// A coordinate with a tenth of a pixel, as short as it goes.
std::string Number(double value);

/// Appends a text, escaped, with its base line at y. `attributes` is empty or begins with a blank.
void Text(double x, double y, const std::string& text, const std::string& attributes,
          std::string& svg);
/// A text that reads upwards, with its middle at `middle`.
void UprightText(double x, double middle, const std::string& text, std::string& svg);

/// Appends a straight line.
void Line(double x1, double y1, double x2, double y2, const char* colour, std::string& svg);

/// The colour as #rrggbb; an automatic one goes by `position`, the number of the series or band.
const char* Hex(Colour colour, size_t position);

/// A scale of colours as #rrggbb, from pale yellow at 0 over orange to dark violet at 1: lightness falls evenly, for readers who see no
/// colours. Shares beyond have the end's.
std::string ScaleColour(double share);

/// About how wide a text is.
double TextWidthPx(const std::string& text);

}  // namespace metaekf::plot
