// `metaekf admin` and `metaekfd create-token` with a server that wants tokens.

#include <nlohmann/json.hpp>

#include "tests/client/run.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using metaekf::testing::Outcome;
using metaekf::testing::TempFile;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Not;

class AdminTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Stop();
    options_.security.require_tokens = true;
    admin_ = TempFile("admin", FirstToken());
    Start();
  }

  /// As the operator makes it, before the server runs.
  std::string FirstToken() {
    auto process = WorkerProcess::Start(METAEKFD_BINARY, {"create-token", "--data-dir", directory_.path(), "--scope",
                                                          "admin", "--note", "the operator"});
    EXPECT_TRUE(process.ok());
    const auto secret = process->ReadLine(absl::Seconds(30), /*wake_fd=*/-1);
    EXPECT_EQ(process->Wait().code, 0);
    return secret.value_or("") + "\n";
  }

  /// @param token_file  empty: none is shown.
  Outcome Run(const std::string& token_file, std::vector<std::string> arguments) {
    arguments.insert(arguments.end(), {"--server", server_->address()});
    if (!token_file.empty()) arguments.insert(arguments.end(), {"--token-file", token_file});
    return metaekf::testing::RunMetaekf(arguments);
  }
  nlohmann::json Json(const Outcome& outcome) {
    EXPECT_EQ(outcome.status, 0) << outcome.err;
    return nlohmann::json::parse(outcome.out, nullptr, /*allow_exceptions=*/false);
  }
  nlohmann::json Create(const std::string& tenant, const std::string& scope) {
    return Json(Run(admin_, {"admin", "tokens", "create", "--tenant", tenant, "--scope", scope, "--days", "1.5",
                             "--note", "a press", "--output", "json"}));
  }

  std::string admin_;
};

TEST_F(AdminTest, WhoShowsNoTokenIsToldHowTo) {
  const Outcome outcome = Run("", {"models", "list"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("--token-file FILE, or METAEKF_TOKEN"));
  EXPECT_EQ(Run(admin_, {"models", "list"}).status, 0);
}

TEST_F(AdminTest, TokensAreMadeListedAndRevoked) {
  const nlohmann::json made = Create("plant", "write");
  EXPECT_EQ(made["tenant"], "plant");
  EXPECT_EQ(made["scope"], "write");
  EXPECT_EQ(made["note"], "a press");
  EXPECT_NE(made["expire_time"], nullptr);
  EXPECT_EQ(made["revoke_time"], nullptr);
  const std::string press = TempFile("press", made["secret"].get<std::string>());
  EXPECT_EQ(Run(press, {"models", "list"}).status, 0);
  EXPECT_THAT(Run(press, {"admin", "tokens", "list"}).err, HasSubstr("needs scope admin"));

  const Outcome listed = Run(admin_, {"admin", "tokens", "list", "--output", "json"});
  EXPECT_THAT(listed.out, Not(HasSubstr("metaekf_")));  // no secret
  const nlohmann::json tokens = Json(listed);
  ASSERT_EQ(tokens.size(), 2u) << listed.out;
  EXPECT_EQ(tokens[0]["note"], "the operator");
  EXPECT_EQ(tokens[1]["id"], made["id"]);

  const nlohmann::json revoked =
      Json(Run(admin_, {"admin", "tokens", "revoke", made["id"].get<std::string>(), "--output", "json"}));
  EXPECT_NE(revoked["revoke_time"], nullptr);
  EXPECT_THAT(Run(press, {"models", "list"}).err, HasSubstr("has been revoked"));
  EXPECT_THAT(Run(admin_, {"admin", "tokens", "revoke", "t77"}).err, HasSubstr("no token 't77'"));
}

TEST_F(AdminTest, EveryCommandOfTheClientShowsTheToken) {
  const std::string press = TempFile("press", Create("plant", "write")["secret"].get<std::string>());
  const std::string model = TempFile("m.safetensors", nssm::WriteModelFile(TinyBundle()));
  std::string rows = "u1,y1\n";
  for (int t = 0; t < 20; ++t) absl::StrAppend(&rows, 0.1 * (t % 5), ",", 0.05 * (t % 7), "\n");
  const std::string data = TempFile("d.csv", rows);
  const std::vector<std::vector<std::string>> commands = {
      {"models", "import", "robot", model},
      {"models", "export", "robot", metaekf::testing::TempPath("out.safetensors")},
      {"adapt", "--model", "robot", "--context", data, "--name", "mine"},
      {"predict", "--model", "robot", "--data", data, "--mode", "simulate"},
      {"estimate", "--model", "robot", "--data", data},
      {"doctor"}};
  for (const auto& command : commands) {
    const Outcome outcome = Run(press, command);
    EXPECT_EQ(outcome.status, 0) << command[0] << ": " << outcome.err << outcome.out;
  }
}

TEST_F(AdminTest, WhoDidWhatIsTold) {
  const nlohmann::json made = Create("plant", "write");
  const std::string press = TempFile("press", made["secret"].get<std::string>());
  const std::string model = TempFile("m.safetensors", nssm::WriteModelFile(TinyBundle()));
  ASSERT_EQ(Run(press, {"models", "import", "robot", model}).status, 0);
  const nlohmann::json all = Json(Run(admin_, {"admin", "audit", "--output", "json"}));
  ASSERT_EQ(all.size(), 3u) << all;
  EXPECT_EQ(all[0]["tenant"], "plant");
  EXPECT_EQ(all[0]["identity"], "token " + made["id"].get<std::string>());
  EXPECT_THAT(all[0]["resource"].get<std::string>(), HasSubstr("models/robot"));
  EXPECT_EQ(all[1]["action"], "CreateToken");
  EXPECT_EQ(all[2]["identity"], "metaekfd create-token");
  EXPECT_EQ(Json(Run(admin_, {"admin", "audit", "--tenant", "plant", "--output", "json"})).size(), 1u);
  EXPECT_EQ(Json(Run(admin_, {"admin", "audit", "--last", "2", "--output", "json"})).size(), 2u);
}

TEST_F(AdminTest, WhatServedWhomIsTold) {
  const std::string press = TempFile("press", Create("plant", "write")["secret"].get<std::string>());
  const std::string model = TempFile("m.safetensors", nssm::WriteModelFile(TinyStateBundle()));
  const std::string data = TempFile("d.csv", "u1,y1,x1,x2\n0,0,0,0\n0,0,0,0\n0,0,0,0\n");
  const std::vector<std::vector<std::string>> commands = {
      {"models", "import", "robot", model},
      {"models", "import", "robot", model},
      {"predict", "--model", "robot@1", "--data", data, "--mode", "simulate"},
      {"estimate", "--model", "robot", "--data", data},
      {"estimate", "--model", "robot", "--data", data, "--smooth"},
      {"models", "export", "robot@1", metaekf::testing::TempPath("out.safetensors")}};
  for (const auto& command : commands) {
    const Outcome outcome = Run(press, command);
    ASSERT_EQ(outcome.status, 0) << command[0] << ": " << outcome.err << outcome.out;
  }
  std::vector<std::string> told;
  for (const auto& entry : Json(Run(admin_, {"admin", "audit", "--tenant", "plant", "--output", "json"}))) {
    told.push_back(entry["action"].get<std::string>() + " " + entry["resource"].get<std::string>() + " " + entry["detail"].get<std::string>());
  }
  told.resize(4);  // the newest
  EXPECT_THAT(told, ElementsAre("ExportModelVersion models/robot/versions/1 ", "Smooth models/robot/versions/2 ",
                                "OpenSession sessions/1 models/robot/versions/2", "Predict models/robot/versions/1 "));
}

TEST_F(AdminTest, MistakesAreNamed) {
  EXPECT_THAT(Run("/no/such/token", {"models", "list"}).err, HasSubstr("/no/such/token"));
  const Outcome empty = Run(TempFile("empty", "\n"), {"models", "list"});
  EXPECT_EQ(empty.status, 2);
  EXPECT_THAT(empty.err, HasSubstr("holds no token"));
  EXPECT_EQ(Run(admin_, {"admin", "tokens", "create", "--scope", "king"}).status, 2);
  EXPECT_EQ(Run(admin_, {"admin", "tokens", "create", "--scope", "read", "--days", "-1"}).status, 2);
  EXPECT_THAT(Run(admin_, {"admin", "tokens", "create", "--scope", "read", "--tenant", "A B"}).err,
              HasSubstr("tenant 'A B'"));
  // Not through a network for everyone to read.
  const Outcome open = metaekf::testing::RunMetaekf(
      {"models", "list", "--server", "127.0.0.1.example:1", "--token-file", admin_});
  EXPECT_EQ(open.status, 2);
  EXPECT_THAT(open.err, HasSubstr("unencrypted"));
  EXPECT_EQ(metaekf::testing::RunMetaekf({"models", "list", "--tls-cert", admin_}).status, 2);
}

}  // namespace
}  // namespace metaekf::server
