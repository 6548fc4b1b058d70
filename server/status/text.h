#pragma once

#include <cstddef>
#include <string>
#include <string_view>

namespace metaekf::server {

/// `text` made fit to leave the server: words that are absolute paths read "[path]", bytes that are
/// not UTF-8 (they would make a protobuf unreadable) read "?", and what is over `max_bytes`
/// is cut off.
std::string TextForClients(std::string_view text, size_t max_bytes);

}  // namespace metaekf::server
