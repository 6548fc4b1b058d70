#include "server/access/tls_files.h"

#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/x509.h>
#include <spdlog/spdlog.h>

#include <ctime>
#include <memory>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/store/files.h"

namespace metaekf::server {
namespace {

struct Free {
  void operator()(BIO* bio) const { BIO_free(bio); }
  void operator()(X509* certificate) const { X509_free(certificate); }
  void operator()(EVP_PKEY* key) const { EVP_PKEY_free(key); }
};
template <class T>
using Owned = std::unique_ptr<T, Free>;

Owned<BIO> Reader(const std::string& text) {
  return Owned<BIO>(BIO_new_mem_buf(text.data(), static_cast<int>(text.size())));
}

/// Instead of a question at the terminal.
int NoPassphrase(char*, int, int, void*) { return -1; }

/// The first certificate of a chain.
absl::StatusOr<Owned<X509>> FirstCertificate(const std::string& path, const std::string& text) {
  Owned<X509> certificate(PEM_read_bio_X509(Reader(text).get(), nullptr, NoPassphrase, nullptr));
  ERR_clear_error();
  if (certificate == nullptr) {
    return absl::InvalidArgumentError(absl::StrCat(path, " holds no certificate in PEM form"));
  }
  return certificate;
}

absl::Status CheckNotExpired(const std::string& path, const X509& certificate, absl::Time now) {
  std::tm end{};
  if (ASN1_TIME_to_tm(X509_get0_notAfter(&certificate), &end) != 1) {
    return absl::InvalidArgumentError(absl::StrCat(path, ": the end of its validity cannot be read"));
  }
  const absl::Time expiry = absl::FromTM(end, absl::UTCTimeZone());
  if (now < expiry) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(
      path, ": the certificate expired at ", absl::FormatTime(expiry, absl::UTCTimeZone())));
}

absl::Status CheckFit(const TlsPaths& paths, const TlsFiles& files, absl::Time now) {
  METAEKF_ASSIGN_OR_RETURN(const Owned<X509> certificate,
                           FirstCertificate(paths.certificate, files.certificate));
  METAEKF_RETURN_IF_ERROR(CheckNotExpired(paths.certificate, *certificate, now));
  const Owned<EVP_PKEY> key(
      PEM_read_bio_PrivateKey(Reader(files.key).get(), nullptr, NoPassphrase, nullptr));
  const bool fits = key != nullptr && X509_check_private_key(certificate.get(), key.get()) == 1;
  ERR_clear_error();
  if (key == nullptr) {
    return absl::InvalidArgumentError(
        absl::StrCat(paths.key, " holds no private key in PEM form without a passphrase"));
  }
  if (!fits) {
    return absl::InvalidArgumentError(
        absl::StrCat(paths.key, " is not the key of the certificate in ", paths.certificate));
  }
  if (paths.client_ca.empty()) return absl::OkStatus();
  return FirstCertificate(paths.client_ca, files.client_ca).status();
}

absl::StatusOr<std::string> ReadNamed(const std::string& path) {
  absl::StatusOr<std::string> text = store::ReadFile(path);
  METAEKF_RETURN_IF_ERROR(base::Annotate(text.status(), path));
  return text;
}

}  // namespace

absl::StatusOr<TlsFiles> ReadTlsFiles(const TlsPaths& paths, absl::Time now) {
  TlsFiles files;
  METAEKF_ASSIGN_OR_RETURN(files.certificate, ReadNamed(paths.certificate));
  METAEKF_ASSIGN_OR_RETURN(files.key, ReadNamed(paths.key));
  if (!paths.client_ca.empty()) {
    METAEKF_ASSIGN_OR_RETURN(files.client_ca, ReadNamed(paths.client_ca));
  }
  METAEKF_RETURN_IF_ERROR(CheckFit(paths, files, now));
  return files;
}

std::optional<TlsFiles> TlsFileWatch::Changed(absl::Time now) {
  absl::StatusOr<TlsFiles> read = ReadTlsFiles(paths_, now);
  std::lock_guard lock(mutex_);
  if (!read.ok()) {
    const std::string problem(read.status().message());
    if (problem != problem_) {
      spdlog::warn("certificates are not replaced, those before stay in use: {}", problem);
    }
    problem_ = problem;
    return std::nullopt;
  }
  problem_.clear();
  if (*read == current_) return std::nullopt;
  spdlog::info("new certificates from {}", paths_.certificate);
  current_ = *std::move(read);
  return current_;
}

TlsFiles TlsFileWatch::current() const {
  std::lock_guard lock(mutex_);
  return current_;
}

}  // namespace metaekf::server
