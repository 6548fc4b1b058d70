#include "server/convert/models.h"

#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "server/convert/channels.h"
#include "server/convert/json.h"
#include "server/convert/spec.h"
#include "server/convert/time.h"
#include "server/names/resource_names.h"

namespace metaekf::server {

std::string VersionMetadata(const nssm::Bundle& bundle, const std::string& training_job) {
  v1::ModelVersion version;
  // A file may come without its training, or with that of a later version.
  auto training = ToTrainingSpecMessage(*bundle.training);
  if (!training.ok() || !training->has_model()) {
    training = ToTrainingSpecMessage({{"model", nssm::ToJson(bundle.model.spec())}});
  }
  if (training.ok()) *version.mutable_spec() = *std::move(training);
  *version.mutable_channels() = ToMessage(bundle.names);
  version.set_sample_period_s(bundle.sample_period_s);
  version.set_parameter_count(bundle.parameters.size());
  const auto loss = bundle.provenance->find("validation_loss");
  if (loss != bundle.provenance->end() && loss->is_number()) {
    version.set_validation_loss(loss->get<double>());
  }
  version.set_training_job(training_job);
  return MessageToJson(version);
}

v1::ModelVersion ToMessage(const store::ModelVersion& version) {
  v1::ModelVersion message;
  // What an earlier server wrote and this one cannot read is left out of the list.
  JsonToMessage(version.metadata_json, &message).IgnoreError();
  message.set_name(VersionName(version.model, version.version));
  *message.mutable_create_time() = ToTimestamp(version.create_time);
  message.set_size_bytes(static_cast<uint64_t>(version.size_bytes));
  message.set_sha256(version.digest);
  return message;
}

v1::Model ToMessage(const store::Model& model) {
  v1::Model message;
  message.set_name(ModelName(model.name));
  message.set_latest_version(static_cast<uint32_t>(model.latest_version));
  message.set_version_count(static_cast<uint32_t>(model.version_count));
  *message.mutable_create_time() = ToTimestamp(model.create_time);
  for (const store::Alias& alias : model.aliases) {
    v1::ModelAlias* added = message.add_aliases();
    added->set_name(AliasName(model.name, alias.alias));
    added->set_version(static_cast<uint32_t>(alias.version));
  }
  return message;
}

}  // namespace metaekf::server
