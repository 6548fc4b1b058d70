// `metaekf admin backup | verify | restore`.

#include <filesystem>
#include <thread>

#include <nlohmann/json.hpp>

#include "metaekf/client.h"
#include "tests/client/run.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

namespace fs = std::filesystem;
using metaekf::testing::Outcome;
using metaekf::testing::RunMetaekf;
using ::testing::AllOf;
using ::testing::HasSubstr;

class BackupTest : public ServerTest {
 protected:
  BackupTest() { fs::create_directory(Path("")); }
  std::string Path(const std::string& name) { return elsewhere_.path() + "/files/" + name; }

  Outcome Admin(std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), "admin");
    arguments.insert(arguments.end(), {"--server", server_->address(), "--output", "json"});
    return RunMetaekf(arguments);
  }
  void Backup(const std::string& name) {
    const Outcome outcome = Admin({"backup", Path(name)});
    ASSERT_EQ(outcome.status, 0) << outcome.err;
  }
  /// Serves the restored directory instead.
  void ServeRestored(const std::string& name) {
    Stop();
    options_.data_directory = Path(name);
    Start();
  }
  std::string AnyBlob(const std::string& backup) {
    return fs::directory_iterator(Path(backup + "/blobs"))->path().string();
  }

  store::TempDirectory elsewhere_;
};

TEST_F(BackupTest, ARestoredServerHasEverything) {
  const v1::ModelVersion robot = Import("robot", TinyBundle());
  Import("arm", TinyStateBundle());
  client::Client before({.server = server_->address()});
  client::Trajectory context{.samples = 20};
  for (int t = 0; t < 20; ++t) {
    context.inputs.push_back(0.1 * (t % 5));
    context.outputs.push_back(0.05 * (t % 7));
  }
  ASSERT_TRUE(before.Adapt({.model = "robot", .adaptation_id = "mine", .context = context}).ok());
  client::EstimationOptions options;
  options.target.model = "arm";
  const auto session = before.OpenEstimation(options);
  ASSERT_TRUE(session.ok());
  const client::SampleBatch sample{.samples = 1, .inputs = {0.3}, .outputs = {0.2}};
  ASSERT_TRUE((*session)->Send(sample).ok());
  ASSERT_TRUE((*session)->Receive().ok());
  while ((*session)->durable_seq() < 1) {  // told with the answer after it is so
    ASSERT_TRUE((*session)->Send(sample).ok());
    ASSERT_TRUE((*session)->Receive().ok());
  }

  Backup("b");
  const Outcome verified = RunMetaekf({"admin", "verify", Path("b"), "--output", "json"});
  EXPECT_EQ(verified.status, 0) << verified.err;
  EXPECT_EQ(nlohmann::json::parse(verified.out)["files"], 4);  // the database, two models, an adaptation
  ASSERT_EQ(RunMetaekf({"admin", "restore", Path("b"), "--data-dir", Path("d")}).status, 0);
  ServeRestored("d");

  EXPECT_EQ(client_->Call(Named<v1::GetModelVersionRequest>("models/robot")).value.SerializeAsString(),
            robot.SerializeAsString());
  client::Client after({.server = server_->address()});
  EXPECT_TRUE(after.GetAdaptation("mine").ok());
  EXPECT_TRUE(after.Predict({.target = {.adaptation = "mine"}, .trajectories = {context}}).ok());
  const auto resumed = after.ResumeEstimation((*session)->info().session, (*session)->info().token);
  ASSERT_TRUE(resumed.ok()) << resumed.status().message;
  EXPECT_GE((*resumed)->info().durable_seq, 1u);
  EXPECT_TRUE(after.GetServerInfo(/*verify_files=*/true)->problems.empty());
  EXPECT_THAT(RunMetaekf({"admin", "audit", "--server", server_->address()}).out, HasSubstr("CreateBackup"));
}

// While models come and go: each backup is of one moment, and whole.
TEST_F(BackupTest, WhatChangesMeanwhileDoesNotMatter) {
  std::atomic<bool> stop{false};
  std::thread changes([&] {
    Client client(server_->address());
    for (uint64_t seed = 1; !stop; ++seed) {
      EXPECT_TRUE(client.Import(ImportRequests("robot", nssm::WriteModelFile(TinyBundle(seed)))).ok());
      if (seed > 1) {
        EXPECT_TRUE(client.Call(Named<v1::DeleteModelVersionRequest>(absl::StrCat("models/robot/versions/", seed - 1))).ok());
      }
    }
  });
  for (int b = 0; b < 8; ++b) {
    const std::string name = absl::StrCat("b", b);
    Backup(name);
    EXPECT_EQ(RunMetaekf({"admin", "verify", Path(name)}).status, 0);
    ASSERT_EQ(RunMetaekf({"admin", "restore", Path(name), "--data-dir", Path(name + "d")}).status, 0);
    auto store = store::Store::Open(Path(name + "d"), [] { return absl::Now(); });
    ASSERT_TRUE(store.ok()) << store.status();
    EXPECT_THAT((*store)->TakeInventory("", true)->problems, ::testing::IsEmpty());
  }
  stop = true;
  changes.join();
  EXPECT_THAT(*store::ListDirectory(directory_.path() + "/tmp"), ::testing::IsEmpty());
}

TEST_F(BackupTest, DamageIsFoundAndNothingIsMadeOfIt) {
  Import("robot", TinyBundle());
  Backup("b");
  const std::string blob = AnyBlob("b");
  std::fstream file(blob, std::ios::in | std::ios::out);
  file.seekp(100);
  file.put('\x7f');
  file.close();
  for (const std::vector<std::string>& command : std::vector<std::vector<std::string>>{
           {"admin", "verify", Path("b")}, {"admin", "restore", Path("b"), "--data-dir", Path("d")}}) {
    const Outcome outcome = RunMetaekf(command);
    EXPECT_EQ(outcome.status, 1);
    EXPECT_THAT(outcome.err, AllOf(HasSubstr("damaged or gone"), HasSubstr(fs::path(blob).filename().string())));
  }
  EXPECT_FALSE(fs::exists(Path("d")));
  fs::remove(blob);
  EXPECT_EQ(RunMetaekf({"admin", "verify", Path("b")}).status, 1);
}

TEST_F(BackupTest, WhatTheServerHasLostIsToldAndTheRestIsKept) {
  const std::string digest = Import("robot", TinyBundle(1)).sha256();
  Import("robot", TinyBundle(2));
  fs::remove(directory_.path() + "/blobs/" + digest);
  const Outcome outcome = Admin({"backup", Path("b")});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr(digest), HasSubstr("doctor --verify")));
  EXPECT_EQ(RunMetaekf({"admin", "verify", Path("b")}).status, 0);
}

TEST_F(BackupTest, MistakesAreNamed) {
  Import("robot", TinyBundle());
  Backup("b");
  EXPECT_THAT(Admin({"backup", Path("b")}).err, HasSubstr("there already"));
  EXPECT_THAT(RunMetaekf({"admin", "verify", Path("nowhere")}).err, HasSubstr("is no backup"));
  EXPECT_THAT(RunMetaekf({"admin", "restore", Path("b"), "--data-dir", directory_.path()}).err, HasSubstr("is not empty"));
  std::ofstream(Path("b/manifest.json")) << R"({"format": 1, "create_time": "x"})";
  EXPECT_THAT(RunMetaekf({"admin", "verify", Path("b")}).err, HasSubstr("create_time"));
  std::ofstream(Path("b/manifest.json"))
      << R"({"format": 1, "create_time": "2026-01-01T00:00:00Z", "server_version": "1", "data_format_version": 2,
             "files": [{"path": "../../etc/passwd", "size_bytes": 1, "sha256": ""}]})";
  EXPECT_THAT(RunMetaekf({"admin", "verify", Path("b")}).err, HasSubstr("not as it should be"));
  // A backup that was broken off leaves what the next begins anew.
  fs::create_directory(Path("c.partial"));
  std::ofstream(Path("c.partial/metaekf.db")) << "half";
  Backup("c");
  EXPECT_FALSE(fs::exists(Path("c.partial")));
}

}  // namespace
}  // namespace metaekf::server
