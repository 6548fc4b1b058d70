#pragma once

#include <future>
#include <istream>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/data/csv_rows.h"
#include "metaekf/client.h"

namespace metaekf::cli {

/// The rows that were sent, for a plot.
struct SentRows {
  std::vector<std::string> output_names, state_names;
  std::vector<Eigen::VectorXd> outputs, states;
};

/// Reads a stream of CSV rows in a thread of its own and sends them to a session.
class SampleSender {
 public:
  struct Options {
    data::CsvOptions columns;
    size_t samples_per_message = 1;
    bool keep_rows = false;
  };

  /// Reads the header; `stream` must outlive the reading. Errors: those of the header.
  static absl::StatusOr<SampleSender> Open(std::shared_ptr<std::istream> stream,
                                           const std::string& source, const Options& options);

  /// Starts sending. The session is told when all has been sent, also after an error.
  void Start(std::shared_ptr<client::EstimationSession> session);

  /// Waits until all has been sent. Errors: those of the rows, or a second trajectory.
  absl::Status Wait();
  /// Gives up on a stream that may never say anything again.
  void Abandon();

  /// After Wait.
  const SentRows& rows() const { return state_->rows; }

 private:
  /// What the thread works with; it outlives the sender if that is abandoned.
  struct State {
    std::shared_ptr<std::istream> stream;
    data::CsvRowReader reader;
    Options options;
    SentRows rows;
  };

  explicit SampleSender(std::shared_ptr<State> state) : state_(std::move(state)) {}
  static absl::Status Send(State& state, client::EstimationSession& session);

  std::shared_ptr<State> state_;
  std::thread thread_;
  std::future<absl::Status> result_;
};

}  // namespace metaekf::cli
