#include "server/status/text.h"

#include <cctype>

namespace metaekf::server {
namespace {

/// Bytes of the UTF-8 character at the start of `text`; 0 if there is none.
size_t Utf8Length(std::string_view text) {
  const auto lead = static_cast<unsigned char>(text[0]);
  if (lead < 0x80) return 1;
  const size_t length = lead >= 0xF0 ? 4 : lead >= 0xE0 ? 3 : lead >= 0xC0 ? 2 : 0;
  if (length == 0 || text.size() < length) return 0;
  uint32_t code_point = lead & (0xFF >> (length + 1));
  for (size_t i = 1; i < length; ++i) {
    const auto byte = static_cast<unsigned char>(text[i]);
    if ((byte & 0xC0) != 0x80) return 0;
    code_point = code_point << 6 | (byte & 0x3F);
  }
  constexpr uint32_t kSmallest[] = {0, 0, 0x80, 0x800, 0x10000};
  const bool surrogate = code_point >= 0xD800 && code_point <= 0xDFFF;
  return code_point < kSmallest[length] || code_point > 0x10FFFF || surrogate ? 0 : length;
}

bool SeparatesWords(char c) {
  return std::isspace(static_cast<unsigned char>(c)) != 0 ||
         std::string_view("'\"`()[]{}<>,;:=").find(c) != std::string_view::npos;
}

std::string HidePaths(std::string_view text) {
  std::string result;
  for (size_t i = 0; i < text.size();) {
    const bool word_starts = i == 0 || SeparatesWords(text[i - 1]);
    const bool path = word_starts && text[i] == '/' && i + 1 < text.size() && text[i + 1] != '/' &&
                      !SeparatesWords(text[i + 1]);
    if (!path) {
      result += text[i++];
      continue;
    }
    result += "[path]";
    while (i < text.size() && !SeparatesWords(text[i])) ++i;
  }
  return result;
}

}  // namespace

std::string TextForClients(std::string_view text, size_t max_bytes) {
  const std::string hidden = HidePaths(text);
  std::string result;
  for (size_t i = 0; i < hidden.size();) {
    const size_t length = Utf8Length(std::string_view(hidden).substr(i));
    const size_t added = length == 0 ? 1 : length;
    if (result.size() + added > max_bytes) break;
    if (length == 0) {
      result += '?';
    } else {
      result.append(hidden, i, length);
    }
    i += added;
  }
  return result;
}

}  // namespace metaekf::server
