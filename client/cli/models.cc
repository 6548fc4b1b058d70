#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/records.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

struct Flags {
  std::string model, file, alias;
  uint32_t version = 0;
};

std::string Aliases(const client::Model& model) {
  std::string text;
  for (const client::ModelAlias& alias : model.aliases) {
    absl::StrAppend(&text, text.empty() ? "" : ", ", alias.alias, "=", alias.version);
  }
  return text;
}

std::string Names(const std::vector<client::Channel>& channels) {
  std::string text;
  for (const client::Channel& channel : channels) {
    absl::StrAppend(&text, text.empty() ? "" : ", ", channel.name,
                    channel.unit.empty() ? "" : " (" + channel.unit + ")");
  }
  return text;
}

Record ToRecord(const client::ModelVersion& version) {
  return {{"model", absl::StrCat(version.model, "@", version.version)},
          {"estimates", version.estimates_states ? "states" : "outputs"},
          {"inputs", Names(version.channels.inputs)},
          {"outputs", Names(version.channels.outputs)},
          {"states", Names(version.channels.states)},
          {"sample_period_s", version.sample_period_s},
          {"parameters", version.parameter_count},
          {"validation_loss", OrNull(version.validation_loss)},
          {"training_job", version.training_job},
          {"create_time", cli::ToRecord(version.create_time)},
          {"size_bytes", version.size_bytes},
          {"sha256", version.sha256}};
}

absl::Status List(Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const auto models, ToAbsl(console.client().ListModels()));
  std::vector<Record> records;
  for (const client::Model& model : models) {
    records.push_back({{"name", model.name},
                       {"latest_version", model.latest_version},
                       {"versions", model.version_count},
                       {"aliases", Aliases(model)},
                       {"create_time", cli::ToRecord(model.create_time)}});
  }
  PrintRecords(console, {"name", "latest_version", "versions", "aliases", "create_time"}, records);
  return absl::OkStatus();
}

absl::Status Show(const Flags& flags, Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const auto version,
                           ToAbsl(console.client().GetModelVersion(flags.model)));
  METAEKF_ASSIGN_OR_RETURN(const auto model, ToAbsl(console.client().GetModel(version.model)));
  Record record = ToRecord(version);
  record["latest_version"] = model.latest_version;
  record["versions"] = model.version_count;
  record["aliases"] = Aliases(model);
  record["spec"] = version.spec;
  PrintRecord(console, record);
  return absl::OkStatus();
}

absl::Status Export(const Flags& flags, Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const std::string file,
                           ToAbsl(console.client().ExportModel(flags.model)));
  METAEKF_RETURN_IF_ERROR(WriteFile(flags.file, file));
  console.err << "wrote " << flags.file << " (" << file.size() << " bytes)\n";
  return absl::OkStatus();
}

absl::Status Import(const Flags& flags, Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const std::string file, ReadFile(flags.file));
  METAEKF_ASSIGN_OR_RETURN(const auto version,
                           ToAbsl(console.client().ImportModel(flags.model, file)));
  PrintRecord(console, ToRecord(version));
  return absl::OkStatus();
}

absl::Status Alias(const Flags& flags, Console& console) {
  METAEKF_RETURN_IF_ERROR(
      ToAbsl(console.client().SetModelAlias(flags.model, flags.alias, flags.version)));
  console.err << flags.model << "@" << flags.alias << " is version " << flags.version << " now\n";
  return absl::OkStatus();
}

absl::Status Delete(const Flags& flags, Console& console) {
  const size_t at = flags.model.find('@');
  if (at == std::string::npos) {
    return UsageError(absl::StrCat("say what of ", flags.model,
                                   " to delete: NAME@VERSION, or NAME@ALIAS for the alias alone"));
  }
  const bool is_version = flags.model.find_first_not_of("0123456789", at + 1) == std::string::npos;
  METAEKF_RETURN_IF_ERROR(ToAbsl(is_version ? console.client().DeleteModelVersion(flags.model)
                                            : console.client().DeleteModelAlias(flags.model)));
  console.err << "deleted " << flags.model << "\n";
  return absl::OkStatus();
}

}  // namespace

void AddModels(CLI::App& app, Console& console, Command& chosen) {
  auto* models = app.add_subcommand("models", "The registry of models")->require_subcommand(1);
  auto flags = std::make_shared<Flags>();
  const auto add = [&](const char* name, const char* help, auto run) {
    auto* command = models->add_subcommand(name, help);
    OnChosen(command, chosen, [flags, &console, run] { return run(*flags, console); });
    return command;
  };
  const auto add_model = [&flags](CLI::App* command, const char* what) {
    command->add_option("MODEL", flags->model, what)->required();
  };
  add("list", "All models", [](const Flags&, Console& to) { return List(to); });
  add_model(add("show", "One version with all that is known", Show), "NAME[@VERSION|@ALIAS]");
  auto* export_command = add("export", "Write a version's model file", Export);
  add_model(export_command, "NAME[@VERSION|@ALIAS]");
  export_command->add_option("FILE", flags->file, "File to write (.safetensors)")->required();
  auto* import_command = add("import", "Add a model file as a new version", Import);
  add_model(import_command, "NAME, which is made if there is none yet");
  import_command->add_option("FILE", flags->file, "File to read (.safetensors)")->required();
  auto* alias = add("alias", "Point an alias at a version", Alias);
  add_model(alias, "NAME");
  alias->add_option("ALIAS", flags->alias, "Name of the alias")->required();
  alias->add_option("VERSION", flags->version, "Number of the version")->required();
  add_model(add("delete", "Delete a version or an alias", Delete), "NAME@VERSION or NAME@ALIAS");
}

}  // namespace metaekf::cli
