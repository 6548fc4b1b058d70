#include "client/cli/sample_sender.h"

#include <chrono>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/cli/data_files.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

void Append(const data::CsvRow& row, client::SampleBatch& batch) {
  batch.inputs.insert(batch.inputs.end(), row.inputs.begin(), row.inputs.end());
  batch.outputs.insert(batch.outputs.end(), row.outputs.begin(), row.outputs.end());
  if (!std::isnan(row.time_s)) batch.times_s.push_back(row.time_s);
  ++batch.samples;
}

}  // namespace

absl::StatusOr<SampleSender> SampleSender::Open(std::shared_ptr<std::istream> stream,
                                                const std::string& source, const Options& options) {
  absl::StatusOr<data::CsvRowReader> reader =
      data::CsvRowReader::Open(*stream, source, options.columns);
  if (!reader.ok()) return WithColumnHint(reader.status());
  SentRows rows{reader->output_names(), reader->state_names(), {}, {}};
  return SampleSender(std::make_shared<State>(
      State{std::move(stream), *std::move(reader), options, std::move(rows)}));
}

void SampleSender::Start(std::shared_ptr<client::EstimationSession> session) {
  std::packaged_task<absl::Status()> task([state = state_, session = std::move(session)] {
    const absl::Status status = Send(*state, *session);
    session->FinishSending();
    return status;
  });
  result_ = task.get_future();
  thread_ = std::thread(std::move(task));
}

absl::Status SampleSender::Send(State& state, client::EstimationSession& session) {
  data::CsvRow row;
  client::SampleBatch batch;
  for (bool first = true;; first = false) {
    METAEKF_ASSIGN_OR_RETURN(const bool found, state.reader.Next(row));
    if (found && row.starts_trajectory && !first) {
      return absl::InvalidArgumentError(
          absl::StrCat("row ", row.line, " starts trajectory \"", row.trajectory,
                       "\"; a filter follows one system: give each a file of its own"));
    }
    if (found) Append(row, batch);
    if (found && state.options.keep_rows) {
      state.rows.outputs.push_back(row.outputs);
      state.rows.states.push_back(row.states);
    }
    const bool full = batch.samples == state.options.samples_per_message;
    // Why the stream has ended is told by whoever receives from it.
    if (batch.samples > 0 && (full || !found) && !session.Send(batch).ok()) break;
    if (!found) break;
    if (full) batch = {};
  }
  return absl::OkStatus();
}

absl::Status SampleSender::Wait() {
  thread_.join();
  return result_.get();
}

void SampleSender::Abandon() {
  if (result_.wait_for(std::chrono::seconds(1)) == std::future_status::ready) {
    thread_.join();
  } else {
    thread_.detach();
  }
}

}  // namespace metaekf::cli
