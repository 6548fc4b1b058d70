#pragma once

#include <mutex>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"

namespace metaekf::server {

/// Where a server's certificate stands, PEM.
struct TlsPaths {
  std::string certificate;
  std::string key;
  std::string client_ca;  ///< empty: clients show no certificate
};

/// What stands there, fit to be used together.
struct TlsFiles {
  std::string certificate, key, client_ca;

  friend bool operator==(const TlsFiles&, const TlsFiles&) = default;
};

/// Errors, all naming the file: NotFound, FailedPrecondition if it cannot be read; InvalidArgument for one that holds no
/// certificate or key, a certificate that has expired at `now`, and a key of another certificate.
absl::StatusOr<TlsFiles> ReadTlsFiles(const TlsPaths& paths, absl::Time now);

/// Follows files that are replaced one after the other while they are used. Safe to call concurrently.
class TlsFileWatch {
 public:
  /// @param read  what the files hold now.
  TlsFileWatch(TlsPaths paths, TlsFiles read) : paths_(std::move(paths)), current_(std::move(read)) {}

  /// What to use from now on, if that has changed; what is not fit to be used is logged, once, and changes nothing.
  std::optional<TlsFiles> Changed(absl::Time now);

  TlsFiles current() const;

 private:
  const TlsPaths paths_;
  mutable std::mutex mutex_;
  TlsFiles current_;
  std::string problem_;  // as last logged
};

}  // namespace metaekf::server
