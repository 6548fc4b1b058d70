#include "server/convert/channels.h"

#include <set>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

using ChannelList = google::protobuf::RepeatedPtrField<v1::Channel>;

void CheckNames(const std::string& field, const ChannelList& channels, std::set<std::string>* known,
                std::vector<Violation>* violations) {
  for (int i = 0; i < channels.size(); ++i) {
    const std::string& name = channels[i].name();
    const std::string place = absl::StrCat(field, "[", i, "].name");
    if (name.empty()) {
      violations->push_back({place, "is empty"});
    } else if (!known->insert(name).second) {
      violations->push_back({place, absl::StrCat("'", name, "' names two channels")});
    }
  }
}

absl::Status Match(const std::string& field, const ChannelList& given,
                   const std::vector<std::string>& needed) {
  std::vector<std::string> names;
  for (const v1::Channel& channel : given) names.push_back(channel.name());
  if (names == needed) return absl::OkStatus();
  const auto list = [](const std::vector<std::string>& all) {
    return all.empty() ? std::string("none") : absl::StrJoin(all, ", ");
  };
  return FieldViolation(field, absl::StrCat("the model needs ", list(needed),
                                            " in this order, the data has ", list(names)));
}

void AddChannels(const std::vector<std::string>& names, ChannelList* channels) {
  for (const std::string& name : names) channels->Add()->set_name(name);
}

}  // namespace

ChannelCounts CountChannels(const v1::Channels& channels) {
  return {channels.inputs_size(), channels.outputs_size(), channels.states_size()};
}

v1::Channels ToMessage(const nssm::ChannelNames& names) {
  v1::Channels channels;
  AddChannels(names.inputs, channels.mutable_inputs());
  AddChannels(names.outputs, channels.mutable_outputs());
  AddChannels(names.states, channels.mutable_states());
  return channels;
}

absl::Status CheckNewChannels(const std::string& field, const v1::Channels& channels) {
  std::vector<Violation> violations;
  std::set<std::string> known;
  CheckNames(absl::StrCat(field, ".inputs"), channels.inputs(), &known, &violations);
  CheckNames(absl::StrCat(field, ".outputs"), channels.outputs(), &known, &violations);
  CheckNames(absl::StrCat(field, ".states"), channels.states(), &known, &violations);
  if (channels.outputs().empty()) {
    violations.push_back({absl::StrCat(field, ".outputs"), "a model needs an output (y1, y2, …)"});
  }
  return FieldViolations(violations);
}

absl::StatusOr<ChannelCounts> MatchChannels(const std::string& field, const v1::Channels& channels,
                                            const nssm::Bundle& bundle) {
  const nssm::ModelSpec& spec = bundle.model.spec();
  if (channels.ByteSizeLong() == 0) {
    return ChannelCounts{spec.input_size, spec.output_size, spec.state_size};
  }
  METAEKF_RETURN_IF_ERROR(
      Match(absl::StrCat(field, ".inputs"), channels.inputs(), bundle.names.inputs));
  METAEKF_RETURN_IF_ERROR(
      Match(absl::StrCat(field, ".outputs"), channels.outputs(), bundle.names.outputs));
  if (!spec.is_case_one()) {
    METAEKF_RETURN_IF_ERROR(
        Match(absl::StrCat(field, ".states"), channels.states(), bundle.names.states));
  }
  return CountChannels(channels);
}

}  // namespace metaekf::server
