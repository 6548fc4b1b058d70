#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/cli/backup_files.h"
#include "client/cli/commands.h"
#include "client/cli/progress.h"
#include "client/cli/records.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

void Print(Console& console, const std::string& directory, const Manifest& manifest) {
  PrintRecord(console, {{"directory", directory},
                        {"create_time", ToRecord(manifest.info.create_time)},
                        {"server_version", manifest.info.server_version},
                        {"data_format", manifest.info.data_format_version},
                        {"files", manifest.info.files},
                        {"size_bytes", manifest.info.size_bytes}});
}

absl::Status Backup(Console& console, const std::string& directory) {
  Progress progress(console, "backup");
  METAEKF_ASSIGN_OR_RETURN(const auto writer, BackupWriter::Create(directory, [&](uint64_t done, uint64_t total) {
                             progress.Update(done, total, std::nullopt, "");
                           }));
  METAEKF_RETURN_IF_ERROR(ToAbsl(console.client().CreateBackup(*writer)));
  METAEKF_ASSIGN_OR_RETURN(const Manifest manifest, writer->Finish());
  Print(console, directory, manifest);
  if (writer->damaged().empty()) return absl::OkStatus();
  return absl::DataLossError(absl::StrCat(
      "the server has lost or damaged ", absl::StrJoin(writer->damaged(), ", "), ", which the backup therefore lacks; \"metaekf doctor --verify\" says whose they are"));
}

absl::Status Verify(Console& console, const std::string& directory) {
  METAEKF_ASSIGN_OR_RETURN(const Manifest manifest, VerifyBackup(directory));
  Print(console, directory, manifest);
  return absl::OkStatus();
}

absl::Status Restore(Console& console, const std::string& backup, const std::string& data_directory) {
  METAEKF_ASSIGN_OR_RETURN(const Manifest manifest, RestoreBackup(backup, data_directory));
  Print(console, data_directory, manifest);
  console.err << "Serve it with: metaekfd --data-dir " << data_directory << "\n";
  return absl::OkStatus();
}

}  // namespace

void AddBackups(CLI::App& admin, Console& console, Command& chosen) {
  auto directory = std::make_shared<std::string>(), data_directory = std::make_shared<std::string>();
  const auto command = [&](const char* name, const char* what) {
    auto* added = admin.add_subcommand(name, what);
    added->add_option("DIRECTORY", *directory, "Of the backup")->required();
    return added;
  };
  OnChosen(command("backup", "Write all that a running server keeps into a new directory"), chosen,
           [&console, directory] { return Backup(console, *directory); });
  OnChosen(command("verify", "Read a backup and compare its digests; needs no server"), chosen,
           [&console, directory] { return Verify(console, *directory); });
  auto* restore = command("restore", "Make a data directory of a backup; needs no server");
  restore->add_option("--data-dir", *data_directory, "New or empty; for metaekfd --data-dir")->required();
  OnChosen(restore, chosen, [&console, directory, data_directory] { return Restore(console, *directory, *data_directory); });
}

}  // namespace metaekf::cli
