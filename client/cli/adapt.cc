#include "absl/strings/str_cat.h"
#include "client/cli/adaptation_records.h"
#include "client/cli/commands.h"
#include "client/cli/data_files.h"
#include "client/cli/progress.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"

namespace metaekf::cli {
namespace {

struct Flags {
  client::AdaptationRequest request;
  std::string context, method;
  int64_t samples = 0;
  uint32_t steps = 0;
  double learning_rate = 0;
  DataFlags data;
};

absl::StatusOr<data::Trajectory> ReadContext(const Flags& flags, const TargetModel& model) {
  METAEKF_ASSIGN_OR_RETURN(const data::CsvOptions options, ModelColumns(flags.data, model, true));
  METAEKF_ASSIGN_OR_RETURN(data::Dataset dataset, ReadData({flags.context}, options));
  if (dataset.trajectories.size() != 1) {
    return absl::InvalidArgumentError(
        absl::StrCat(flags.context, " holds ", dataset.trajectories.size(),
                     " trajectories; a context is one, of the system to adapt to"));
  }
  const data::Trajectory& context = dataset.trajectories.front();
  if (flags.samples == 0) return context;
  if (flags.samples > context.length()) {
    return absl::InvalidArgumentError(absl::StrCat("--samples ", flags.samples, ", but ",
                                                   flags.context, " has ", context.length()));
  }
  return data::FirstSamples(context, flags.samples);
}

absl::Status Adapt(const Flags& flags, Console& console) {
  client::AdaptationRequest request = flags.request;
  METAEKF_ASSIGN_OR_RETURN(const TargetModel model,
                           DescribeTarget(console, {.model = request.model}));
  METAEKF_ASSIGN_OR_RETURN(const data::Trajectory context, ReadContext(flags, model));
  request.context = ToClient(context);
  if (flags.method == "gradient") request.method = client::AdaptationMethod::kGradientDescent;
  if (flags.method == "adam") request.method = client::AdaptationMethod::kAdam;
  if (flags.method == "from-scratch") request.method = client::AdaptationMethod::kFromScratch;
  if (flags.method == "map") request.method = client::AdaptationMethod::kLevenbergMarquardt;
  if (flags.steps > 0) request.inner_loop.steps = flags.steps;
  if (flags.learning_rate > 0) request.inner_loop.learning_rate = flags.learning_rate;

  absl::StatusOr<client::Adaptation> adaptation;
  {
    Progress bar(console, "adapting");
    adaptation =
        ToAbsl(console.client().Adapt(request, [&bar](const client::AdaptationProgress& progress) {
          bar.Update(progress.step, progress.steps, {}, "loss " + base::FormatShort(progress.loss));
          return true;
        }));
  }
  METAEKF_RETURN_IF_ERROR(adaptation.status());
  PrintReceipt(console, *adaptation, model);
  return absl::OkStatus();
}

}  // namespace

void AddAdapt(CLI::App& app, Console& console, Command& chosen) {
  auto* command =
      app.add_subcommand("adapt", "Adapt a model to a new system from a short recording");
  auto flags = std::make_shared<Flags>();
  command->add_option("--model", flags->request.model, "NAME[@VERSION|@ALIAS]")->required();
  command->add_option("--context", flags->context, "CSV with one trajectory of the new system")
      ->required();
  command->add_option("--samples", flags->samples, "Use the first N samples only")
      ->check(CLI::PositiveNumber);
  command->add_option("--name", flags->request.adaptation_id,
                      "Id of the adaptation (default: chosen by the server)");
  command
      ->add_option("--method", flags->method,
                   "gradient (the inner loop), adam, map (the most probable parameters, by "
                   "Levenberg–Marquardt), or from-scratch (the baseline without meta-learning); "
                   "default: what the model was trained for")
      ->check(CLI::IsMember({"gradient", "adam", "map", "from-scratch"}));
  command->add_option("--inner-steps", flags->steps, "Steps (default: the model's)")
      ->check(CLI::PositiveNumber);
  command->add_option("--inner-lr", flags->learning_rate, "Learning rate (default: the model's)")
      ->check(CLI::PositiveNumber);
  command->add_option("--adapt", flags->request.inner_loop.adapted_mask,
                      "Which parameters adapt, e.g. encoder.4-5,transition (default: the model's)");
  command->add_option("--seed", flags->request.seed, "Seed of from-scratch (default 0)");
  command->add_flag("--require-better-than-arx", flags->request.require_better_than_arx,
                    "Refuse the adaptation unless it beats linear ARX in free run");
  flags->data.AddTo(command);
  OnChosen(command, chosen, [flags, &console] { return Adapt(*flags, console); });
}

}  // namespace metaekf::cli
