#pragma once

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/nssm/model_file.h"
#include "server/server.h"
#include "server/store/sha256.h"
#include "tests/server/store/test_store.h"
#include "tests/server/support/client.h"

namespace metaekf::server {

/// The messages of an import in chunks of `chunk_bytes`.
inline std::vector<v1::ImportModelVersionRequest> ImportRequests(const std::string& model,
                                                                 const std::string& file,
                                                                 size_t chunk_bytes = 1 << 20) {
  std::vector<v1::ImportModelVersionRequest> requests(1);
  requests[0].mutable_header()->set_parent("models/" + model);
  requests[0].mutable_header()->set_size_bytes(file.size());
  requests[0].mutable_header()->set_sha256(store::Sha256Hex(file));
  for (size_t begin = 0; begin < file.size(); begin += chunk_bytes) {
    requests.emplace_back().set_chunk(file.substr(begin, chunk_bytes));
  }
  return requests;
}

/// A request that has a name and nothing else.
template <class Request>
Request Named(const std::string& name) {
  Request request;
  request.set_name(name);
  return request;
}

/// A server in this process, with a data directory of its own, and a client of it.
class ServerTest : public ::testing::Test {
 protected:
  void SetUp() override {
    options_.data_directory = directory_.path();
    options_.listen = "127.0.0.1:0";
    options_.drain_timeout = absl::Seconds(5);
    options_.training.worker_binary = METAEKFD_BINARY;
    options_.training.checkpoint_period = absl::Milliseconds(20);
    options_.training.threads_per_job = 1;
    Start();
  }

  void Start() {
    auto server = Server::Start(options_);
    ASSERT_TRUE(server.ok()) << server.status();
    server_ = *std::move(server);
    client_.emplace(server_->address());
  }
  void Stop() { server_.reset(); }

  v1::ModelVersion Import(const std::string& model, const nssm::Bundle& bundle) {
    const auto reply = client_->Import(ImportRequests(model, nssm::WriteModelFile(bundle)));
    EXPECT_TRUE(reply.ok()) << reply;
    return reply.value;
  }

  store::TempDirectory directory_;
  ServerOptions options_;
  std::unique_ptr<Server> server_;
  std::optional<Client> client_;
};

/// That a reply is an error of `code` whose violations are of exactly `fields`.
template <class T>
void ExpectError(const Reply<T>& reply, absl::StatusCode code,
                 const std::vector<std::string>& fields = {}) {
  EXPECT_EQ(reply.code, code) << reply;
  EXPECT_EQ(reply.fields, fields) << reply;
}

}  // namespace metaekf::server
