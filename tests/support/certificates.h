#pragma once

#include <memory>
#include <string>

namespace metaekf::testing {

/// A certificate and its key, PEM.
struct Certificate {
  std::string certificate, key;
};

/// An authority that signs certificates for tests.
class Authority {
 public:
  explicit Authority(const std::string& name);
  ~Authority();

  /// The authority's own certificate.
  const std::string& certificate() const { return certificate_; }

  /// @param alternative_names  as OpenSSL writes them ("DNS:localhost,IP:127.0.0.1"); empty: none.
  /// @param valid_s  seconds from now on that it is valid; negative: it has expired.
  Certificate Sign(const std::string& common_name, const std::string& alternative_names = "", long valid_s = 3600);

 private:
  struct Parts;
  std::unique_ptr<Parts> parts_;
  std::string certificate_;
};

}  // namespace metaekf::testing
