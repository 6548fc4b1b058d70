#pragma once

#include <grpcpp/grpcpp.h>

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "echo.grpc.pb.h"
#include "metaekf/client.h"

namespace metaekf::benchmark {

/// Ends the program.
[[noreturn]] void Fail(const std::string& what);
void Check(const client::Status& status, const std::string& what);

/// A message there and one back, at most `in_flight` of them at a time. @return messages per second.
/// @param send  the next message. @param receive  waits for one.
double MessagesPerSecond(int in_flight, double seconds, const std::function<void()>& send, const std::function<void()>& receive);

/// @return times of `count` round trips at 100 Hz, in µs.
std::vector<double> LatenciesAt100Hz(int count, const std::function<void()>& round_trip);

/// Of messages on the wire, with so many samples of the van der Pol model.
struct Sizes {
  size_t request, response;
};
Sizes SizesOf(int samples);

/// A stream of the echo server with messages of given sizes.
class EchoStream {
 public:
  EchoStream(const std::string& address, const Sizes& sizes);
  EchoStream(const std::shared_ptr<grpc::Channel>& channel, const Sizes& sizes);
  ~EchoStream();
  void Send();
  void Receive();

 private:
  std::unique_ptr<Echo::Stub> stub_;
  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<EchoRequest, EchoReply>> stream_;
  EchoRequest request_;
  EchoReply reply_;
};

/// A connection that no other channel shares.
std::shared_ptr<grpc::Channel> ConnectionTo(const std::string& address);

/// A stream of estimates of a van der Pol model.
class EstimateStream {
 public:
  EstimateStream(client::Client* client, int samples_per_message, const std::string& model = "van-der-pol");
  void Send();
  void Receive();

 private:
  std::unique_ptr<client::EstimationSession> session_;
  client::SampleBatch samples_;
  double time_ = 0;
};

}  // namespace metaekf::benchmark
