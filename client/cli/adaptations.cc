#include <string_view>

#include "absl/strings/str_cat.h"
#include "client/cli/adaptation_records.h"
#include "client/cli/commands.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

const char* Word(client::AdaptationMethod method) {
  switch (method) {
    case client::AdaptationMethod::kAdam:
      return "adam";
    case client::AdaptationMethod::kFromScratch:
      return "from-scratch";
    case client::AdaptationMethod::kLevenbergMarquardt:
      return "map";
    case client::AdaptationMethod::kGradientDescent:
      break;
  }
  return "gradient";
}

Record At(const std::vector<double>& values, size_t i) {
  return i < values.size() ? Record(values[i]) : Record();
}

std::vector<Record> ErrorRows(const client::HeldOutErrors& held_out, const TargetModel& model) {
  std::vector<Record> rows;
  const auto& outputs = model.version.channels.outputs;
  for (size_t i = 0; i < held_out.after.one_step.size(); ++i) {
    rows.push_back({{"output", i < outputs.size() ? outputs[i].name : absl::StrCat("y", i + 1)},
                    {"unit", OutputUnit(model, i)},
                    {"one_step_before", At(held_out.before.one_step, i)},
                    {"one_step_after", At(held_out.after.one_step, i)},
                    {"one_step_arx", At(held_out.arx.one_step, i)},
                    {"simulate_before", At(held_out.before.simulate, i)},
                    {"simulate_after", At(held_out.after.simulate, i)},
                    {"simulate_arx", At(held_out.arx.simulate, i)}});
  }
  return rows;
}

absl::Status List(Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const auto adaptations, ToAbsl(console.client().ListAdaptations()));
  std::vector<Record> records;
  for (const auto& adaptation : adaptations) records.push_back(AdaptationSummary(adaptation));
  PrintRecords(console,
               {"id", "model", "method", "inner_steps", "inner_lr", "context_samples",
                "context_loss_before", "context_loss_after", "create_time"},
               records);
  return absl::OkStatus();
}

absl::Status Show(Console& console, const std::string& id) {
  METAEKF_ASSIGN_OR_RETURN(const auto adaptation, ToAbsl(console.client().GetAdaptation(id)));
  METAEKF_ASSIGN_OR_RETURN(
      const TargetModel model,
      DescribeTarget(console,
                     {.model = absl::StrCat(adaptation.model, "@", adaptation.model_version)}));
  PrintReceipt(console, adaptation, model);
  return absl::OkStatus();
}

absl::Status Delete(Console& console, const std::string& id) {
  METAEKF_RETURN_IF_ERROR(ToAbsl(console.client().DeleteAdaptation(id)));
  console.err << "deleted " << id << "\n";
  return absl::OkStatus();
}

}  // namespace

Record AdaptationSummary(const client::Adaptation& adaptation) {
  return {{"id", adaptation.id},
          {"model", absl::StrCat(adaptation.model, "@", adaptation.model_version)},
          {"method", Word(adaptation.method)},
          {"inner_steps", OrNull(adaptation.inner_loop.steps)},
          {"inner_lr", OrNull(adaptation.inner_loop.learning_rate)},
          {"adapted", adaptation.inner_loop.adapted_mask},
          {"seed", adaptation.seed},
          {"context_samples", adaptation.context_samples},
          {"context_loss_before", adaptation.context_loss_before},
          {"context_loss_after", adaptation.context_loss_after},
          {"duration_s", adaptation.duration_s},
          {"create_time", ToRecord(adaptation.create_time)}};
}

void PrintReceipt(Console& console, const client::Adaptation& adaptation,
                  const TargetModel& model) {
  Record record = AdaptationSummary(adaptation);
  const client::HeldOutErrors held_out = adaptation.held_out.value_or(client::HeldOutErrors());
  const std::vector<Record> rows = ErrorRows(held_out, model);
  record["held_out_samples"] = held_out.samples;
  if (console.format == Format::kTable) {
    PrintRecord(console, record);
    if (!rows.empty()) console.out << "\nRMSE on the held-out tail of the context:\n";
  } else if (console.format == Format::kJson) {
    record["held_out_rmse"] = rows;
    record["verdict"] = Verdict(adaptation);
    PrintRecord(console, record);
    return;
  }
  if (!rows.empty() || console.format == Format::kCsv) {
    PrintRecords(console,
                 {"output", "unit", "one_step_before", "one_step_after", "one_step_arx",
                  "simulate_before", "simulate_after", "simulate_arx"},
                 rows);
  }
  (console.format == Format::kTable ? console.out : console.err) << Verdict(adaptation) << "\n";
}

std::string Verdict(const client::Adaptation& adaptation) {
  if (!adaptation.held_out) {
    return "The context is too short to hold a tail out: nothing says how good the adapted model "
           "is.";
  }
  const bool beats_before = adaptation.held_out->better_than_unadapted;
  const bool beats_arx = adaptation.held_out->better_than_arx;
  if (beats_before && beats_arx) {
    return "In free run the adapted model beats both the unadapted one and linear ARX.";
  }
  if (beats_before) {
    return "In free run the adapted model beats the unadapted one, but not linear ARX.";
  }
  if (beats_arx) {
    return "In free run the adapted model beats linear ARX, but not the unadapted one: try fewer "
           "steps or a smaller learning rate (--inner-steps, --inner-lr).";
  }
  return "In free run the adapted model beats neither the unadapted one nor linear ARX: do not use "
         "it as it is. Try a longer context, other --inner-steps or --inner-lr, or a model "
         "trained on systems more like this one.";
}

void AddAdaptations(CLI::App& app, Console& console, Command& chosen) {
  auto* group = app.add_subcommand("adaptations", "Adapted models")->require_subcommand(1);
  OnChosen(group->add_subcommand("list", "All adaptations"), chosen,
           [&console] { return List(console); });
  auto id = std::make_shared<std::string>();
  const auto with_id = [&](const char* name, const char* help, auto run) {
    auto* command = group->add_subcommand(name, help);
    command->add_option("ID", *id, "The adaptation's id")->required();
    OnChosen(command, chosen, [&console, id, run] { return run(console, *id); });
  };
  with_id("show", "One adaptation with its errors", Show);
  with_id("delete", "Delete an adaptation", Delete);
}

}  // namespace metaekf::cli
