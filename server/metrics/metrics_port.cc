#include "server/metrics/metrics_port.h"

#include <prometheus/exposer.h>

#include <exception>

#include "absl/strings/str_cat.h"

namespace metaekf::server {

class MetricsPort::Parts {
 public:
  Parts(const std::string& address, std::shared_ptr<Metrics> shown)
      : metrics(std::move(shown)),
        // A client that is slow or says nothing holds one of two threads, for five seconds at most.
        exposer({"listening_ports", address, "num_threads", "2", "request_timeout_ms", "5000"}) {
    exposer.RegisterCollectable(metrics);
  }

  const std::shared_ptr<Metrics> metrics;
  prometheus::Exposer exposer;
};

absl::StatusOr<std::unique_ptr<MetricsPort>> MetricsPort::Open(const std::string& address,
                                                               std::shared_ptr<Metrics> metrics) {
  // The library tells by an exception; none gets further than this.
  try {
    return std::unique_ptr<MetricsPort>(new MetricsPort(std::make_unique<Parts>(address, std::move(metrics))));
  } catch (const std::exception&) {
    return absl::FailedPreconditionError(absl::StrCat(
        "cannot serve metrics on ", address, ": it is in use or no address; choose another as metrics_listen"));
  }
}

MetricsPort::MetricsPort(std::unique_ptr<Parts> parts) : parts_(std::move(parts)) {}
MetricsPort::~MetricsPort() = default;

int MetricsPort::port() const { return parts_->exposer.GetListeningPorts().front(); }

}  // namespace metaekf::server
