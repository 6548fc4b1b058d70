#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "absl/time/clock.h"
#include "core/base/status.h"
#include "server/convert/time.h"
#include "server/handlers/admin_handlers.h"
#include "server/store/schema.h"

namespace metaekf::server {
namespace {

using Response = v1::CreateBackupResponse;

constexpr size_t kChunkBytes = size_t{256} << 10;

class BackupSource final : public ResponseSource<Response> {
 public:
  explicit BackupSource(CallContext context) : context_(std::move(context)) {}

  absl::Status Open() override {
    METAEKF_ASSIGN_OR_RETURN(backup_, context_.server.store.MakeBackup(context_.caller.identity));
    return absl::OkStatus();
  }

  absl::StatusOr<bool> Next(Response* response) override {
    if (!header_sent_) {
      header_sent_ = true;
      WriteHeader(response->mutable_header());
      return true;
    }
    if (open_.valid()) {
      METAEKF_RETURN_IF_ERROR(ReadChunk(response->mutable_chunk()));
      if (!response->chunk().empty()) return true;
      open_ = store::UniqueFd();
      response->Clear();
    }
    if (next_ == backup_->files().size()) return false;
    const store::Backup::File& file = backup_->files()[next_++];
    response->mutable_file()->set_path(file.path);
    response->mutable_file()->set_size_bytes(static_cast<uint64_t>(file.size_bytes));
    response->mutable_file()->set_sha256(file.sha256);
    // One that is gone has no bytes, which its digest tells.
    open_ = store::UniqueFd(open(backup_->PathOf(file).c_str(), O_RDONLY | O_CLOEXEC));
    return true;
  }

 private:
  void WriteHeader(Response::Header* header) const {
    header->set_server_version(METAEKF_VERSION);
    header->set_data_format_version(static_cast<uint32_t>(store::kFormatVersion));
    *header->mutable_create_time() = ToTimestamp(absl::Now());
    header->set_file_count(static_cast<uint32_t>(backup_->files().size()));
    int64_t bytes = 0;
    for (const store::Backup::File& file : backup_->files()) bytes += file.size_bytes;
    header->set_size_bytes(static_cast<uint64_t>(bytes));
  }

  absl::Status ReadChunk(std::string* chunk) {
    chunk->resize(kChunkBytes);
    ssize_t read_bytes = 0;
    do {
      read_bytes = read(open_.get(), chunk->data(), chunk->size());
    } while (read_bytes < 0 && errno == EINTR);
    if (read_bytes < 0) return store::ErrnoStatus(errno, "cannot read a file of the backup");
    chunk->resize(static_cast<size_t>(read_bytes));
    return absl::OkStatus();
  }

  CallContext context_;
  std::unique_ptr<store::Backup> backup_;
  bool header_sent_ = false;
  size_t next_ = 0;       // of the backup's files
  store::UniqueFd open_;  // the one before it
};

}  // namespace

std::unique_ptr<ResponseSource<Response>> CreateBackup(CallContext context) {
  return std::make_unique<BackupSource>(std::move(context));
}

}  // namespace metaekf::server
