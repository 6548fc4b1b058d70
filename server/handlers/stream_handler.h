#pragma once

#include "absl/status/status.h"
#include "absl/status/statusor.h"

/// What a streaming call does, without gRPC: the calls (bidi_call.h, upload_call.h,
/// download_call.h) bring messages to it.
namespace metaekf::server {

/// Where a handler sends its responses.
template <class Response>
class ResponseSink {
 public:
  virtual ~ResponseSink() = default;
  /// Queues a response; it leaves as fast as the client reads.
  virtual void Send(Response response) = 0;
  /// Nothing is queued or on its way: progress that would wait can be left out.
  virtual bool idle() = 0;
  /// Nobody waits for the result any more: stop, and change nothing.
  virtual bool cancelled() = 0;
};

/// Handles the requests of one call, one at a time, on a background executor. The next request is
/// not read until all responses to the one before are on their way. An error ends the call.
template <class Request, class Response>
class StreamHandler {
 public:
  virtual ~StreamHandler() = default;
  virtual absl::Status OnRequest(Request& request, ResponseSink<Response>& sink) = 0;
  /// The client has sent everything.
  virtual absl::Status OnEnd(ResponseSink<Response>& sink) = 0;
};

/// Makes the responses of a call that has one request.
template <class Response>
class ResponseSource {
 public:
  virtual ~ResponseSource() = default;
  /// Once, on a background executor.
  virtual absl::Status Open() = 0;
  /// The next response; false: there are no more. On a background executor, too.
  virtual absl::StatusOr<bool> Next(Response* response) = 0;
};

}  // namespace metaekf::server
