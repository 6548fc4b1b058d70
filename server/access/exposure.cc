#include "server/access/exposure.h"

#include <arpa/inet.h>

#include <array>

#include "absl/strings/numbers.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"

namespace metaekf::server {
namespace {

absl::StatusOr<Address> ParseAddress(const std::string& text) {
  const size_t colon = text.rfind(':');
  Address address;
  if (colon == std::string::npos || colon == 0 ||
      !absl::SimpleAtoi(text.substr(colon + 1), &address.port) || address.port < 0 ||
      address.port > 65535) {
    return absl::InvalidArgumentError(
        absl::StrCat("'", text, "' is not an address of the form HOST:PORT"));
  }
  address.host = text.substr(0, colon);
  return address;
}

/// A name such as "127.example" may lead anywhere: only addresses count, and the one name that always means this machine.
bool IsLoopback(const std::string& host) {
  const std::string address = CanonicalAddress(host);
  return host == "localhost" || host == "[::1]" || address.rfind("127.", 0) == 0;
}

absl::Status CheckTogether(const ServerOptions::Security& security) {
  if (security.certificate_file.empty() != security.key_file.empty()) {
    return absl::InvalidArgumentError(
        "security.certificate_file and security.key_file go together: give both or neither");
  }
  const bool encrypted = !security.certificate_file.empty();
  const bool certificates = !security.client_ca_file.empty();
  if (certificates && !encrypted) {
    return absl::InvalidArgumentError(
        "security.client_ca_file asks clients for certificates, which takes "
        "security.certificate_file and security.key_file");
  }
  if (!security.clients.empty() && !certificates) {
    return absl::InvalidArgumentError(
        "security.clients names certificates that nobody checks: give security.client_ca_file");
  }
  if (certificates && security.clients.empty() && !security.require_tokens) {
    return absl::InvalidArgumentError(
        "security.client_ca_file lets clients in of whom nothing says what they may do: list them as "
        "security.clients, or set security.require_tokens");
  }
  for (const std::string& proxy : security.proxies) {
    if (CanonicalAddress(proxy).empty()) {
      return absl::InvalidArgumentError(
          absl::StrCat("security.proxies: '", proxy, "' is no IPv4 or IPv6 address"));
    }
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<Address> CheckExposure(const ServerOptions& options) {
  const ServerOptions::Security& security = options.security;
  METAEKF_RETURN_IF_ERROR(CheckTogether(security));
  METAEKF_ASSIGN_OR_RETURN(Address address, ParseAddress(options.listen));
  const bool mutual = !security.client_ca_file.empty();
  const bool behind_proxy = !security.certificate_file.empty() && security.require_tokens &&
                            !security.proxies.empty();
  if (options.insecure || IsLoopback(address.host) || mutual || behind_proxy) return address;
  return absl::InvalidArgumentError(absl::StrCat(
      "refusing to listen on ", options.listen,
      ": beyond loopback strangers could use the server. Set up mutual TLS (security.client_ca_file in the "
      "configuration), or TLS with tokens behind a proxy (security.require_tokens, security.proxies); or listen on "
      "127.0.0.1; or say --insecure on a network that you trust"));
}

std::string CanonicalAddress(const std::string& address) {
  for (const int family : {AF_INET, AF_INET6}) {
    std::array<unsigned char, sizeof(in6_addr)> bytes{};
    std::array<char, INET6_ADDRSTRLEN> text{};
    if (inet_pton(family, address.c_str(), bytes.data()) == 1) {
      return inet_ntop(family, bytes.data(), text.data(), text.size());
    }
  }
  return "";
}

std::string PeerHost(const std::string& peer) {
  absl::string_view rest = peer;
  if (!absl::ConsumePrefix(&rest, "ipv4:") && !absl::ConsumePrefix(&rest, "ipv6:")) return "";
  rest = rest.substr(0, rest.rfind(':'));
  std::string host = absl::StrReplaceAll(rest, {{"%5B", ""}, {"%5D", ""}, {"[", ""}, {"]", ""}});
  constexpr absl::string_view kMapped = "::ffff:";  // an IPv4 address on an IPv6 socket
  if (absl::StartsWith(host, kMapped) && absl::StrContains(host, '.')) host.erase(0, kMapped.size());
  return CanonicalAddress(host);
}

}  // namespace metaekf::server
