#include <algorithm>
#include <cmath>
#include <fstream>

#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/data_files.h"
#include "client/cli/estimate_rows.h"
#include "client/cli/plots.h"
#include "client/cli/records.h"
#include "client/cli/sample_sender.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

// A file is sent in messages of so many samples; a pipe row by row, since the next may be long in
// coming.
constexpr size_t kSamplesPerMessage = 64;
constexpr size_t kMaxInFlight = 512;

struct Flags {
  client::Target target;
  std::string data = "-", out = "-", plot, noise;
  DataFlags columns;
  double gate = -1;  // not given
  int32_t recover_after = 0;
  bool stay_diverged = false;
  double max_lag_s = 0;
  bool smooth = false;
  std::string projection = "qp";
  int32_t initial_samples = 0;
  double reconnect_for_s = client::EstimationOptions().reconnect_for_s;
};

/// What is kept of the estimates for the plot.
struct History {
  std::vector<double> times_s;
  std::vector<std::vector<double>> means, std_devs;  // per quantity
};

/// What is said of a run.
struct Summary {
  uint64_t samples = 0, missing = 0, gated = 0, delayed = 0, reset = 0, nis_count = 0;
  double nis_sum = 0;
  client::Health health = client::Health::kUnknown;

  void Add(const client::EstimateBatch& batch) {
    for (size_t i = 0; i < batch.samples; ++i) {
      ++samples;
      missing += (batch.flags[i] & client::kMissing) != 0;
      gated += (batch.flags[i] & client::kGated) != 0;
      delayed += (batch.flags[i] & client::kDelayed) != 0;
      reset += (batch.flags[i] & client::kReset) != 0;
      if (!std::isnan(batch.nis[i])) {
        nis_sum += batch.nis[i];
        ++nis_count;
      }
      health = batch.health[i];
    }
  }
};

void Keep(const client::EstimateBatch& batch, History& history) {
  const size_t n = history.means.size();
  for (size_t i = 0; i < batch.samples; ++i) {
    history.times_s.push_back(batch.times_s[i]);
    for (size_t k = 0; k < n; ++k) {
      history.means[k].push_back(batch.means[i * n + k]);
      history.std_devs[k].push_back(std::sqrt(batch.covariances[i * n + k]));
    }
  }
}

absl::Status CheckShape(const client::EstimateBatch& batch, size_t n) {
  const size_t rows = batch.samples;
  if (rows > 0 && batch.times_s.size() == rows && batch.means.size() == rows * n &&
      batch.covariances.size() == rows * n && batch.health.size() == rows &&
      batch.flags.size() == rows) {
    return absl::OkStatus();
  }
  return absl::InternalError(absl::StrCat("the server's estimates from sample ", batch.first_seq,
                                          " on are not as asked for; is it of another version?"));
}

/// Writes estimates as they come until all have.
absl::Status Receive(client::EstimationSession& session, std::ostream& out, History* history,
                     Summary& summary) {
  while (true) {
    METAEKF_ASSIGN_OR_RETURN(const auto batch, ToAbsl(session.Receive()));
    if (!batch) return absl::OkStatus();
    METAEKF_RETURN_IF_ERROR(CheckShape(*batch, session.info().estimate_size));
    for (size_t i = 0; i < batch->samples; ++i) out << EstimateRow(*batch, i);
    out.flush();
    if (!out) return absl::DataLossError("the estimates cannot be written; is the disk full?");
    summary.Add(*batch);
    if (history != nullptr) Keep(*batch, *history);
  }
}

absl::Status Plot(const std::string& path, const std::string& title, const TargetModel& model,
                  const std::vector<client::Channel>& estimated, const History& history,
                  const SentRows& sent) {
  const bool states = model.version.estimates_states;
  const auto& truth = states ? sent.states : sent.outputs;
  const size_t truths = (states ? sent.state_names : sent.output_names).size();
  std::vector<Curve> curves;
  for (size_t k = 0; k < estimated.size(); ++k) {
    Curve curve{.name = estimated[k].name,
                .unit = estimated[k].unit,
                .measured_label = states ? "recorded" : "measured",
                .estimate_label = "estimate",
                .estimate = history.means[k],
                .std_dev = history.std_devs[k]};
    for (size_t t = 0; truths == estimated.size() && t < history.times_s.size(); ++t) {
      curve.measured.push_back(truth[t][static_cast<Eigen::Index>(k)]);
    }
    curves.push_back(std::move(curve));
  }
  return WritePlot(title, history.times_s, curves, path);
}

absl::StatusOr<SampleSender> OpenData(const Flags& flags, const TargetModel& model,
                                      Console& console) {
  METAEKF_ASSIGN_OR_RETURN(data::CsvOptions columns, ModelColumns(flags.columns, model, false));
  columns.allow_missing_outputs = true;
  columns.allow_any_times = flags.max_lag_s > 0;
  // States are not sent; where there are any, the plot shows them.
  if (!flags.plot.empty()) columns.states = FreeColumns(flags.columns).states;
  SampleSender::Options options{.columns = columns, .keep_rows = !flags.plot.empty()};
  if (flags.data == "-") {
    return SampleSender::Open(std::shared_ptr<std::istream>(&console.in, [](std::istream*) {}),
                              "standard input", options);
  }
  METAEKF_ASSIGN_OR_RETURN(std::shared_ptr<std::istream> file, OpenDataFile(flags.data));
  options.samples_per_message = kSamplesPerMessage;
  return SampleSender::Open(std::move(file), flags.data, options);
}

void PrintSummary(Console& console, const Summary& summary, size_t output_size, const std::string& session) {
  const double nis_count = static_cast<double>(summary.nis_count);
  PrintRecord(console, {{"samples", summary.samples},
                        {"missing", summary.missing},
                        {"gated", summary.gated},
                        {"delayed", summary.delayed},
                        {"reset", summary.reset},
                        {"mean_nis", summary.nis_sum / nis_count},
                        {"expected_nis", output_size},
                        {"health", HealthWord(summary.health)},
                        {"session", session}});
}

absl::StatusOr<client::NoiseSettings> ReadNoise(const Flags& flags) {
  if (flags.noise.empty()) return client::NoiseSettings();
  METAEKF_ASSIGN_OR_RETURN(const std::string text, ReadFile(flags.noise));
  return ToAbsl(client::ParseNoiseSettings(text, flags.noise));
}

client::GateSettings Gate(const Flags& flags) {
  return {.probability = std::max(0.0, flags.gate), .recover_after = flags.recover_after, .off = flags.gate == 0};
}

client::Projection ProjectionOf(const Flags& flags) {
  if (flags.projection == "autoencoder") return client::Projection::kAutoencoder;
  return flags.projection == "none" ? client::Projection::kNone : client::Projection::kQuadraticProgram;
}

/// All rows of a file at once, each estimated from all of them.
absl::Status EstimateSmoothly(const Flags& flags, Console& console) {
  if (flags.data == "-") return UsageError("--smooth needs the whole recording: give it as --data FILE");
  METAEKF_ASSIGN_OR_RETURN(const TargetModel model, DescribeTarget(console, flags.target));
  METAEKF_ASSIGN_OR_RETURN(data::CsvOptions columns, ModelColumns(flags.columns, model, false));
  columns.allow_missing_outputs = true;
  if (!flags.plot.empty()) columns.states = FreeColumns(flags.columns).states;
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset data, ReadData({flags.data}, columns));
  if (data.trajectories.size() != 1) {
    return absl::InvalidArgumentError(absl::StrCat(flags.data, " holds ", data.trajectories.size(),
                                                   " trajectories; a filter follows one system: give each a file of its own"));
  }
  data::Trajectory trajectory = data.trajectories.front();
  SentRows rows{data.output_names, data.state_names, {}, {}};
  for (Eigen::Index t = 0; t < trajectory.length(); ++t) {
    rows.outputs.emplace_back(trajectory.outputs.col(t));
    rows.states.emplace_back(trajectory.states.col(t));
  }
  trajectory.states.resize(0, trajectory.length());  // not what is estimated from
  client::SmoothingRequest request{.target = flags.target, .initial_samples = flags.initial_samples, .gate = Gate(flags), .projection = ProjectionOf(flags), .trajectory = ToClient(trajectory)};
  METAEKF_ASSIGN_OR_RETURN(request.noise, ReadNoise(flags));
  METAEKF_ASSIGN_OR_RETURN(const client::Smoothed smoothed, ToAbsl(console.client().Smooth(request)));

  const size_t n = smoothed.estimated.size();
  std::string text = EstimateHeader(smoothed.estimated, model.version.estimates_states, smoothed.constrained);
  History history;
  history.means.resize(n);
  history.std_devs.resize(n);
  Summary summary;
  for (const client::EstimateBatch& batch : smoothed.batches) {
    METAEKF_RETURN_IF_ERROR(CheckShape(batch, n));
    for (size_t i = 0; i < batch.samples; ++i) text += EstimateRow(batch, i);
    summary.Add(batch);
    Keep(batch, history);
  }
  if (flags.out == "-") {
    console.out << text;
  } else {
    METAEKF_RETURN_IF_ERROR(WriteFile(flags.out, text));
    PrintSummary(console, summary, model.version.channels.outputs.size(), "");
  }
  if (flags.plot.empty()) return absl::OkStatus();
  return Plot(flags.plot, "Smoothed estimates with " + model.label, model, smoothed.estimated, history, rows);
}

absl::Status Estimate(const Flags& flags, Console& console) {
  if (flags.smooth) return EstimateSmoothly(flags, console);
  METAEKF_ASSIGN_OR_RETURN(const TargetModel model, DescribeTarget(console, flags.target));
  client::EstimationOptions options{.target = flags.target,
                                    .sample_period_s = flags.columns.sample_period_s,
                                    .max_lag_s = flags.max_lag_s,
                                    .initial_samples = flags.initial_samples,
                                    .gate = Gate(flags),
                                    .projection = ProjectionOf(flags),
                                    .stay_diverged = flags.stay_diverged,
                                    .max_in_flight = kMaxInFlight,
                                    .reconnect_for_s = flags.reconnect_for_s};
  METAEKF_ASSIGN_OR_RETURN(options.noise, ReadNoise(flags));
  METAEKF_ASSIGN_OR_RETURN(SampleSender sender, OpenData(flags, model, console));
  METAEKF_ASSIGN_OR_RETURN(std::unique_ptr<client::EstimationSession> opened,
                           ToAbsl(console.client().OpenEstimation(options)));
  const std::shared_ptr<client::EstimationSession> session = std::move(opened);
  const client::SessionInfo& info = session->info();
  std::ofstream file;
  if (flags.out != "-") {
    METAEKF_RETURN_IF_ERROR(WriteFile(flags.out, ""));
    file.open(flags.out, std::ios::binary);
  }
  std::ostream& out = flags.out == "-" ? console.out : file;
  out << EstimateHeader(info.estimated, model.version.estimates_states, info.constrained) << std::flush;

  History history;
  history.means.resize(info.estimate_size);
  history.std_devs.resize(info.estimate_size);
  Summary summary;
  sender.Start(session);
  const absl::Status received =
      Receive(*session, out, flags.plot.empty() ? nullptr : &history, summary);
  if (!received.ok()) {
    sender.Abandon();
    return received;
  }
  METAEKF_RETURN_IF_ERROR(sender.Wait());
  if (!flags.plot.empty()) {
    METAEKF_RETURN_IF_ERROR(Plot(flags.plot, "Estimates with " + model.label, model, info.estimated,
                                 history, sender.rows()));
  }
  if (flags.out != "-") PrintSummary(console, summary, info.output_size, info.session);
  return absl::OkStatus();
}

}  // namespace

void AddEstimate(CLI::App& app, Console& console, Command& chosen) {
  auto* command =
      app.add_subcommand("estimate", "Stream samples through an extended Kalman filter");
  command->footer("An empty cell or nan in an output is a value that was not measured.");
  auto flags = std::make_shared<Flags>();
  AddTargetOptions(command, flags->target);
  command->add_option("--data", flags->data, "CSV file, or - for standard input (default)");
  command->add_option("--out", flags->out, "CSV file, or - for standard output (default)");
  command->add_option("--plot", flags->plot, "SVG file: estimates with bands of two sigma");
  command->add_option("--noise", flags->noise,
                      "NoiseSettings as protobuf text: Q, R, initial mean and covariance");
  command->add_flag("--smooth", flags->smooth,
                    "Estimate every sample of a file from all of them, by a fixed-interval smoother");
  command->add_option("--gate", flags->gate,
                      "Probability with which a right measurement passes the outlier gate (default 0.999999); 0: no gate")
      ->check(CLI::Range(0.0, 0.999999999999));
  command->add_option("--recover-after", flags->recover_after,
                      "Samples with outliers in a row after which they are believed (default 5)")
      ->check(CLI::PositiveNumber);
  command->add_option("--initial-samples", flags->initial_samples,
                      "Samples to find the first state from by least squares (models of states; default: begin with the "
                      "fleet's mean, or that of --noise)")
      ->check(CLI::Range(1, 1000));
  command->add_option("--projection", flags->projection,
                      "How estimates of a constrained model are put inside: qp (the most probable point, default), "
                      "autoencoder, or none")
      ->check(CLI::IsMember({"qp", "autoencoder", "none"}));
  command->add_flag("--stay-diverged", flags->stay_diverged, "Do not begin anew after a divergence");
  command->add_option("--max-lag-s", flags->max_lag_s,
                      "How late a measurement may be: rows with an earlier t than the latest are applied at their own time")
      ->check(CLI::NonNegativeNumber);
  command->add_option("--reconnect-for-s", flags->reconnect_for_s,
                      "How long to try to go on where the connection or the server is lost; 0: not at all")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  flags->columns.AddTo(command);
  OnChosen(command, chosen, [flags, &console] { return Estimate(*flags, console); });
}

}  // namespace metaekf::cli
