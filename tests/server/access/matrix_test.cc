// Every RPC with every kind of token that should not do. What there is comes from the descriptors:
// an RPC that is added and not listed here fails.

#include <gmock/gmock.h>
#include <google/protobuf/descriptor.h>
#include <google/protobuf/dynamic_message.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include <functional>
#include <map>
#include <regex>
#include <set>

#include "metaekf/v1/admin.grpc.pb.h"
#include "metaekf/v1/estimation.pb.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using google::protobuf::DescriptorPool;
using google::protobuf::FieldDescriptor;
using google::protobuf::Message;
using google::protobuf::MethodDescriptor;

/// The least scope that each RPC needs.
const std::map<std::string, v1::Scope>& Needed() {
  static const std::map<std::string, v1::Scope> needed = {
      {"ModelService.ListModels", v1::READ},
      {"ModelService.GetModel", v1::READ},
      {"ModelService.ListModelVersions", v1::READ},
      {"ModelService.GetModelVersion", v1::READ},
      {"ModelService.ExportModelVersion", v1::READ},
      {"ModelService.ImportModelVersion", v1::WRITE},
      {"ModelService.SetModelAlias", v1::WRITE},
      {"ModelService.DeleteModelAlias", v1::WRITE},
      {"ModelService.DeleteModelVersion", v1::WRITE},
      {"TrainingService.CreateTrainingJob", v1::WRITE},
      {"TrainingService.GetJob", v1::READ},
      {"TrainingService.ListJobs", v1::READ},
      {"TrainingService.WatchJob", v1::READ},
      {"TrainingService.CancelJob", v1::WRITE},
      {"AdaptationService.Adapt", v1::WRITE},
      {"AdaptationService.GetAdaptation", v1::READ},
      {"AdaptationService.ListAdaptations", v1::READ},
      {"AdaptationService.DeleteAdaptation", v1::WRITE},
      {"PredictionService.Predict", v1::READ},
      {"SmoothingService.Smooth", v1::READ},
      {"EstimationService.Estimate", v1::STREAM},
      {"EstimationService.GetSession", v1::READ},
      {"EstimationService.ListSessions", v1::READ},
      {"EstimationService.DeleteSession", v1::STREAM},
      {"ServerService.GetServerInfo", v1::READ},
      {"ServerService.GetMetrics", v1::ADMIN},
      {"AdminService.CreateToken", v1::ADMIN},
      {"AdminService.ListTokens", v1::ADMIN},
      {"AdminService.RevokeToken", v1::ADMIN},
      {"AdminService.ListAuditEntries", v1::ADMIN},
      {"AdminService.CreateBackup", v1::ADMIN},
  };
  return needed;
}

std::vector<const MethodDescriptor*> Methods() {
  std::vector<const MethodDescriptor*> methods;
  for (const char* service :
       {"ModelService", "TrainingService", "AdaptationService", "PredictionService",
        "SmoothingService", "EstimationService", "ServerService", "AdminService"}) {
    const auto* found =
        DescriptorPool::generated_pool()->FindServiceByName(std::string("metaekf.v1.") + service);
    for (int m = 0; found != nullptr && m < found->method_count(); ++m)
      methods.push_back(found->method(m));
    EXPECT_NE(found, nullptr) << service;
  }
  return methods;
}

std::string ShortName(const MethodDescriptor* method) {
  return method->service()->name() + "." + method->name();
}

/// Calls with any bytes, any method.
class Caller {
 public:
  explicit Caller(const std::string& address)
      : stub_(grpc::CreateChannel(address, grpc::InsecureChannelCredentials())) {}

  /// Sends one request and reads one response, if there is one.
  grpc::Status Call(const MethodDescriptor* method, const std::string& authorization,
                    const std::string& request, std::string* response = nullptr) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(20));
    if (!authorization.empty()) context.AddMetadata("authorization", authorization);
    grpc::CompletionQueue queue;
    const std::string path = "/" + method->service()->full_name() + "/" + method->name();
    auto call = stub_.PrepareCall(&context, path, &queue);
    const auto wait = [&] {
      void* tag = nullptr;
      bool ok = false;
      EXPECT_TRUE(queue.Next(&tag, &ok));
      return ok;
    };
    call->StartCall(nullptr);
    if (wait()) {
      const grpc::Slice slice(request);
      call->WriteLast(grpc::ByteBuffer(&slice, 1), grpc::WriteOptions(), nullptr);
      wait();
      grpc::ByteBuffer answer;
      call->Read(&answer, nullptr);
      const bool answered = wait();
      if (answered && method->server_streaming()) context.TryCancel();  // those of a health service go on for ever
      if (answered && response != nullptr) {
        std::vector<grpc::Slice> slices;
        (void)answer.Dump(&slices);
        for (const grpc::Slice& part : slices)
          response->append(reinterpret_cast<const char*>(part.begin()), part.size());
      }
    }
    grpc::Status status;
    call->Finish(&status, nullptr);
    wait();
    return status;
  }

 private:
  grpc::GenericStub stub_;
};

/// A request of the method in which every name that there may be is `name` of its kind.
/// @param names  by the kind of resource: "models" and so on.
std::string RequestNaming(const MethodDescriptor* method,
                          const std::map<std::string, std::string>& names) {
  google::protobuf::DynamicMessageFactory factory;
  std::unique_ptr<Message> request(factory.GetPrototype(method->input_type())->New());
  const std::string service = method->service()->name();
  const std::string name = method->name();
  const std::string kind = service == "TrainingService"     ? "jobs"
                           : service == "AdaptationService" ? "adaptations"
                           : service == "EstimationService" ? "sessions"
                           : service == "AdminService"      ? "tokens"
                                                            : "models";
  const std::function<void(Message*)> fill = [&](Message* message) {
    for (int f = 0; f < message->GetDescriptor()->field_count(); ++f) {
      const FieldDescriptor* field = message->GetDescriptor()->field(f);
      if (field->is_repeated()) continue;
      const std::string& what = field->name();
      if (field->type() == FieldDescriptor::TYPE_STRING) {
        const auto set = [&](const std::string& value) {
          message->GetReflection()->SetString(message, field, value);
        };
        if (what == "target" || what == "model" || what == "parent") set(names.at("models"));
        if (what == "session") set(names.at("sessions"));
        if (what == "token") set("guess");
        if (what != "name") continue;
        if (name.find("Alias") != std::string::npos) {
          set(names.at("aliases"));
        } else if (name == "DeleteModelVersion" || name == "GetModelVersion" ||
                   name == "ExportModelVersion") {
          set(names.at("versions"));
        } else {
          set(names.at(kind));
        }
      } else if (field->type() == FieldDescriptor::TYPE_MESSAGE &&
                 (what == "header" || what == "options" || what == "resume" || what == "alias")) {
        fill(message->GetReflection()->MutableMessage(message, field));
      } else if (what == "version") {
        message->GetReflection()->SetUInt32(message, field, 1);
      }
    }
  };
  fill(request.get());
  return request->SerializeAsString();
}

class MatrixTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    const auto admin = CreateFirstToken();
    options_.security.require_tokens = true;
    Stop();
    Start();
    caller_.emplace(server_->address());
    admin_ = admin;
  }

  /// While none is needed yet.
  std::string CreateFirstToken() {
    Caller caller(server_->address());
    v1::CreateTokenRequest request;
    request.set_scope(v1::ADMIN);
    std::string response;
    EXPECT_TRUE(
        caller.Call(Method("AdminService.CreateToken"), "", request.SerializeAsString(), &response)
            .ok());
    v1::CreateTokenResponse made;
    EXPECT_TRUE(made.ParseFromString(response));
    return "Bearer " + made.secret();
  }

  v1::CreateTokenResponse Make(const std::string& tenant, v1::Scope scope, double lifetime_s = 0) {
    v1::CreateTokenRequest request;
    request.set_tenant(tenant);
    request.set_scope(scope);
    if (lifetime_s > 0) request.mutable_lifetime()->set_nanos(static_cast<int>(lifetime_s * 1e9));
    std::string response;
    const grpc::Status status = caller_->Call(Method("AdminService.CreateToken"), admin_,
                                              request.SerializeAsString(), &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    v1::CreateTokenResponse made;
    EXPECT_TRUE(made.ParseFromString(response));
    return made;
  }
  std::string Bearer(const std::string& tenant, v1::Scope scope) {
    return "Bearer " + Make(tenant, scope).secret();
  }

  static const MethodDescriptor* Method(const std::string& name) {
    for (const MethodDescriptor* method : Methods()) {
      if (ShortName(method) == name) return method;
    }
    ADD_FAILURE() << name;
    return nullptr;
  }

  /// What the call says, without the names that it was asked for.
  std::string Said(const MethodDescriptor* method, const std::string& authorization,
                   const std::map<std::string, std::string>& names) {
    std::string response;
    const grpc::Status status =
        caller_->Call(method, authorization, RequestNaming(method, names), &response);
    const std::string said =
        absl::StrCat(static_cast<int>(status.error_code()), " ", status.error_message(), " ",
                     status.error_details(), " ", response);
    return std::regex_replace(
        said, std::regex("secret|absent|hidden|nobody|livex|nonex|(session|job)s?[ /][37]"), "*");
  }

  std::optional<Caller> caller_;
  std::string admin_;
};

TEST_F(MatrixTest, EveryRpcIsListed) {
  std::set<std::string> there;
  for (const MethodDescriptor* method : Methods()) there.insert(ShortName(method));
  for (const auto& [name, scope] : Needed()) EXPECT_TRUE(there.erase(name)) << name;
  EXPECT_THAT(there, testing::IsEmpty());
}

TEST_F(MatrixTest, NoRpcAnswersWithoutAValidToken) {
  const v1::CreateTokenResponse expiring = Make("plant", v1::ADMIN, 1e-3);
  const v1::CreateTokenResponse revoked = Make("plant", v1::ADMIN);
  v1::RevokeTokenRequest revoke;
  revoke.set_name(revoked.token().name());
  ASSERT_TRUE(
      caller_->Call(Method("AdminService.RevokeToken"), admin_, revoke.SerializeAsString()).ok());
  while (absl::Now() <= absl::FromUnixSeconds(expiring.token().expire_time().seconds()) +
                            absl::Nanoseconds(expiring.token().expire_time().nanos())) {
  }
  const std::map<std::string, std::string> kinds = {
      {"none", ""},
      {"wrong", "Bearer metaekf_" + std::string(64, '0')},
      {"no bearer", "Basic Zm9vOmJhcg=="},
      {"expired", "Bearer " + expiring.secret()},
      {"revoked", "Bearer " + revoked.secret()}};
  for (const MethodDescriptor* method : Methods()) {
    for (const auto& [kind, authorization] : kinds) {
      std::string response;
      const grpc::Status status = caller_->Call(method, authorization, "", &response);
      EXPECT_EQ(status.error_code(), grpc::StatusCode::UNAUTHENTICATED)
          << ShortName(method) << ", " << kind << ": " << status.error_message();
      EXPECT_EQ(response, "") << ShortName(method) << ", " << kind;
    }
  }
}

TEST_F(MatrixTest, NoRpcAnswersToATokenWhoseScopeIsLess) {
  std::map<v1::Scope, std::string> tokens;
  for (const v1::Scope scope : {v1::READ, v1::STREAM, v1::WRITE, v1::ADMIN})
    tokens[scope] = Bearer("plant", scope);
  for (const MethodDescriptor* method : Methods()) {
    const v1::Scope needed = Needed().at(ShortName(method));
    for (const auto& [scope, authorization] : tokens) {
      const grpc::Status status = caller_->Call(method, authorization, "");
      if (scope < needed) {
        EXPECT_EQ(status.error_code(), grpc::StatusCode::PERMISSION_DENIED)
            << ShortName(method) << ", " << v1::Scope_Name(scope);
      } else {
        EXPECT_NE(status.error_code(), grpc::StatusCode::PERMISSION_DENIED)
            << ShortName(method) << ", " << v1::Scope_Name(scope);
        EXPECT_NE(status.error_code(), grpc::StatusCode::UNAUTHENTICATED)
            << ShortName(method) << ", " << v1::Scope_Name(scope);
      }
    }
  }
}

// What another tenant has looks to every RPC exactly as what nobody has.
TEST_F(MatrixTest, NothingTellsThatAnothersResourceIsThere) {
  // Things of each kind, of the tenant "owner", numbers as an intruder would guess them.
  Stop();
  {
    auto store = store::Store::Open(directory_.path(), [] { return absl::Now(); }).value();
    store::TenantStore theirs = store->Of("owner");
    const auto blob = [&](const std::string& bytes) { return store->blobs().Stage(bytes).value(); };
    theirs.models().AddVersion("secret", blob(nssm::WriteModelFile(TinyBundle())), "{}").value();
    EXPECT_TRUE(theirs.models().SetAlias("secret", "livex", 1).ok());
    theirs.adaptations().Create({"hidden", "secret", 1, blob("x"), "{}", {}}).value();
    for (int64_t number = 1; number <= 3; ++number) {
      theirs.sessions().Create("models/secret/versions/1", "").value();
      theirs.jobs().Create({"secret", "{}", blob("d"), {}}).value();
      theirs.jobs().Cancel(number).value();
    }
  }
  Start();
  caller_.emplace(server_->address());
  const std::string intruder = Bearer("intruder", v1::WRITE);
  const std::map<std::string, std::string> theirs = {{"models", "models/secret"},
                                                     {"versions", "models/secret/versions/1"},
                                                     {"aliases", "models/secret/aliases/livex"},
                                                     {"adaptations", "adaptations/hidden"},
                                                     {"sessions", "sessions/3"},
                                                     {"jobs", "jobs/3"},
                                                     {"tokens", "tokens/t1"}};
  const std::map<std::string, std::string> nobodys = {{"models", "models/absent"},
                                                      {"versions", "models/absent/versions/1"},
                                                      {"aliases", "models/absent/aliases/nonex"},
                                                      {"adaptations", "adaptations/nobody"},
                                                      {"sessions", "sessions/7"},
                                                      {"jobs", "jobs/7"},
                                                      {"tokens", "tokens/t7"}};
  for (const MethodDescriptor* method : Methods()) {
    EXPECT_EQ(Said(method, intruder, theirs), Said(method, intruder, nobodys)) << ShortName(method);
  }
  // And all of it is still there.
  const std::string owner = Bearer("owner", v1::WRITE);
  std::string response;
  ASSERT_TRUE(caller_->Call(Method("ModelService.ListModels"), owner, "", &response).ok());
  EXPECT_THAT(response, testing::HasSubstr("models/secret"));
  EXPECT_TRUE(caller_
                  ->Call(Method("AdaptationService.GetAdaptation"), owner,
                         RequestNaming(Method("AdaptationService.GetAdaptation"), theirs))
                  .ok());
  EXPECT_TRUE(caller_
                  ->Call(Method("EstimationService.GetSession"), owner,
                         RequestNaming(Method("EstimationService.GetSession"), theirs))
                  .ok());
}

}  // namespace
}  // namespace metaekf::server
