#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/job_records.h"
#include "client/cli/progress.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

const char* Word(client::JobState state) {
  switch (state) {
    case client::JobState::kQueued:
      return "queued";
    case client::JobState::kRunning:
      return "running";
    case client::JobState::kSucceeded:
      return "succeeded";
    case client::JobState::kFailed:
      return "failed";
    case client::JobState::kCancelled:
      return "cancelled";
    case client::JobState::kUnknown:
      break;
  }
  return "unknown";
}

std::string ModelName(const client::Job& job) {
  return job.model_version ? absl::StrCat(job.model, "@", *job.model_version) : job.model;
}

absl::Status List(Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const auto jobs, ToAbsl(console.client().ListJobs()));
  std::vector<Record> records;
  for (const client::Job& job : jobs) records.push_back(JobSummary(job));
  PrintRecords(
      console,
      {"id", "model", "state", "iteration", "iterations", "best_validation_loss", "create_time"},
      records);
  return absl::OkStatus();
}

absl::Status Print(Console& console, client::Result<client::Job> job) {
  METAEKF_ASSIGN_OR_RETURN(const client::Job found, ToAbsl(std::move(job)));
  PrintRecord(console, JobDetails(found));
  return absl::OkStatus();
}

}  // namespace

Record JobSummary(const client::Job& job) {
  const client::TrainingProgress progress = job.progress.value_or(client::TrainingProgress());
  return {{"id", job.id},
          {"model", ModelName(job)},
          {"state", Word(job.state)},
          {"iteration", progress.iteration},
          {"iterations", progress.iterations},
          {"best_validation_loss", OrNull(progress.best_validation_loss)},
          {"create_time", ToRecord(job.create_time)}};
}

Record JobDetails(const client::Job& job) {
  Record record = JobSummary(job);
  const client::TrainingProgress progress = job.progress.value_or(client::TrainingProgress());
  record["training_loss"] = OrNull(progress.training_loss);
  record["validation_loss"] = OrNull(progress.validation_loss);
  record["time_left_s"] = OrNull(progress.time_left_s);
  record["message"] = progress.message;
  record["error"] = job.error_message;
  record["attempt"] = job.attempt;
  record["start_time"] = ToRecord(job.start_time);
  record["end_time"] = ToRecord(job.end_time);
  record["spec"] = job.spec;
  return record;
}

absl::Status WatchJob(Console& console, const std::string& id) {
  absl::StatusOr<client::Job> job;
  {
    Progress bar(console, "training");
    job = ToAbsl(console.client().WatchJob(id, [&bar](const client::Job& now) {
      if (!now.progress) return true;
      std::string text = now.progress->message;
      if (now.progress->training_loss) {
        absl::StrAppend(&text, text.empty() ? "" : ", ", "loss ",
                        base::FormatShort(*now.progress->training_loss));
      }
      if (now.progress->best_validation_loss) {
        absl::StrAppend(&text, ", best validation ",
                        base::FormatShort(*now.progress->best_validation_loss));
      }
      bar.Update(now.progress->iteration, now.progress->iterations, now.progress->time_left_s,
                 text);
      return true;
    }));
  }
  METAEKF_RETURN_IF_ERROR(job.status());
  PrintRecord(console, JobSummary(*job));
  if (job->state == client::JobState::kSucceeded) return absl::OkStatus();
  return absl::FailedPreconditionError(absl::StrCat("job ", job->id, " ", Word(job->state),
                                                    job->error_message.empty() ? "" : ": ",
                                                    job->error_message));
}

void AddJobs(CLI::App& app, Console& console, Command& chosen) {
  auto* jobs = app.add_subcommand("jobs", "Training jobs")->require_subcommand(1);
  OnChosen(jobs->add_subcommand("list", "All jobs, newest first"), chosen,
           [&console] { return List(console); });
  const auto with_id = [&](const char* name, const char* help, auto run) {
    auto* command = jobs->add_subcommand(name, help);
    auto id = std::make_shared<std::string>();
    command->add_option("ID", *id, "The job's number")->required();
    OnChosen(command, chosen, [&console, id, run] { return run(console, *id); });
  };
  with_id("show", "One job with all that is known",
          [](Console& to, const std::string& id) { return Print(to, to.client().GetJob(id)); });
  with_id("watch", "Follow a job until it has ended", WatchJob);
  with_id("cancel", "Stop a job",
          [](Console& to, const std::string& id) { return Print(to, to.client().CancelJob(id)); });
}

}  // namespace metaekf::cli
