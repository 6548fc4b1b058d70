#include "client/cli/commands.h"
#include "client/cli/data_files.h"
#include "client/cli/job_records.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

struct Flags {
  std::string name, spec;
  std::vector<std::string> files;
  DataFlags data;
  bool watch = false;
};

std::vector<client::Channel> ToChannels(const std::vector<std::string>& names) {
  std::vector<client::Channel> channels;
  for (const std::string& name : names) channels.push_back({name, ""});
  return channels;
}

absl::Status Train(const Flags& flags, Console& console) {
  client::TrainingRequest request{.model = flags.name, .spec_source = flags.spec};
  METAEKF_ASSIGN_OR_RETURN(request.spec, ReadFile(flags.spec));
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset fleet,
                           ReadData(flags.files, FreeColumns(flags.data)));
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
  OnChosen(command, chosen, [flags, &console] { return Train(*flags, console); });
}

}  // namespace metaekf::cli
