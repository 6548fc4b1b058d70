#pragma once

#include <memory>

#include "metaekf/v1/prediction.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"

namespace metaekf::server {

/// PredictionService.Predict, as prediction.proto describes it. A trajectory is predicted when it
/// is complete.
std::unique_ptr<StreamHandler<v1::PredictRequest, v1::PredictResponse>> Predict(
    CallContext context);

}  // namespace metaekf::server
