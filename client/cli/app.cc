#include "client/cli/app.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"

namespace metaekf::cli {
namespace {

constexpr int kDone = 0;
constexpr int kFailed = 1;
constexpr int kWrongUsage = 2;

/// The command that was being read: "metaekf models list".
const CLI::App& Deepest(const CLI::App& app) {
  const CLI::App* deepest = &app;
  while (!deepest->get_subcommands().empty()) deepest = deepest->get_subcommands().front();
  return *deepest;
}

std::string FullName(const CLI::App& app) {
  return app.get_parent() == nullptr ? app.get_name()
                                     : FullName(*app.get_parent()) + " " + app.get_name();
}

int ReportUsage(const CLI::App& app, const std::string& error, Console& console) {
  const CLI::App& command = Deepest(app);
  const std::vector<std::string> extras = app.remaining(true);
  const auto subcommands = command.get_subcommands([](const CLI::App*) { return true; });
  std::string message = error;
  if (!subcommands.empty()) {
    message = extras.empty() ? "a subcommand is needed"
                             : absl::StrCat("unknown subcommand \"", extras.front(), "\"");
    for (size_t i = 0; i < subcommands.size(); ++i) {
      absl::StrAppend(&message, i > 0 ? ", " : "; there are ", subcommands[i]->get_name());
    }
  }
  std::replace(message.begin(), message.end(), '\n', ' ');
  console.err << "metaekf: " << message << "; see: " << FullName(command) << " --help\n";
  return kWrongUsage;
}

}  // namespace

int Run(const std::vector<std::string>& arguments, Console& console) {
  CLI::App app(
      "Meta-learned neural state-space models: train on a fleet of similar systems, adapt to a new "
      "one, predict, and stream extended Kalman filter estimates.",
      "metaekf");
  app.fallthrough();
  app.require_subcommand(1);
  app.set_version_flag("--version", METAEKF_VERSION);
  app.add_option("--server", console.server, "HOST:PORT of the server")
      ->envname("METAEKF_SERVER")
      ->capture_default_str();
  app.add_option("--token-file", console.access.token_file,
                 "File with the token to show to the server; else METAEKF_TOKEN holds it");
  app.add_flag("--tls", console.access.tls, "Encrypt; trust the authorities that this machine trusts")
      ->envname("METAEKF_TLS");
  app.add_option("--tls-ca", console.access.tls_ca, "Encrypt; trust those in this PEM file instead")
      ->envname("METAEKF_TLS_CA");
  app.add_option("--tls-cert", console.access.tls_cert, "Show this certificate (PEM), for mutual TLS")
      ->envname("METAEKF_TLS_CERT");
  app.add_option("--tls-key", console.access.tls_key, "The key of --tls-cert (PEM)")
      ->envname("METAEKF_TLS_KEY");
  std::string format = "table";
  auto* format_option = app.add_option("--output", format, "How results are printed")
                            ->check(CLI::IsMember({"table", "json", "csv"}))
                            ->capture_default_str();
  Command chosen;
  for (auto* add : {AddDoctor, AddStatus, AddSimulate, AddTrain, AddJobs, AddModels, AddAdapt, AddAdaptations,
                    AddPredict, AddEstimate, AddCompare, AddReproduce, AddAdmin}) {
    add(app, console, chosen);
  }
  try {
    app.parse(std::vector<std::string>(arguments.rbegin(), arguments.rend()));
  } catch (const CLI::Success& success) {
    return app.exit(success, console.out, console.err);
  } catch (const CLI::ParseError& error) {
    return ReportUsage(app, error.what(), console);
  }
  console.format_given = format_option->count() > 0;
  console.format = format == "json"  ? Format::kJson
                   : format == "csv" ? Format::kCsv
                                     : Format::kTable;
  absl::Status status = console.TakeAccess();
  if (status.ok()) status = chosen();
  console.out.flush();
  if (IsUsageError(status)) return ReportUsage(app, std::string(status.message()), console);
  if (!status.ok()) console.err << "metaekf: " << status.message() << std::endl;
  return status.ok() ? kDone : kFailed;
}

}  // namespace metaekf::cli
