#pragma once

#include <grpcpp/grpcpp.h>

#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "client/src/convert.h"
#include "client/src/names.h"
#include "client/src/status.h"
#include "metaekf/client.h"
#include "metaekf/v1/adaptation.grpc.pb.h"
#include "metaekf/v1/admin.grpc.pb.h"
#include "metaekf/v1/estimation.grpc.pb.h"
#include "metaekf/v1/model.grpc.pb.h"
#include "metaekf/v1/prediction.grpc.pb.h"
#include "metaekf/v1/server_info.grpc.pb.h"
#include "metaekf/v1/smoothing.grpc.pb.h"
#include "metaekf/v1/training.grpc.pb.h"

/// Assigns what `expression` (a client::Result) holds to `target`, or returns its error.
#define METAEKF_CLIENT_ASSIGN_OR_RETURN(target, expression)                                \
  METAEKF_CLIENT_ASSIGN_OR_RETURN_IMPL_(METAEKF_CLIENT_CONCAT_(result_, __LINE__), target, \
                                        expression)
#define METAEKF_CLIENT_CONCAT_INNER_(a, b) a##b
#define METAEKF_CLIENT_CONCAT_(a, b) METAEKF_CLIENT_CONCAT_INNER_(a, b)
#define METAEKF_CLIENT_ASSIGN_OR_RETURN_IMPL_(result, target, expression) \
  auto result = (expression);                                             \
  if (!result.ok()) return result.status();                               \
  target = std::move(*result)

namespace metaekf::client {

/// The channel, the services on it, and the shapes that calls come in.
struct Client::Impl {
  explicit Impl(const Options& client_options);

  /// `status`, of a call that was not cancelled here, in the library's terms; errors of the connection say what to look at.
  Status Translate(const grpc::Status& status) const;

  /// One request, one response, within the time limit; what only asks is asked again if its connection was lost, as that of a
  /// server that was restarted a moment ago.
  template <typename Service, typename Request, typename Response>
  Status Call(const std::unique_ptr<Service>& service,
              grpc::Status (Service::*method)(grpc::ClientContext*, const Request&, Response*),
              const Request& request, Response* response) const {
    const auto call = [&] {
      Connect();
      grpc::ClientContext context;
      SetDeadline(context);
      Authorise(context);
      return Translate((service.get()->*method)(&context, request, response));
    };
    const std::string& name = Request::descriptor()->name();
    const bool asks = name.rfind("Get", 0) == 0 || name.rfind("List", 0) == 0;
    const Status status = call();
    return status.reason == "CONNECTION_LOST" && asks ? call() : status;
  }

  /// All pages of a list. `items` gives the repeated field of a page.
  template <typename Item, typename Service, typename Request, typename Response, typename WireItem>
  Result<std::vector<Item>> List(
      const std::unique_ptr<Service>& service,
      grpc::Status (Service::*method)(grpc::ClientContext*, const Request&, Response*),
      Request request,
      const google::protobuf::RepeatedPtrField<WireItem>& (Response::*items)() const) const {
    std::vector<Item> all;
    request.set_page_size(1000);
    do {
      Response page;
      METAEKF_CLIENT_RETURN_IF_ERROR(Call(service, method, request, &page));
      for (const auto& item : (page.*items)()) all.push_back(FromProto(item));
      request.set_page_token(page.next_page_token());
    } while (!request.page_token().empty());
    return all;
  }

  /// Sends with `write` (in a thread of its own, since each side may wait for the other to read)
  /// and hands each response to `on_response`, which cancels the call with false.
  template <typename Request, typename Response>
  Status Exchange(grpc::ClientContext& context, grpc::ClientReaderWriter<Request, Response>& stream,
                  const std::function<Status(grpc::ClientReaderWriter<Request, Response>&)>& write,
                  const std::function<bool(const Response&)>& on_response) const {
    Status written;
    std::thread writer([&] {
      written = write(stream);
      if (written.ok()) {
        stream.WritesDone();
      } else {
        context.TryCancel();
      }
    });
    Response response;
    bool stopped = false;
    while (stream.Read(&response)) {
      stopped = stopped || !on_response(response);
      if (stopped) context.TryCancel();
    }
    writer.join();
    const grpc::Status status = stream.Finish();
    if (!written.ok()) return written;
    return stopped ? FromGrpc(status) : Translate(status);
  }

  void SetDeadline(grpc::ClientContext& context) const;
  /// Shows who calls. For every call; Call does it.
  void Authorise(grpc::ClientContext& context) const;

  /// Finds out whether a connection that was long unused is still there, and gives the channel a second chance to connect
  /// where the first failed for no good reason; whatever comes of it, the next call says. To be called before every call:
  /// gRPC 1.51 takes some connections in the making for failed, for it looks at the errno of connect() after other calls.
  void Connect() const;

  Options options;
  std::shared_ptr<grpc::Channel> channel;
  mutable std::atomic<std::chrono::steady_clock::duration> last_call{};  // since the epoch
  std::unique_ptr<v1::ServerService::Stub> server;
  std::unique_ptr<v1::ModelService::Stub> models;
  std::unique_ptr<v1::TrainingService::Stub> training;
  std::unique_ptr<v1::AdaptationService::Stub> adaptations;
  std::unique_ptr<v1::PredictionService::Stub> predictions;
  std::unique_ptr<v1::EstimationService::Stub> estimation;
  std::unique_ptr<v1::SmoothingService::Stub> smoothing;
  std::unique_ptr<v1::AdminService::Stub> admin;
};

}  // namespace metaekf::client
