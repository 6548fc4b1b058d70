#include "core/nssm/model_file.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::SizeIs;

class ModelServiceTest : public ServerTest {};

TEST_F(ModelServiceTest, AnImportedFileIsExportedByteForByte) {
  const std::string file = nssm::WriteModelFile(TinyBundle());
  const auto imported = client_->Import(ImportRequests("robot", file, 100));
  ASSERT_TRUE(imported.ok()) << imported;
  EXPECT_EQ(imported.value.name(), "models/robot/versions/1");
  EXPECT_EQ(imported.value.size_bytes(), file.size());
  EXPECT_EQ(imported.value.sample_period_s(), 0.1);  // UnitBundle
  EXPECT_EQ(imported.value.channels().inputs(0).name(), "u1");
  EXPECT_EQ(imported.value.spec().model().latent_size(), 2u);
  EXPECT_EQ(imported.value.parameter_count(), TinyBundle().parameters.size());
  EXPECT_FALSE(imported.value.has_validation_loss());

  const auto exported = client_->Call(Named<v1::ExportModelVersionRequest>("models/robot"));
  ASSERT_TRUE(exported.ok()) << exported;
  EXPECT_EQ(exported.value.front().header().sha256(), imported.value.sha256());
  std::string bytes;
  for (const auto& response : exported.value) bytes += response.chunk();
  EXPECT_EQ(bytes, file);
}

TEST_F(ModelServiceTest, ARequestIdSentTwiceMakesOneVersion) {
  auto requests = ImportRequests("robot", nssm::WriteModelFile(TinyBundle()));
  requests[0].mutable_header()->set_request_id("once");
  EXPECT_EQ(client_->Import(requests).value.name(), "models/robot/versions/1");
  EXPECT_EQ(client_->Import(requests).value.name(), "models/robot/versions/1");

  auto others = ImportRequests("robot", nssm::WriteModelFile(TinyBundle(2)));
  others[0].mutable_header()->set_request_id("once");
  ExpectError(client_->Import(others), absl::StatusCode::kAlreadyExists);
}

TEST_F(ModelServiceTest, WrongImportsAreRefusedAndLeaveNothing) {
  const std::string file = nssm::WriteModelFile(TinyBundle());
  const auto refused = absl::StatusCode::kInvalidArgument;
  auto requests = ImportRequests("Robot", file);
  ExpectError(client_->Import(requests), refused, {"header.parent"});

  requests = ImportRequests("robot", file);
  requests[0].mutable_header()->set_sha256("abc");
  ExpectError(client_->Import(requests), refused, {"header.sha256"});

  requests = ImportRequests("robot", file);
  requests[0].mutable_header()->set_size_bytes(0);
  ExpectError(client_->Import(requests), refused, {"header.size_bytes"});

  requests = ImportRequests("robot", file);
  requests.erase(requests.begin());
  ExpectError(client_->Import(requests), refused, {"header"});
  ExpectError(client_->Import({}), refused, {"header"});

  requests = ImportRequests("robot", "this is no model file");
  ExpectError(client_->Import(requests), refused, {"chunk"});

  requests = ImportRequests("robot", file);
  requests.push_back(requests[0]);
  ExpectError(client_->Import(requests), refused, {"chunk"});

  requests = ImportRequests("robot", std::string((1 << 20) + 1, 'x'), (1 << 20) + 1);
  ExpectError(client_->Import(requests), refused, {"chunk"});

  requests = ImportRequests("robot", file, 100);
  requests.pop_back();
  ExpectError(client_->Import(requests), absl::StatusCode::kDataLoss);

  requests = ImportRequests("robot", file);
  requests.emplace_back().set_chunk("more");
  ExpectError(client_->Import(requests), absl::StatusCode::kDataLoss);

  requests = ImportRequests("robot", file);
  (*requests[1].mutable_chunk())[file.size() - 1] ^= 1;
  ExpectError(client_->Import(requests), absl::StatusCode::kDataLoss);

  EXPECT_THAT(client_->Call(v1::ListModelsRequest()).value.models(), SizeIs(0));
  EXPECT_EQ(client_->Call(v1::GetServerInfoRequest()).value.data_directory().stored_bytes(), 0u);
}

TEST_F(ModelServiceTest, ListsComeInPages) {
  for (const char* name : {"c", "a", "b"}) Import(name, TinyBundle());
  v1::ListModelsRequest request;
  request.set_page_size(2);
  const auto first = client_->Call(request);
  ASSERT_THAT(first.value.models(), SizeIs(2));
  EXPECT_EQ(first.value.models(0).name(), "models/a");
  EXPECT_EQ(first.value.models(1).name(), "models/b");
  request.set_page_token(first.value.next_page_token());
  const auto second = client_->Call(request);
  ASSERT_THAT(second.value.models(), SizeIs(1));
  EXPECT_EQ(second.value.models(0).name(), "models/c");
  EXPECT_EQ(second.value.next_page_token(), "");

  request.set_page_token("made up");
  ExpectError(client_->Call(request), absl::StatusCode::kInvalidArgument, {"page_token"});
  request.set_page_size(-1);
  ExpectError(client_->Call(request), absl::StatusCode::kInvalidArgument, {"page_size"});
}

TEST_F(ModelServiceTest, VersionsAreFoundByNumberAliasAndAsTheLatest) {
  Import("robot", TinyBundle(1));
  Import("robot", TinyBundle(2));
  v1::SetModelAliasRequest alias;
  alias.mutable_alias()->set_name("models/robot/aliases/stable");
  alias.mutable_alias()->set_version(1);
  ASSERT_TRUE(client_->Call(alias).ok());

  const auto version = [&](const std::string& name) {
    return client_->Call(Named<v1::GetModelVersionRequest>(name));
  };
  EXPECT_EQ(version("models/robot").value.name(), "models/robot/versions/2");
  EXPECT_EQ(version("models/robot/versions/1").value.name(), "models/robot/versions/1");
  EXPECT_EQ(version("models/robot/aliases/stable").value.name(), "models/robot/versions/1");
  ExpectError(version("models/robot/versions/3"), absl::StatusCode::kNotFound);
  ExpectError(version("models/robot/aliases/other"), absl::StatusCode::kNotFound);
  ExpectError(version("models/other"), absl::StatusCode::kNotFound);
  ExpectError(version("robot"), absl::StatusCode::kInvalidArgument, {"name"});
  ExpectError(version("adaptations/a1"), absl::StatusCode::kInvalidArgument, {"name"});

  const auto model = client_->Call(Named<v1::GetModelRequest>("models/robot"));
  EXPECT_EQ(model.value.latest_version(), 2u);
  EXPECT_EQ(model.value.version_count(), 2u);
  EXPECT_EQ(model.value.aliases(0).name(), "models/robot/aliases/stable");

  v1::ListModelVersionsRequest list;
  list.set_parent("models/robot");
  const auto versions = client_->Call(list);
  ASSERT_THAT(versions.value.model_versions(), SizeIs(2));
  EXPECT_EQ(versions.value.model_versions(0).name(), "models/robot/versions/2");
  list.set_parent("models/robot/versions/1");
  ExpectError(client_->Call(list), absl::StatusCode::kInvalidArgument, {"parent"});
}

TEST_F(ModelServiceTest, AVersionInUseIsNotDeleted) {
  Import("robot", TinyBundle());
  v1::SetModelAliasRequest alias;
  alias.mutable_alias()->set_name("models/robot/aliases/stable");
  alias.mutable_alias()->set_version(1);
  ASSERT_TRUE(client_->Call(alias).ok());
  const auto remove = Named<v1::DeleteModelVersionRequest>("models/robot/versions/1");
  const auto refused = client_->Call(remove);
  ExpectError(refused, absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(refused.message, HasSubstr("alias stable"));

  const auto remove_alias = Named<v1::DeleteModelAliasRequest>("models/robot/aliases/stable");
  EXPECT_TRUE(client_->Call(remove_alias).ok());
  ExpectError(client_->Call(remove_alias), absl::StatusCode::kNotFound);
  EXPECT_TRUE(client_->Call(remove).ok());
  ExpectError(client_->Call(Named<v1::GetModelRequest>("models/robot")),
              absl::StatusCode::kNotFound);
}

TEST_F(ModelServiceTest, WrongAliasesAreRefused) {
  Import("robot", TinyBundle());
  v1::SetModelAliasRequest alias;
  alias.mutable_alias()->set_name("models/robot/aliases/7up");  // digits mean a version
  alias.mutable_alias()->set_version(1);
  ExpectError(client_->Call(alias), absl::StatusCode::kInvalidArgument, {"alias.name"});
  alias.mutable_alias()->set_name("models/robot/aliases/up");
  alias.mutable_alias()->set_version(2);
  ExpectError(client_->Call(alias), absl::StatusCode::kNotFound);
  ExpectError(client_->Call(Named<v1::DeleteModelVersionRequest>("models/robot")),
              absl::StatusCode::kInvalidArgument, {"name"});
}

}  // namespace
}  // namespace metaekf::server
