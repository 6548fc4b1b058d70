#include "server/status/grpc_status.h"

#include <gmock/gmock.h>
#include <google/rpc/error_details.pb.h>
#include <google/rpc/status.pb.h>
#include <gtest/gtest.h>

#include <optional>

#include "server/status/details.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

/// The detail of type T that `status` carries to a client.
template <class T>
std::optional<T> Detail(const grpc::Status& status) {
  google::rpc::Status rich;
  EXPECT_TRUE(rich.ParseFromString(status.error_details()));
  for (const auto& any : rich.details()) {
    if (T detail; any.UnpackTo(&detail)) return detail;
  }
  return std::nullopt;
}

TEST(GrpcStatusTest, OkIsOk) { EXPECT_TRUE(ToGrpcStatus(absl::OkStatus()).ok()); }

TEST(GrpcStatusTest, EveryCodeKeepsItsNumber) {
  for (int code = 1; code <= 16; ++code) {
    const auto status = ToGrpcStatus(absl::Status(static_cast<absl::StatusCode>(code), "why"));
    EXPECT_EQ(static_cast<int>(status.error_code()), code);
    google::rpc::Status rich;
    ASSERT_TRUE(rich.ParseFromString(status.error_details()));
    EXPECT_EQ(rich.code(), code);
    EXPECT_EQ(rich.message(), status.error_message());
  }
}

// The bytes by hand, from the public definitions: Status {1: code, 2: message, 3: Any {1: type_url,
// 2: value}}, BadRequest {1: FieldViolation {1: field, 2: description}}.
TEST(GrpcStatusTest, DetailsAreWireCompatibleWithThePublicMessages) {
  const std::string violation = std::string("\x0A\x01") + "f" + "\x12\x03" + "bad";
  const std::string bad_request = std::string("\x0A\x08") + violation;
  const std::string url = "type.googleapis.com/google.rpc.BadRequest";
  const std::string any = std::string("\x0A\x29") + url + "\x12\x0A" + bad_request;
  const std::string expected = std::string("\x08\x03\x12\x06") + "f: bad" + "\x1A\x37" + any;
  EXPECT_EQ(ToGrpcStatus(FieldViolation("f", "bad")).error_details(), expected);
}

TEST(GrpcStatusTest, FieldViolationsArriveWithPathAndDescription) {
  const auto status = ToGrpcStatus(FieldViolations({{"a.b", "is 3, must be 2"}, {"c", "missing"}}));
  EXPECT_EQ(status.error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  EXPECT_EQ(status.error_message(), "a.b: is 3, must be 2; c: missing");
  const auto detail = Detail<google::rpc::BadRequest>(status);
  ASSERT_TRUE(detail.has_value());
  ASSERT_EQ(detail->field_violations_size(), 2);
  EXPECT_EQ(detail->field_violations(1).field(), "c");
  EXPECT_EQ(detail->field_violations(1).description(), "missing");
}

TEST(GrpcStatusTest, NoViolationsAreOk) { EXPECT_TRUE(FieldViolations({}).ok()); }

TEST(GrpcStatusTest, ReasonRetryAndResourceArriveTogether) {
  auto error = WithReason(absl::OutOfRangeError("gap"), "SEQUENCE_GAP", {{"expected_seq", "7"}});
  error = WithRetryDelay(error, absl::Milliseconds(1500));
  error = WithResource(error, "session", "sessions/s1");
  const auto status = ToGrpcStatus(error);
  EXPECT_EQ(status.error_code(), grpc::StatusCode::OUT_OF_RANGE);

  const auto reason = Detail<google::rpc::ErrorInfo>(status);
  ASSERT_TRUE(reason.has_value());
  EXPECT_EQ(reason->reason(), "SEQUENCE_GAP");
  EXPECT_EQ(reason->domain(), "metaekf");
  EXPECT_EQ(reason->metadata().at("expected_seq"), "7");
  const auto retry = Detail<google::rpc::RetryInfo>(status);
  ASSERT_TRUE(retry.has_value());
  EXPECT_EQ(retry->retry_delay().seconds(), 1);
  EXPECT_EQ(retry->retry_delay().nanos(), 500'000'000);
  const auto resource = Detail<google::rpc::ResourceInfo>(status);
  ASSERT_TRUE(resource.has_value());
  EXPECT_EQ(resource->resource_type(), "session");
  EXPECT_EQ(resource->resource_name(), "sessions/s1");
}

TEST(GrpcStatusTest, NothingInternalLeaves) {
  for (const auto& error : {absl::InternalError("assert in /src/a.cc"), absl::UnknownError("x")}) {
    EXPECT_EQ(ToGrpcStatus(error).error_message(), "internal error; the server's log says more");
  }
  const auto lost = ToGrpcStatus(absl::DataLossError("model a version 1: /data/blobs/ab damaged"));
  EXPECT_EQ(lost.error_message(), "model a version 1: [path] damaged");
  const auto wrong = ToGrpcStatus(FieldViolation("f", "no such file /etc/passwd"));
  EXPECT_THAT(wrong.error_message(), Not(HasSubstr("passwd")));
  EXPECT_THAT(wrong.error_details(), Not(HasSubstr("passwd")));
}

TEST(GrpcStatusTest, PayloadsThatAreNotDetailsStayInside) {
  absl::Status error = absl::AbortedError("x");
  error.SetPayload("metaekf/secret", absl::Cord("hidden"));
  EXPECT_THAT(ToGrpcStatus(error).error_details(), Not(HasSubstr("hidden")));
}

// 8 KiB is gRPC's default limit of a client's metadata; the encodings of HTTP/2 trailers make a
// message up to three times as long and binary details 4/3 times.
TEST(GrpcStatusTest, TrailersStaySmall) {
  std::vector<Violation> many;
  for (int i = 0; i < 1000; ++i) many.push_back({std::string(999, 'f'), std::string(999, 'x')});
  const auto status = ToGrpcStatus(WithReason(FieldViolations(many), "MANY", {}));
  EXPECT_LE(status.error_details().size() * 4 / 3 + status.error_message().size() * 3, 8192 - 1024);
  EXPECT_TRUE(Detail<google::rpc::BadRequest>(status).has_value());
  EXPECT_TRUE(Detail<google::rpc::ErrorInfo>(status).has_value());
}

TEST(GrpcStatusTest, DetailsThatDoNotFitAreLeftOut) {
  const auto status = ToGrpcStatus(
      WithReason(FieldViolation("f", "bad"), "HUGE", {{"key", std::string(4000, 'x')}}));
  EXPECT_TRUE(Detail<google::rpc::BadRequest>(status).has_value());
  EXPECT_FALSE(Detail<google::rpc::ErrorInfo>(status).has_value());
}

TEST(GrpcStatusTest, SaysHowManyViolationsAreNotSpeltOut) {
  const auto status = ToGrpcStatus(FieldViolations(std::vector<Violation>(12, {"f", "x"})));
  EXPECT_THAT(status.error_message(), HasSubstr("; and 4 more"));
  EXPECT_EQ(Detail<google::rpc::BadRequest>(status)->field_violations_size(), 8);
}

}  // namespace
}  // namespace metaekf::server
