#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/options.h"

namespace metaekf::server {

/// A running server: all services on one address, over one data directory.
class Server {
 public:
  /// Errors: InvalidArgument for an address that is none, or beyond loopback without
  /// options.insecure; FailedPrecondition if the address is in use or the data directory is locked
  /// or cannot be written; those of store::Store::Open.
  static absl::StatusOr<std::unique_ptr<Server>> Start(const ServerOptions& options);
  /// Drains, with the timeout of the options.
  ~Server();

  int port() const;
  /// HOST:PORT that it listens on.
  std::string address() const;
  /// Of options.metrics_listen; 0 if there is none.
  int metrics_port() const;

  /// Stops: health says NOT_SERVING, streams end with UNAVAILABLE, training workers write a
  /// checkpoint and their jobs are given back, calls may finish until the timeout and are cancelled
  /// then. Returns when nothing runs any more; a second call does nothing.
  void Drain(absl::Duration timeout);

 private:
  class Parts;
  explicit Server(std::unique_ptr<Parts> parts);

  std::unique_ptr<Parts> parts_;
};

}  // namespace metaekf::server
