// What operators see: metrics on their port and by `metaekf status`, health by service, names of requests.

#include <arpa/inet.h>
#include <sys/socket.h>
#include <unistd.h>

#include <grpcpp/grpcpp.h>

#include <nlohmann/json.hpp>

#include "metaekf/client.h"
#include "metaekf/v1/model.grpc.pb.h"
#include "tests/client/run.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using metaekf::testing::Outcome;
using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

class StatusTest : public ServerTest {
 protected:
  StatusTest() { options_.metrics_listen = "127.0.0.1:0"; }

  /// The answer to a request, whole.
  std::string Get(const std::string& path) {
    const int connection = socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in address{.sin_family = AF_INET, .sin_port = htons(static_cast<uint16_t>(server_->metrics_port()))};
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    EXPECT_EQ(connect(connection, reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
    const std::string request = "GET " + path + " HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    EXPECT_EQ(write(connection, request.data(), request.size()), static_cast<ssize_t>(request.size()));
    std::string answer;
    char buffer[4096];
    const auto complete = [&] {
      const size_t body = answer.find("\r\n\r\n"), length = answer.find("Content-Length: ");
      return body != std::string::npos && length < body &&
             answer.size() >= body + 4 + static_cast<size_t>(std::atol(answer.c_str() + length + 16));
    };
    for (ssize_t n; !complete() && (n = read(connection, buffer, sizeof(buffer))) > 0;) {
      answer.append(buffer, static_cast<size_t>(n));
    }
    close(connection);
    return answer;
  }

  void EstimateSamples(int samples) {
    client::Client client({.server = server_->address()});
    client::EstimationOptions options;
    options.target.model = "robot";
    auto opened = client.OpenEstimation(options);
    ASSERT_TRUE(opened.ok()) << opened.status().message;
    session_ = std::move(*opened);
    for (int i = 0; i < samples; ++i) {
      ASSERT_TRUE(session_->Send({.samples = 1, .inputs = {0.5}, .outputs = {0.1}}).ok());
      ASSERT_TRUE(session_->Receive().ok());
    }
  }

  std::unique_ptr<client::EstimationSession> session_;
};

TEST_F(StatusTest, PrometheusReadsWhatHappened) {
  Import("robot", TinyBundle());
  EstimateSamples(5);
  const std::string answer = Get("/metrics");
  for (const char* line :
       {"metaekf_samples_total{tenant=\"default\"} 5", "metaekf_streaming_sessions{tenant=\"default\"} 1",
        "metaekf_sessions{tenant=\"default\"} 1", "metaekf_model_versions{tenant=\"default\"} 1",
        "metaekf_estimate_seconds_count 5", "metaekf_resident_models 1", "metaekf_queued_calls{threads=\"io\"} 0",
        "metaekf_calls_total{code=\"OK\",method=\"ImportModelVersion\"} 1", "process_resident_memory_bytes "}) {
    EXPECT_THAT(answer, HasSubstr(line));
  }
  EXPECT_THAT(answer, Not(HasSubstr("local")));  // no client's identity
}

TEST_F(StatusTest, TheTerminalShowsTheSame) {
  Import("robot", TinyBundle());
  EstimateSamples(3);
  const Outcome outcome = metaekf::testing::RunMetaekf({"status", "--server", server_->address(), "--output", "json"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto rows = nlohmann::json::parse(outcome.out);
  std::map<std::string, double> values;
  for (const auto& row : rows) {
    if (row["value"].is_number()) {
      values[row["metric"].get<std::string>() + " " + row["of"].get<std::string>() + row["what"].get<std::string>()] = row["value"];
    }
  }
  EXPECT_EQ(values["metaekf_samples_total tenant=default"], 3);
  EXPECT_EQ(values["metaekf_estimate_seconds count"], 3);
  EXPECT_GT(values["metaekf_estimate_seconds 99 %"], 0);
  const std::string answer = Get("/metrics");
  for (const auto& row : rows) EXPECT_THAT(answer, HasSubstr(row["metric"].get<std::string>()));
}

TEST_F(StatusTest, APortThatIsTakenStopsTheStart) {
  ServerOptions options = options_;
  store::TempDirectory other;
  options.data_directory = other.path();
  options.metrics_listen = absl::StrCat("127.0.0.1:", server_->metrics_port());
  const auto second = Server::Start(options);
  EXPECT_EQ(second.status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(second.status().message()), HasSubstr("metrics_listen"));
}

TEST_F(StatusTest, ARequestKeepsItsNameOrGetsOne) {
  const auto stub = v1::ModelService::NewStub(
      grpc::CreateChannel(server_->address(), grpc::InsecureChannelCredentials()));
  const auto id_of = [&](const std::string& sent) {
    grpc::ClientContext context;
    if (!sent.empty()) context.AddMetadata("x-request-id", sent);
    v1::Model model;
    v1::GetModelRequest request;
    request.set_name("models/gone");
    EXPECT_EQ(stub->GetModel(&context, request, &model).error_code(), grpc::StatusCode::NOT_FOUND);
    const auto found = context.GetServerTrailingMetadata().find("x-request-id");
    return found == context.GetServerTrailingMetadata().end() ? std::string()
                                                              : std::string(found->second.data(), found->second.size());
  };
  EXPECT_EQ(id_of("press-7.42"), "press-7.42");
  const std::string given = id_of("");
  EXPECT_NE(given, "");
  EXPECT_NE(id_of(""), given);
  // What does not belong into a log is not taken over.
  EXPECT_THAT(id_of("a b\"c"), Not(HasSubstr("a b")));
  EXPECT_THAT(id_of(std::string(65, 'x')), Not(HasSubstr("xx")));
}

TEST_F(StatusTest, HealthIsToldByService) {
  for (const char* service : {"", "metaekf.v1.EstimationService", "metaekf.v1.TrainingService"}) {
    EXPECT_EQ(client_->Health(service), "SERVING") << service;
  }
  EXPECT_EQ(client_->Health("metaekf.v1.NoService"), "NOT_FOUND");
}

}  // namespace
}  // namespace metaekf::server
