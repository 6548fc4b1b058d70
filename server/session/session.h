#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "core/filter/replay.h"
#include "metaekf/v1/estimation.pb.h"
#include "server/serving/model_cache.h"
#include "server/session/write_estimate.h"

namespace metaekf::server {

/// A filter fed by numbered batches. Used by one thread at a time.
class Session {
 public:
  /// Errors: InvalidArgument with violations below `open`; FailedPrecondition.
  static absl::StatusOr<std::unique_ptr<Session>> Open(std::shared_ptr<const ServedModel> model,
                                                       const v1::OpenSession& open);

  /// Applies a batch, or as much of it as one answer holds, and writes what it taught. Samples with numbers already applied are
  /// skipped; one that is not later than the newest goes to its own time.
  /// @param goes_on  the rest of a batch that was begun before, and is checked.
  /// Errors: InvalidArgument with violations below `samples`; OutOfRange (SEQUENCE_GAP) if numbers are missing. The
  /// session is unchanged then.
  absl::Status Apply(const v1::SampleBatch& batch, bool goes_on, filter::FilterModel::Scratch* scratch, v1::EstimateBatch* estimates);

  /// A batch on its way through a session, of which step by step is given to filter::StepTogether:
  ///
  ///   Begin, then while Next is true: the step, Taught
  struct Application {
    const v1::SampleBatch* batch = nullptr;
    v1::EstimateBatch* estimates = nullptr;
    int64_t row = 0;     ///< of the batch, that is next
    bool dated = false;  ///< `time_s` and `missed` are those of `row`
    double time_s = 0;
    int64_t missed = 0;  ///< periods before it that pass without a sample
    std::optional<Eigen::MatrixXd> measurement_cov;
    Eigen::VectorXd last_input;
  };
  /// Errors: those of Apply.
  absl::Status Begin(const v1::SampleBatch& batch, bool goes_on, v1::EstimateBatch* estimates, Application* application) const;
  /// @param next  receives the next step, if there is one and the answer has room; it refers to `application`. What is late is
  /// applied on the way.
  absl::StatusOr<bool> Next(Application* application, filter::FilterModel::Scratch* scratch, filter::NextReplaySample* next);
  /// After the step.
  absl::Status Taught(const filter::NextReplaySample& step, Application* application);

  /// Writes what the samples after the newest will be like. Errors: InvalidArgument with violations below `forecast`.
  absl::Status Forecast(const v1::ForecastRequest& request, filter::FilterModel::Scratch* scratch,
                        v1::EstimateBatch* forecast) const;

  /// Everything that changes, as bytes with a checksum; and back.
  std::string Checkpoint() const;
  /// Errors: those of DecodeCheckpoint.
  absl::Status Restore(const std::string& checkpoint, filter::FilterModel::Scratch* scratch);

  uint64_t applied_seq() const { return seq_; }
  /// What each estimate takes in an answer.
  int64_t row_bytes() const { return row_bytes_; }
  const ServedModel& model() const { return *model_; }
  void Describe(v1::SessionOpened* opened) const;

 private:
  Session(std::shared_ptr<const ServedModel> model, filter::ReplayFilter filter, const v1::OpenSession& open);

  absl::Status Check(const v1::SampleBatch& batch, int64_t rows) const;
  absl::Status CheckTimes(const v1::SampleBatch& batch) const;
  /// Periods from the last sample to one at `time_s`: 1 if none is missing between them, 0 or less for a late measurement of one
  /// of the `remembered` samples, the last included.
  absl::StatusOr<int64_t> PeriodsTo(double time_s, double last_time_s, int64_t remembered) const;
  /// When the row was measured, and how many periods after the newest.
  absl::StatusOr<int64_t> Date(Application* application) const;
  void Write(uint32_t flags, Application* application);

  const std::shared_ptr<const ServedModel> model_;
  filter::ReplayFilter filter_;
  filter::Estimate estimate_;
  const EstimateFormat format_;
  const int64_t row_bytes_;
  const double period_s_;
  uint64_t seq_ = 0;    // the last sample applied
  double time_s_ = 0;   // of the newest
  const Eigen::VectorXd nothing_;  // measured: NaN
};

}  // namespace metaekf::server
