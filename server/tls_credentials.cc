#include "server/tls_credentials.h"

#include <grpc/grpc.h>
#include <grpc/grpc_security.h>

#include <chrono>
#include <mutex>
#include <string>
#include <utility>

#include "absl/time/clock.h"
#include "core/base/status.h"

namespace metaekf::server {
namespace {

using std::chrono::steady_clock;

constexpr std::chrono::seconds kLookPeriod(1);

grpc_ssl_server_certificate_config* ToConfig(const TlsFiles& files) {
  const grpc_ssl_pem_key_cert_pair pair{files.key.c_str(), files.certificate.c_str()};
  // gRPC wants authorities at each replacement, also where it asks no client for a certificate.
  const std::string& authorities = files.client_ca.empty() ? files.certificate : files.client_ca;
  return grpc_ssl_server_certificate_config_create(authorities.c_str(), &pair, 1);
}

/// Brings to C++ what gRPC 1.51 has in C alone: to ask for certificates at each handshake. Its own watcher of files
/// (FileWatcherCertificateProvider) takes a key for that of a certificate which it is not, between the replacements of the two.
class WatchedCredentials final : public grpc::ServerCredentials {
 public:
  WatchedCredentials(const TlsPaths& paths, TlsFiles files)
      : mutual_(!paths.client_ca.empty()), watch_(paths, std::move(files)) {}

  void SetAuthMetadataProcessor(const std::shared_ptr<grpc::AuthMetadataProcessor>&) override {}

 private:
  int AddPortToServer(const std::string& address, grpc_server* server) override {
    grpc_ssl_server_credentials_options* options =
        grpc_ssl_server_credentials_create_options_using_config_fetcher(
            mutual_ ? GRPC_SSL_REQUEST_AND_REQUIRE_CLIENT_CERTIFICATE_AND_VERIFY
                    : GRPC_SSL_DONT_REQUEST_CLIENT_CERTIFICATE,
            [](void* self, grpc_ssl_server_certificate_config** config) {
              return static_cast<WatchedCredentials*>(self)->Fetch(config);
            },
            this);
    grpc_server_credentials* credentials = grpc_ssl_server_credentials_create_with_options(options);
    const int port = grpc_server_add_http2_port(server, address.c_str(), credentials);
    grpc_server_credentials_release(credentials);
    return port;
  }

  /// At the server's start and at each handshake.
  grpc_ssl_certificate_config_reload_status Fetch(grpc_ssl_server_certificate_config** config) {
    std::lock_guard lock(mutex_);
    if (!fetched_) {
      fetched_ = true;
      *config = ToConfig(watch_.current());
      return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_NEW;
    }
    const auto now = steady_clock::now();
    if (now - looked_ < kLookPeriod) return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_UNCHANGED;
    looked_ = now;
    const std::optional<TlsFiles> changed = watch_.Changed(absl::Now());
    if (!changed) return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_UNCHANGED;
    *config = ToConfig(*changed);
    return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_NEW;
  }

  const bool mutual_;
  std::mutex mutex_;
  TlsFileWatch watch_;
  bool fetched_ = false;
  steady_clock::time_point looked_;
};

}  // namespace

absl::StatusOr<std::shared_ptr<grpc::ServerCredentials>> TlsCredentials(const TlsPaths& paths) {
  METAEKF_ASSIGN_OR_RETURN(TlsFiles files, ReadTlsFiles(paths, absl::Now()));
  return std::make_shared<WatchedCredentials>(paths, std::move(files));
}

}  // namespace metaekf::server
