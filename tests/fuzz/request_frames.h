#pragma once

#include <google/protobuf/descriptor.h>

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "metaekf/v1/adaptation.pb.h"
#include "metaekf/v1/admin.pb.h"
#include "metaekf/v1/estimation.pb.h"
#include "metaekf/v1/model.pb.h"
#include "metaekf/v1/prediction.pb.h"
#include "metaekf/v1/server_info.pb.h"
#include "metaekf/v1/smoothing.pb.h"
#include "metaekf/v1/training.pb.h"

/// How a call is written as bytes: the number of its method, then the messages, each after its length in two bytes.
namespace metaekf::testing {

/// Every method of the wire, "/metaekf.v1.ModelService/GetModel", in an order that stays while none is added.
inline std::vector<std::string> AllMethods() {
  std::vector<std::string> methods;
  for (const google::protobuf::Descriptor* message :
       {v1::AdaptRequest::descriptor(), v1::CreateTokenRequest::descriptor(), v1::EstimateRequest::descriptor(),
        v1::ListModelsRequest::descriptor(), v1::PredictRequest::descriptor(), v1::GetServerInfoRequest::descriptor(),
        v1::SmoothRequest::descriptor(), v1::GetJobRequest::descriptor()}) {
    const google::protobuf::FileDescriptor* file = message->file();
    for (int s = 0; s < file->service_count(); ++s) {
      const auto* service = file->service(s);
      for (int m = 0; m < service->method_count(); ++m) {
        methods.push_back("/" + service->full_name() + "/" + service->method(m)->name());
      }
    }
  }
  return methods;
}

inline std::string ToFrames(size_t method, const std::vector<std::string>& messages) {
  std::string bytes(1, static_cast<char>(method));
  for (const std::string& message : messages) {
    bytes.push_back(static_cast<char>(message.size() & 0xff));
    bytes.push_back(static_cast<char>(message.size() >> 8));
    bytes += message;
  }
  return bytes;
}

/// The messages after the first byte; the last is as long as there are bytes.
inline std::vector<std::string> ToMessages(std::string_view bytes) {
  std::vector<std::string> messages;
  bytes.remove_prefix(1);
  while (bytes.size() >= 2) {
    const size_t size = static_cast<uint8_t>(bytes[0]) | size_t{static_cast<uint8_t>(bytes[1])} << 8;
    bytes.remove_prefix(2);
    messages.emplace_back(bytes.substr(0, size));
    bytes.remove_prefix(messages.back().size());
  }
  return messages;
}

}  // namespace metaekf::testing
