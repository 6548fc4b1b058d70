#pragma once

#include <memory>
#include <string>
#include <string_view>

struct evp_md_ctx_st;

namespace metaekf::store {

/// SHA-256 of bytes that come in pieces.
class Sha256 {
 public:
  Sha256();

  void Update(std::string_view bytes);
  /// 64 lower-case hexadecimal digits. Call it once, last.
  std::string HexDigest();

 private:
  struct Free {
    void operator()(evp_md_ctx_st* context) const;
  };
  std::unique_ptr<evp_md_ctx_st, Free> context_;
};

std::string Sha256Hex(std::string_view bytes);

}  // namespace metaekf::store
