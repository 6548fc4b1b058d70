#include <openssl/evp.h>

#include <algorithm>

#include "client/src/impl.h"

namespace metaekf::client {
namespace {

using v1::ModelService;

constexpr size_t kChunkBytes = 512 * 1024;

/// SHA-256 as 64 lower-case hexadecimal digits.
std::string Sha256Hex(const std::string& bytes) {
  unsigned char digest[32];
  EVP_Digest(bytes.data(), bytes.size(), digest, nullptr, EVP_sha256(), nullptr);
  std::string hex;
  for (const unsigned char byte : digest) {
    hex += "0123456789abcdef"[byte >> 4];
    hex += "0123456789abcdef"[byte & 15];
  }
  return hex;
}

}  // namespace

Result<std::vector<Model>> Client::ListModels() {
  return impl_->List<Model>(impl_->models, &ModelService::Stub::ListModels, v1::ListModelsRequest(),
                            &v1::ListModelsResponse::models);
}

Result<Model> Client::GetModel(const std::string& model) {
  v1::GetModelRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), BareModelResource(model));
  v1::Model response;
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Call(impl_->models, &ModelService::Stub::GetModel, request, &response));
  return FromProto(response);
}

Result<std::vector<ModelVersion>> Client::ListModelVersions(const std::string& model) {
  v1::ListModelVersionsRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_parent(), BareModelResource(model));
  return impl_->List<ModelVersion>(impl_->models, &ModelService::Stub::ListModelVersions, request,
                                   &v1::ListModelVersionsResponse::model_versions);
}

Result<ModelVersion> Client::GetModelVersion(const std::string& model) {
  v1::GetModelVersionRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), ModelResource(model));
  v1::ModelVersion response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->models, &ModelService::Stub::GetModelVersion, request, &response));
  return FromProto(response);
}

Result<std::string> Client::ExportModel(const std::string& model) {
  v1::ExportModelVersionRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), ModelResource(model));
  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  const auto stream = impl_->models->ExportModelVersion(&context, request);
  v1::ModelVersion header;
  v1::ExportModelVersionResponse response;
  std::string file;
  while (stream->Read(&response)) {
    if (response.has_header()) header = response.header();
    file += response.chunk();
  }
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Translate(stream->Finish()));
  if (file.size() != header.size_bytes() || Sha256Hex(file) != header.sha256()) {
    return Error(Code::kDataLoss,
                 "the file of " + model + " did not arrive as the server announced it; try again");
  }
  return file;
}

Result<ModelVersion> Client::ImportModel(const std::string& model, const std::string& file) {
  v1::ImportModelVersionRequest request;
  auto* header = request.mutable_header();
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*header->mutable_parent(), BareModelResource(model));
  header->set_size_bytes(file.size());
  header->set_sha256(Sha256Hex(file));

  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  v1::ModelVersion response;
  const auto stream = impl_->models->ImportModelVersion(&context, &response);
  bool open = stream->Write(request);
  for (size_t start = 0; open && start < file.size(); start += kChunkBytes) {
    request.set_chunk(file.substr(start, kChunkBytes));
    open = stream->Write(request);
  }
  stream->WritesDone();
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Translate(stream->Finish()));
  return FromProto(response);
}

Status Client::SetModelAlias(const std::string& model, const std::string& alias, uint32_t version) {
  METAEKF_CLIENT_RETURN_IF_ERROR(BareModelResource(model).status());
  v1::SetModelAliasRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_alias()->mutable_name(),
                                  ModelResource(model + "@" + alias));
  if (Segment(request.alias().name(), 2) != "aliases") {
    return Error(Code::kInvalidArgument,
                 "\"" + alias + "\" is no alias: it must start with a letter");
  }
  request.mutable_alias()->set_version(version);
  v1::ModelAlias response;
  return impl_->Call(impl_->models, &ModelService::Stub::SetModelAlias, request, &response);
}

Status Client::DeleteModelAlias(const std::string& model) {
  v1::DeleteModelAliasRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), ModelResource(model));
  google::protobuf::Empty response;
  return impl_->Call(impl_->models, &ModelService::Stub::DeleteModelAlias, request, &response);
}

Status Client::DeleteModelVersion(const std::string& model) {
  v1::DeleteModelVersionRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), ModelResource(model));
  google::protobuf::Empty response;
  return impl_->Call(impl_->models, &ModelService::Stub::DeleteModelVersion, request, &response);
}

}  // namespace metaekf::client
