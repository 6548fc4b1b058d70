#pragma once

#include <memory>

#include "server/handlers/service_context.h"

namespace grpc {
class Service;
}

/// The gRPC services over the handlers of this folder. `context` outlives what is made.
namespace metaekf::server {

std::unique_ptr<grpc::Service> MakeAdminService(const ServiceContext& context);
std::unique_ptr<grpc::Service> MakeModelService(const ServiceContext& context);
std::unique_ptr<grpc::Service> MakeTrainingService(const ServiceContext& context);
std::unique_ptr<grpc::Service> MakeAdaptationService(const ServiceContext& context);
std::unique_ptr<grpc::Service> MakePredictionService(const ServiceContext& context);
std::unique_ptr<grpc::Service> MakeSmoothingService(const ServiceContext& context);
std::unique_ptr<grpc::Service> MakeServerService(const ServiceContext& context);

}  // namespace metaekf::server
