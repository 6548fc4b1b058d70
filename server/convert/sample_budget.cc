#include "server/convert/sample_budget.h"

#include "absl/strings/str_cat.h"
#include "server/status/details.h"

namespace metaekf::server {

absl::Status SampleBudget::Share::Grow(int64_t bytes) {
  // In this order, so that no sum is beyond what 64 bits hold.
  if (bytes > budget_.bytes_ - held_) {
    return absl::ResourceExhaustedError(
        absl::StrCat("the samples, and what is computed from them, take more than ", budget_.bytes_,
                     " bytes, this server's limits.sample_bytes; send fewer samples"));
  }
  if (budget_.used_.fetch_add(bytes) + bytes > budget_.bytes_) {
    budget_.used_ -= bytes;
    return WithRetryDelay(absl::ResourceExhaustedError("the server holds too many samples of other calls; try again in a second"),
                          absl::Seconds(1));
  }
  held_ += bytes;
  return absl::OkStatus();
}

void SampleBudget::Share::ShrinkTo(int64_t bytes) {
  budget_.used_ -= held_ - bytes;
  held_ = bytes;
}

}  // namespace metaekf::server
