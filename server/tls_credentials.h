#pragma once

#include <grpcpp/security/server_credentials.h>

#include <memory>

#include "absl/status/statusor.h"
#include "server/access/tls_files.h"

namespace metaekf::server {

/// TLS, mutual where paths.client_ca says so, with certificates that are looked at again for new connections, at most once
/// a second. The server asks them as long as it runs: they outlive it. Errors: those of ReadTlsFiles, for what stands there now.
absl::StatusOr<std::shared_ptr<grpc::ServerCredentials>> TlsCredentials(const TlsPaths& paths);

}  // namespace metaekf::server
