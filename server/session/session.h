#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/filter/ekf.h"
#include "metaekf/v1/estimation.pb.h"
#include "server/serving/model_cache.h"

namespace metaekf::server {

/// A filter fed by numbered batches. Used by one thread at a time.
class Session {
 public:
  /// Errors: InvalidArgument with violations below `open`; FailedPrecondition.
  static absl::StatusOr<std::unique_ptr<Session>> Open(std::shared_ptr<const ServedModel> model,
                                                       const v1::OpenSession& open);

  /// Applies a batch and writes what it taught. Samples with numbers already applied are skipped.
  /// Errors: InvalidArgument with violations below `samples`; OutOfRange (SEQUENCE_GAP) if numbers are missing. The
  /// session is unchanged then.
  absl::Status Apply(const v1::SampleBatch& batch, filter::FilterModel::Scratch* scratch, v1::EstimateBatch* estimates);

  /// Everything that changes, as bytes with a checksum; and back.
  std::string Checkpoint() const;
  /// Errors: DataLoss if the bytes are damaged.
  absl::Status Restore(const std::string& checkpoint);

  uint64_t applied_seq() const { return seq_; }
  const ServedModel& model() const { return *model_; }
  void Describe(v1::SessionOpened* opened) const;

 private:
  Session(std::shared_ptr<const ServedModel> model, filter::Ekf ekf, const v1::OpenSession& open);

  absl::Status Check(const v1::SampleBatch& batch, int64_t rows) const;
  /// Periods from the last sample to one at `time_s`: 1 if none is missing between them.
  absl::StatusOr<int64_t> PeriodsTo(double time_s, double last_time_s) const;
  absl::Status Step(const double* input, const double* output, filter::FilterModel::Scratch* scratch);
  void Append(const double* output, v1::EstimateBatch* estimates) const;

  const std::shared_ptr<const ServedModel> model_;
  filter::Ekf ekf_;
  filter::Estimate estimate_;
  const v1::OpenSession::CovarianceFormat covariance_format_;
  const bool send_innovations_;
  const double period_s_;
  uint64_t seq_ = 0;    // the last sample applied
  double time_s_ = 0;   // its time
};

}  // namespace metaekf::server
