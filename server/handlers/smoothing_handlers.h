#pragma once

#include <memory>

#include "metaekf/v1/smoothing.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"

namespace metaekf::server {

/// SmoothingService.Smooth, as smoothing.proto describes it.
std::unique_ptr<StreamHandler<v1::SmoothRequest, v1::SmoothResponse>> Smooth(CallContext context);

}  // namespace metaekf::server
