#include "core/filter/smoother.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/handlers/smoothing_handlers.h"
#include "server/handlers/trajectory_call.h"
#include "server/session/read_options.h"
#include "server/session/write_estimate.h"

namespace metaekf::server {
namespace {

using Request = v1::SmoothRequest;
using Response = v1::SmoothResponse;
using Sink = ResponseSink<Response>;

constexpr size_t kValuesPerResponse = 16'384;

class SmoothCall final : public TrajectoryCall<Request, Response> {
 public:
  using TrajectoryCall::TrajectoryCall;

 private:
  absl::Status TakeHeader(const Request::Header& header) override {
    const nssm::Bundle& bundle = model().bundle;
    METAEKF_ASSIGN_OR_RETURN(const filter::FilterOptions options,
                             ReadFilterOptions("header", header, model().filter_model->state_size(),
                                               bundle.model.spec().output_size));
    absl::StatusOr<filter::Ekf> ekf =
        filter::Ekf::Create(bundle, model().filter_model, model().filter_parameters, options);
    if (!ekf.ok()) return FieldViolation("header.noise", std::string(ekf.status().message()));
    ekf_ = *std::move(ekf);
    format_ = {.covariance = header.covariance_format() == v1::OpenSession::COVARIANCE_FORMAT_UNSPECIFIED
                                 ? v1::OpenSession::NONE
                                 : header.covariance_format(),
               .constrained = ekf_->constrained()};
    return absl::OkStatus();
  }

  int64_t BytesPerSample() const override {
    const int64_t width = ekf_->estimate_size();
    return filter::SmoothingBytesPerSample(*ekf_) + width * (width + 3) * static_cast<int64_t>(sizeof(double));
  }

  absl::Status Answer(const data::Trajectory& trajectory, Sink& sink) override {
    const auto scratch = model().filter_model->MakeScratch();
    const auto estimates = filter::Smooth(*ekf_, trajectory, scratch.get());
    if (!estimates.ok()) {
      return FieldViolation("samples", absl::StrCat("trajectory '", trajectory.name, "': ", estimates.status().message()));
    }
    const size_t width = static_cast<size_t>(ekf_->estimate_size());
    const size_t rows = std::max<size_t>(1, kValuesPerResponse / (width * (width + 3) / 2 + 4));
    for (size_t first = 0; first < estimates->size(); first += rows) {
      Response response;
      response.set_trajectory(trajectory.name);
      response.mutable_estimates()->set_first_seq(first + 1);
      for (size_t t = first; t < std::min(first + rows, estimates->size()); ++t) {
        const Eigen::Index sample = static_cast<Eigen::Index>(t);
        const uint32_t flags = trajectory.outputs.col(sample).hasNaN() ? v1::EstimateBatch::MISSING : 0;
        WriteEstimate(format_, trajectory.start_s + static_cast<double>(t) * model().bundle.sample_period_s, (*estimates)[t],
                      flags, response.mutable_estimates());
      }
      if (first == 0) Introduce(&response);
      sink.Send(std::move(response));
    }
    return absl::OkStatus();
  }

  void Introduce(Response* response) const {
    const nssm::Bundle& bundle = model().bundle;
    for (const std::string& name : bundle.model.spec().is_case_one() ? bundle.names.outputs : bundle.names.states) {
      response->add_estimated()->set_name(name);
    }
    response->set_constrained(format_.constrained);
  }

  std::optional<filter::Ekf> ekf_;  // that has applied nothing
  EstimateFormat format_;
};

}  // namespace

std::unique_ptr<StreamHandler<Request, Response>> Smooth(CallContext context) {
  return std::make_unique<SmoothCall>(std::move(context), "Smooth");
}

}  // namespace metaekf::server
