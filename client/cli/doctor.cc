#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/records.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

constexpr double kLowDiskBytes = 1e9;

class Checks {
 public:
  void Add(const char* what, bool good, const std::string& detail, const std::string& advice) {
    records_.push_back({{"check", what},
                        {"result", good ? "ok" : "problem"},
                        {"detail", good || advice.empty() ? detail : detail + ": " + advice}});
    problems_ += !good;
  }
  void Print(Console& console) const {
    PrintRecords(console, {"check", "result", "detail"}, records_);
  }
  int problems() const { return problems_; }

 private:
  std::vector<Record> records_;
  int problems_ = 0;
};

void CheckServer(const client::ServerInfo& info, Checks& checks) {
  checks.Add("version", info.version == METAEKF_VERSION,
             absl::StrCat("server ", info.version, ", command line ", METAEKF_VERSION),
             "install the same version on both sides");
  const std::string stored =
      absl::StrCat(base::FormatShort(1e-6 * static_cast<double>(info.stored_bytes)), " MB of models and data stored");
  if (info.free_disk_bytes) {
    const double free_bytes = static_cast<double>(*info.free_disk_bytes);
    checks.Add("disk", free_bytes >= kLowDiskBytes,
               absl::StrCat(base::FormatShort(1e-9 * free_bytes), " GB free, ", stored),
               "make room on the disk of the server's data directory");
  } else {
    checks.Add("disk", true, stored, "");
  }
  checks.Add("data directory", info.problems.empty(),
             absl::StrCat("format ", info.data_format_version, ", ", info.problems.size(),
                          " damaged or missing files"),
             "restore them from a backup, or delete what they belong to");
  for (const std::string& problem : info.problems) checks.Add("stored file", false, problem, "");
  const char* first_model =
      info.models > 0 ? "" : "; train one (metaekf train) or import one (metaekf models import)";
  checks.Add("models", true,
             absl::StrCat(info.models, " models, ", info.model_versions, " versions, ",
                          info.adaptations, " adaptations", first_model),
             "");
  checks.Add("work", true,
             absl::StrCat(info.running_jobs, " jobs run, ", info.queued_jobs, " wait, ",
                          info.sessions, " estimation sessions"),
             "");
}

absl::Status Diagnose(Console& console, bool verify) {
  Checks checks;
  const auto info = ToAbsl(console.client().GetServerInfo(verify));
  if (!info.ok()) {
    checks.Add("server", false, std::string(info.status().message()), "");
    checks.Print(console);
    return info.status();
  }
  checks.Add("server", true, absl::StrCat("answers at ", console.server), "");
  CheckServer(*info, checks);
  checks.Print(console);
  if (checks.problems() == 0) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat(checks.problems(), " of the checks found a problem"));
}

}  // namespace

void AddDoctor(CLI::App& app, Console& console, Command& chosen) {
  auto* command = app.add_subcommand(
      "doctor", "Check server, versions, data directory and models, and say what to do");
  auto verify = std::make_shared<bool>(false);
  command->add_flag("--verify", *verify, "Read every stored file and compare its digest");
  OnChosen(command, chosen, [&console, verify] { return Diagnose(console, *verify); });
}

}  // namespace metaekf::cli
