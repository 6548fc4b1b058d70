#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/metrics/metrics.h"

namespace metaekf::server {

/// Serves metrics to Prometheus: http://ADDRESS/metrics, to whoever asks. With threads of its own, so that neither waits
/// for the other.
class MetricsPort {
 public:
  /// @param address  HOST:PORT; port 0 picks one. Errors: FailedPrecondition if it is taken or none.
  static absl::StatusOr<std::unique_ptr<MetricsPort>> Open(const std::string& address,
                                                           std::shared_ptr<Metrics> metrics);
  ~MetricsPort();

  int port() const;

 private:
  class Parts;
  explicit MetricsPort(std::unique_ptr<Parts> parts);
  std::unique_ptr<Parts> parts_;
};

}  // namespace metaekf::server
