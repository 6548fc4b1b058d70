#include "core/plot/elements.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>

#include "absl/strings/str_cat.h"

namespace metaekf::plot {
namespace {

std::string Escaped(const std::string& text) {
  std::string escaped;
  for (const char c : text) {
    switch (c) {
      case '&':
        escaped += "&amp;";
        break;
      case '<':
        escaped += "&lt;";
        break;
      case '>':
        escaped += "&gt;";
        break;
      case '"':
        escaped += "&quot;";
        break;
      default:
        escaped += static_cast<unsigned char>(c) < 0x20 ? ' ' : c;  // illegal in XML
    }
  }
  return escaped;
}

}  // namespace

std::string Number(double value) {
  char text[48];
  std::snprintf(text, sizeof(text), "%.1f", value);
  std::string number = text;
  if (number.ends_with(".0")) number.resize(number.size() - 2);
  return number == "-0" ? "0" : number;
}

void Text(double x, double y, const std::string& text, const std::string& attributes,
          std::string& svg) {
  absl::StrAppend(&svg, "<text x=\"", Number(x), "\" y=\"", Number(y), "\"", attributes, ">",
                  Escaped(text), "</text>\n");
}

void UprightText(double x, double middle, const std::string& text, std::string& svg) {
  Text(x, middle, text, absl::StrCat(" text-anchor=\"middle\" transform=\"rotate(-90 ", Number(x), " ", Number(middle), ")\""), svg);
}

std::string BeginDocument(double width, double height) {
  return absl::StrCat("<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"", Number(width), "\" height=\"", Number(height),
                      "\" viewBox=\"0 0 ", Number(width), " ", Number(height),
                      "\" font-family=\"DejaVu Sans, Helvetica, Arial, sans-serif\" font-size=\"12\">\n"
                      "<style>text{fill:#222222}.curve{stroke-width:1.5}</style>\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n");
}

void Line(double x1, double y1, double x2, double y2, const char* colour, std::string& svg) {
  absl::StrAppend(&svg, "<path d=\"M", Number(x1), " ", Number(y1), "L", Number(x2), " ",
                  Number(y2), "\" stroke=\"", colour, "\"/>\n");
}

const char* Hex(Colour colour, size_t position) {
  static constexpr std::array<const char*, 7> kPalette = {
      "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#222222"};
  if (colour == Colour::kAutomatic) return kPalette[position % 6];
  return kPalette[static_cast<size_t>(colour) - 1];
}

std::string ScaleColour(double share) {
  static constexpr std::array<std::array<double, 3>, 4> kStops = {
      {{255, 246, 204}, {245, 173, 92}, {196, 66, 94}, {58, 15, 92}}};
  const double place = std::clamp(share, 0.0, 1.0) * (kStops.size() - 1);
  const size_t below = std::min(static_cast<size_t>(place), kStops.size() - 2);
  const double weight = place - static_cast<double>(below);
  std::array<int, 3> rgb{};
  for (size_t i = 0; i < 3; ++i) {
    rgb[i] = static_cast<int>(std::lround(kStops[below][i] + weight * (kStops[below + 1][i] - kStops[below][i])));
  }
  char text[8];
  std::snprintf(text, sizeof(text), "#%02x%02x%02x", static_cast<unsigned>(rgb[0]), static_cast<unsigned>(rgb[1]),
                static_cast<unsigned>(rgb[2]));
  return text;
}

double TextWidthPx(const std::string& text) {
  // Characters, those of several bytes counted once.
  const auto begins = [](char c) { return (static_cast<unsigned char>(c) & 0xC0) != 0x80; };
  return 6.6 * static_cast<double>(std::count_if(text.begin(), text.end(), begins));
}

}  // namespace metaekf::plot
