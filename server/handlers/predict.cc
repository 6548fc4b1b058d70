#include "core/nssm/predict.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/handlers/prediction_handlers.h"
#include "server/handlers/trajectory_call.h"

namespace metaekf::server {
namespace {

using Request = v1::PredictRequest;
using Response = v1::PredictResponse;
using Sink = ResponseSink<Response>;

constexpr Eigen::Index kValuesPerResponse = 16'384;

void Append(const Eigen::MatrixXd& values, Eigen::Index first, Eigen::Index count,
            google::protobuf::RepeatedField<double>* field) {
  const double* begin = values.data() + first * values.rows();
  field->Add(begin, begin + count * values.rows());
}

class PredictCall final : public TrajectoryCall<Request, Response> {
 public:
  using TrajectoryCall::TrajectoryCall;

 private:
  absl::Status TakeHeader(const Request::Header& header) override {
    if (header.mode() != Request::ONE_STEP && header.mode() != Request::SIMULATE) {
      return FieldViolation("header.mode", "say ONE_STEP or SIMULATE");
    }
    mode_ = header.mode() == Request::ONE_STEP ? nssm::PredictionMode::kOneStep
                                               : nssm::PredictionMode::kSimulate;
    return absl::OkStatus();
  }

  int64_t BytesPerSample() const override {
    const nssm::ModelSpec& spec = model().bundle.model.spec();
    return 2 * (spec.output_size + spec.state_size) * static_cast<int64_t>(sizeof(double));  // computed, and as answers
  }

  absl::Status Answer(const data::Trajectory& trajectory, Sink& sink) override {
    METAEKF_RETURN_IF_ERROR(CheckStart(trajectory));
    METAEKF_ASSIGN_OR_RETURN(const nssm::Prediction prediction,
                             nssm::Predict(model().bundle, trajectory, mode_));
    const Eigen::Index width =
        std::max<Eigen::Index>(1, prediction.outputs.rows() + prediction.states.rows());
    const Eigen::Index rows = std::max<Eigen::Index>(1, kValuesPerResponse / width);
    for (Eigen::Index first = 0; first < trajectory.length(); first += rows) {
      const Eigen::Index count = std::min(rows, trajectory.length() - first);
      Response response;
      response.set_trajectory(trajectory.name);
      response.set_first_sample(static_cast<uint64_t>(first));
      response.set_sample_count(static_cast<uint32_t>(count));
      Append(prediction.outputs, first, count, response.mutable_outputs());
      Append(prediction.states, first, count, response.mutable_states());
      response.set_warmup_samples(static_cast<uint32_t>(prediction.warmup));
      sink.Send(std::move(response));
    }
    return absl::OkStatus();
  }

  /// A free run has nothing but the start to go by, so all of that must be measured.
  absl::Status CheckStart(const data::Trajectory& trajectory) const {
    const nssm::ModelSpec& spec = model().bundle.model.spec();
    const Eigen::MatrixXd& measured = spec.is_case_one() ? trajectory.outputs : trajectory.states;
    const Eigen::Index needed = std::min<Eigen::Index>(spec.warmup(), measured.cols());
    if (mode_ != nssm::PredictionMode::kSimulate || measured.leftCols(needed).allFinite()) {
      return absl::OkStatus();
    }
    return FieldViolation(spec.is_case_one() ? "samples.outputs" : "samples.states",
                          absl::StrCat("trajectory '", trajectory.name, "': a free run needs the ",
                                       "first ", spec.warmup(), " measured"));
  }

  nssm::PredictionMode mode_ = nssm::PredictionMode::kOneStep;
};

}  // namespace

std::unique_ptr<StreamHandler<Request, Response>> Predict(CallContext context) {
  return std::make_unique<PredictCall>(std::move(context), "Predict");
}

}  // namespace metaekf::server
