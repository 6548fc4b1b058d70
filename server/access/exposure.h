#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "server/options.h"

namespace metaekf::server {

/// HOST:PORT taken apart; HOST may be an IPv6 address in brackets.
struct Address {
  std::string host;
  int port = 0;
};

/// Where a server with these options listens, if it may: on loopback always; elsewhere with mutual TLS, with TLS and
/// tokens behind named proxies, or with options.insecure.
/// Errors: InvalidArgument for an address that is none, settings that do not go together, and a server that strangers
/// could use.
absl::StatusOr<Address> CheckExposure(const ServerOptions& options);

/// An IPv4 or IPv6 address in its one shortest form; empty for what is none.
std::string CanonicalAddress(const std::string& address);

/// The address of an IPv4 or IPv6 peer as gRPC writes it ("ipv4:10.0.0.5:4711", "ipv6:%5B::1%5D:80"), without its port;
/// empty for others.
std::string PeerHost(const std::string& peer);

}  // namespace metaekf::server
