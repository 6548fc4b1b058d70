#include "client/cli/backup_files.h"

#include <fcntl.h>
#include <openssl/evp.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "absl/strings/escaping.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/time/time.h"
#include "client/cli/console.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

namespace fs = std::filesystem;
using nlohmann::json;

constexpr char kManifest[] = "manifest.json";
constexpr char kDatabase[] = "metaekf.db";
constexpr char kBlobs[] = "blobs/";
constexpr int kFormat = 1;

absl::Status Failed(const std::string& what, const std::string& path) {
  const std::string message = absl::StrCat("cannot ", what, " ", path, ": ", strerror(errno));
  return errno == ENOSPC ? absl::ResourceExhaustedError(message) : absl::FailedPreconditionError(message);
}

/// What a server may ask to be written: nothing outside the backup.
bool IsFileOfBackup(const std::string& path) {
  if (path == kDatabase) return true;
  const std::string digest = path.substr(std::min(path.size(), strlen(kBlobs)));
  return absl::StartsWith(path, kBlobs) && digest.size() == 64 &&
         digest.find_first_not_of("0123456789abcdef") == std::string::npos;
}

class Digest {
 public:
  Digest() : context_(EVP_MD_CTX_new()) { EVP_DigestInit_ex(context_, EVP_sha256(), nullptr); }
  ~Digest() { EVP_MD_CTX_free(context_); }
  Digest(const Digest&) = delete;
  void Update(const std::string& bytes) { EVP_DigestUpdate(context_, bytes.data(), bytes.size()); }
  std::string Hex() {
    std::string bytes(32, '\0');
    EVP_DigestFinal_ex(context_, reinterpret_cast<unsigned char*>(bytes.data()), nullptr);
    return absl::BytesToHexString(bytes);
  }

 private:
  EVP_MD_CTX* context_;
};

absl::Status SyncDirectory(const std::string& path) {
  const int directory = open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (directory < 0) return Failed("open", path);
  const bool synced = fsync(directory) == 0;
  close(directory);
  return synced ? absl::OkStatus() : Failed("bring to disk", path);
}

absl::Status MakePrivateDirectory(const std::string& path) {
  return mkdir(path.c_str(), 0700) == 0 ? absl::OkStatus() : Failed("make", path);
}

}  // namespace

/// A file, its digest, and its way to the disk.
class BackupOutput {
 public:
  static absl::StatusOr<std::unique_ptr<BackupOutput>> Open(const std::string& path) {
    const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (file < 0) return Failed("write", path);
    return std::unique_ptr<BackupOutput>(new BackupOutput(file, path));
  }
  ~BackupOutput() { close(file_); }

  absl::Status Write(const std::string& bytes) {
    digest_.Update(bytes);
    size_bytes_ += bytes.size();
    for (size_t done = 0; done < bytes.size();) {
      const ssize_t n = write(file_, bytes.data() + done, bytes.size() - done);
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) return Failed("write", path_);
      done += static_cast<size_t>(n);
    }
    return absl::OkStatus();
  }
  absl::Status Sync() { return fsync(file_) == 0 ? absl::OkStatus() : Failed("bring to disk", path_); }
  /// Once, last.
  bool Is(const client::BackupFile& file) {
    return size_bytes_ == file.size_bytes && digest_.Hex() == file.sha256;
  }

 private:
  BackupOutput(int file, std::string path) : file_(file), path_(std::move(path)) {}
  const int file_;
  const std::string path_;
  Digest digest_;
  uint64_t size_bytes_ = 0;
};

namespace {

json ToJson(const Manifest& manifest) {
  json files = json::array();
  for (const client::BackupFile& file : manifest.files) {
    files.push_back({{"path", file.path}, {"size_bytes", file.size_bytes}, {"sha256", file.sha256}});
  }
  return {{"format", kFormat},
          {"server_version", manifest.info.server_version},
          {"data_format_version", manifest.info.data_format_version},
          {"create_time", absl::FormatTime(absl::FromChrono(manifest.info.create_time), absl::UTCTimeZone())},
          {"files", files}};
}

absl::StatusOr<Manifest> ReadManifest(const std::string& directory) {
  const std::string path = absl::StrCat(directory, "/", kManifest);
  absl::StatusOr<std::string> text = ReadFile(path);
  if (!text.ok()) return absl::NotFoundError(absl::StrCat(directory, " is no backup: ", text.status().message()));
  const json read = json::parse(*text, nullptr, /*allow_exceptions=*/false);
  const auto wrong = [&](const std::string& what) { return absl::InvalidArgumentError(absl::StrCat(path, ": ", what)); };
  if (!read.is_object() || read.value("format", json()) != kFormat) return wrong("is no manifest of format 1");
  Manifest manifest;
  absl::Time create_time;
  const json time = read.value("create_time", json()), files = read.value("files", json());
  if (!time.is_string() || !absl::ParseTime(absl::RFC3339_full, time.get<std::string>(), &create_time, nullptr)) {
    return wrong("create_time is missing or no time");
  }
  if (!read.value("server_version", json()).is_string() || !read.value("data_format_version", json()).is_number_unsigned()) {
    return wrong("server_version or data_format_version is missing");
  }
  manifest.info.server_version = read["server_version"];
  manifest.info.data_format_version = read["data_format_version"];
  manifest.info.create_time = absl::ToChronoTime(create_time);
  if (!files.is_array() || files.empty()) return wrong("files are missing");
  for (const json& file : files) {
    const bool complete = file.is_object() && file.value("path", json()).is_string() &&
                          file.value("size_bytes", json()).is_number_unsigned() && file.value("sha256", json()).is_string();
    if (!complete || !IsFileOfBackup(file["path"])) return wrong("a file of it is not as it should be");
    manifest.files.push_back({file["path"], file["size_bytes"], file["sha256"]});
    manifest.info.size_bytes += manifest.files.back().size_bytes;
  }
  manifest.info.files = static_cast<uint32_t>(manifest.files.size());
  return manifest;
}

/// Calls `on_bytes` with the pieces of a file; whether they are those of the manifest.
absl::StatusOr<bool> ReadVerified(const std::string& directory, const client::BackupFile& file,
                                  const std::function<absl::Status(const std::string&)>& on_bytes) {
  std::ifstream in(absl::StrCat(directory, "/", file.path), std::ios::binary);
  Digest digest;
  uint64_t size = 0;
  std::string bytes;
  while (in) {
    bytes.resize(size_t{1} << 20);
    in.read(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    bytes.resize(static_cast<size_t>(in.gcount()));
    digest.Update(bytes);
    size += bytes.size();
    METAEKF_RETURN_IF_ERROR(on_bytes(bytes));
  }
  return size == file.size_bytes && digest.Hex() == file.sha256;
}

absl::Status Damaged(const std::string& directory, const std::vector<std::string>& files) {
  return absl::DataLossError(absl::StrCat(directory, ": damaged or gone: ", absl::StrJoin(files, ", ")));
}

client::Status ToClientStatus(const absl::Status& status) {
  return {.code = static_cast<client::Code>(status.code()), .message = std::string(status.message())};
}

}  // namespace

absl::StatusOr<std::unique_ptr<BackupWriter>> BackupWriter::Create(
    const std::string& directory, std::function<void(uint64_t, uint64_t)> on_bytes) {
  if (fs::exists(directory)) {
    return absl::AlreadyExistsError(absl::StrCat(directory, " is there already; a backup is written into a new directory"));
  }
  std::unique_ptr<BackupWriter> writer(new BackupWriter(directory));
  writer->on_bytes_ = std::move(on_bytes);
  std::error_code ignored;
  fs::remove_all(writer->partial_, ignored);
  METAEKF_RETURN_IF_ERROR(MakePrivateDirectory(writer->partial_));
  METAEKF_RETURN_IF_ERROR(MakePrivateDirectory(writer->partial_ + "/blobs"));
  return writer;
}

BackupWriter::BackupWriter(std::string directory)
    : directory_(std::move(directory)), partial_(directory_ + ".partial") {}
BackupWriter::~BackupWriter() = default;

client::Status BackupWriter::Begin(const client::BackupInfo& info) {
  manifest_.info = info;
  return {};
}

client::Status BackupWriter::File(const client::BackupFile& file) {
  if (absl::Status ended = EndFile(); !ended.ok()) return ToClientStatus(ended);
  if (!IsFileOfBackup(file.path)) {
    return ToClientStatus(absl::InternalError(absl::StrCat("the server sent '", absl::CHexEscape(file.path), "', which is no file of a backup")));
  }
  auto output = BackupOutput::Open(absl::StrCat(partial_, "/", file.path));
  if (!output.ok()) return ToClientStatus(output.status());
  file_ = file;
  output_ = *std::move(output);
  return {};
}

client::Status BackupWriter::Bytes(const std::string& bytes) {
  if (output_ == nullptr) return ToClientStatus(absl::InternalError("the server sent bytes of no file"));
  written_ += bytes.size();
  on_bytes_(written_, manifest_.info.size_bytes);
  return ToClientStatus(output_->Write(bytes));
}

absl::Status BackupWriter::EndFile() {
  if (!file_) return absl::OkStatus();
  METAEKF_RETURN_IF_ERROR(output_->Sync());
  const std::string path = absl::StrCat(partial_, "/", file_->path);
  if (output_->Is(*file_)) {
    manifest_.files.push_back(*file_);
  } else {
    damaged_.push_back(file_->path);
    std::error_code ignored;
    fs::remove(path, ignored);
  }
  output_.reset();
  file_.reset();
  return absl::OkStatus();
}

absl::StatusOr<Manifest> BackupWriter::Finish() {
  METAEKF_RETURN_IF_ERROR(EndFile());
  if (manifest_.files.empty() || manifest_.files.front().path != kDatabase) {
    return absl::DataLossError("the server sent no database that is whole: there is no backup");
  }
  manifest_.info.files = static_cast<uint32_t>(manifest_.files.size());
  METAEKF_ASSIGN_OR_RETURN(const auto manifest, BackupOutput::Open(absl::StrCat(partial_, "/", kManifest)));
  METAEKF_RETURN_IF_ERROR(manifest->Write(ToJson(manifest_).dump(2) + "\n"));
  METAEKF_RETURN_IF_ERROR(manifest->Sync());
  METAEKF_RETURN_IF_ERROR(SyncDirectory(partial_ + "/blobs"));
  METAEKF_RETURN_IF_ERROR(SyncDirectory(partial_));
  if (rename(partial_.c_str(), directory_.c_str()) != 0) return Failed("give its name to", directory_);
  return manifest_;
}

absl::StatusOr<Manifest> VerifyBackup(const std::string& directory) {
  METAEKF_ASSIGN_OR_RETURN(Manifest manifest, ReadManifest(directory));
  std::vector<std::string> damaged;
  for (const client::BackupFile& file : manifest.files) {
    METAEKF_ASSIGN_OR_RETURN(const bool whole,
                             ReadVerified(directory, file, [](const std::string&) { return absl::OkStatus(); }));
    if (!whole) damaged.push_back(file.path);
  }
  if (!damaged.empty()) return Damaged(directory, damaged);
  return manifest;
}

absl::StatusOr<Manifest> RestoreBackup(const std::string& backup, const std::string& data_directory) {
  METAEKF_ASSIGN_OR_RETURN(Manifest manifest, ReadManifest(backup));
  std::error_code ignored;
  if (fs::exists(data_directory) && !fs::is_empty(data_directory, ignored)) {
    return absl::AlreadyExistsError(
        absl::StrCat(data_directory, " is not empty; a backup is restored into a new directory"));
  }
  const std::string partial = data_directory + ".partial";
  fs::remove_all(partial, ignored);
  METAEKF_RETURN_IF_ERROR(MakePrivateDirectory(partial));
  METAEKF_RETURN_IF_ERROR(MakePrivateDirectory(partial + "/blobs"));
  const auto copy = [&]() -> absl::Status {
    std::vector<std::string> damaged;
    for (const client::BackupFile& file : manifest.files) {
      METAEKF_ASSIGN_OR_RETURN(const auto output, BackupOutput::Open(absl::StrCat(partial, "/", file.path)));
      METAEKF_ASSIGN_OR_RETURN(const bool whole, ReadVerified(backup, file, [&](const std::string& bytes) { return output->Write(bytes); }));
      METAEKF_RETURN_IF_ERROR(output->Sync());
      if (!whole) damaged.push_back(file.path);
    }
    if (!damaged.empty()) return Damaged(backup, damaged);
    METAEKF_RETURN_IF_ERROR(SyncDirectory(partial + "/blobs"));
    METAEKF_RETURN_IF_ERROR(SyncDirectory(partial));
    if (rename(partial.c_str(), data_directory.c_str()) != 0) return Failed("give its name to", data_directory);
    return absl::OkStatus();
  };
  const absl::Status copied = copy();
  if (!copied.ok()) {
    fs::remove_all(partial, ignored);
    return copied;
  }
  return manifest;
}

}  // namespace metaekf::cli
