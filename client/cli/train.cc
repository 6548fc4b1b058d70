#include <google/protobuf/util/json_util.h>
#include <nlohmann/json.hpp>

#include "client/cli/commands.h"
#include "client/cli/data_files.h"
#include "client/cli/job_records.h"
#include "client/cli/training_estimate.h"
#include "client/src/text_proto.h"
#include "core/base/json_fields.h"
#include "core/base/status.h"
#include "metaekf/v1/spec.pb.h"

namespace metaekf::cli {
namespace {

struct Flags {
  std::string name, spec;
  std::vector<std::string> files;
  DataFlags data;
  bool watch = false, dry_run = false;
};

std::vector<client::Channel> ToChannels(const std::vector<std::string>& names) {
  std::vector<client::Channel> channels;
  for (const std::string& name : names) channels.push_back({name, ""});
  return channels;
}

/// Without a server: checks specification and data, and says what the training would take.
absl::Status DryRun(const Flags& flags, const std::string& spec, const data::Dataset& fleet, Console& console) {
  v1::TrainingSpec message;
  METAEKF_RETURN_IF_ERROR(ToAbsl(client::ParseText(spec, flags.spec, &message)));
  google::protobuf::util::JsonPrintOptions options;
  options.preserve_proto_field_names = true;
  std::string text;
  // Fails for a malformed google.protobuf.Any only; a specification holds none.
  (void)google::protobuf::util::MessageToJsonString(message, &text, options);
  nlohmann::json json;
  METAEKF_RETURN_IF_ERROR(base::ParseJson(text, &json));
  METAEKF_ASSIGN_OR_RETURN(const TrainingEstimate estimate, EstimateTraining(json, fleet));
  console.err << "specification and data are fine; a few steps were measured on this machine\n";
  PrintRecord(console, {{"model", flags.name},
                        {"trajectories", fleet.trajectories.size()},
                        {"estimated_duration_s", estimate.duration_s},
                        {"estimated_memory_mib", estimate.memory_mib}});
  return absl::OkStatus();
}

absl::Status Train(const Flags& flags, Console& console) {
  client::TrainingRequest request{.model = flags.name, .spec_source = flags.spec};
  METAEKF_ASSIGN_OR_RETURN(request.spec, ReadFile(flags.spec));
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset fleet,
                           ReadData(flags.files, FreeColumns(flags.data)));
  if (flags.dry_run) return DryRun(flags, request.spec, fleet, console);
  request.channels = {ToChannels(fleet.input_names), ToChannels(fleet.output_names),
                      ToChannels(fleet.state_names)};
  request.fleet = ToClient(fleet.trajectories);
  METAEKF_ASSIGN_OR_RETURN(const client::Job job,
                           ToAbsl(console.client().CreateTrainingJob(request)));
  console.err << "job " << job.id << " trains " << job.model << " on " << request.fleet.size()
              << " trajectories\n";
  if (flags.watch) return WatchJob(console, job.id);
  console.err << "follow it with: metaekf jobs watch " << job.id << "\n";
  PrintRecord(console, JobSummary(job));
  return absl::OkStatus();
}

}  // namespace

void AddTrain(CLI::App& app, Console& console, Command& chosen) {
  auto* command = app.add_subcommand("train", "Meta-train a model on a fleet, as a background job");
  auto flags = std::make_shared<Flags>();
  command->add_option("--name", flags->name, "Name of the model")->required();
  command->add_option("--spec", flags->spec, "TrainingSpec as protobuf text")->required();
  command
      ->add_option("--data", flags->files,
                   "CSV files: one with a trajectory per system, or one for each")
      ->required();
  flags->data.AddTo(command);
  command->add_flag("--watch", flags->watch, "Wait for the job and show its progress");
  command->add_flag("--dry-run", flags->dry_run,
                    "Check specification and data and estimate time and memory, here and without a server");
  OnChosen(command, chosen, [flags, &console] { return Train(*flags, console); });
}

}  // namespace metaekf::cli
