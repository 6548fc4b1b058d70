#include "server/training/dataset_file.h"

#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/convert/samples.h"
#include "server/convert/spec.h"

namespace metaekf::server {
namespace {

constexpr size_t kLengthBytes = 8;

/// Takes the next message off `bytes`; nothing at the end.
absl::StatusOr<std::optional<v1::CreateTrainingJobRequest>> NextMessage(std::string_view* bytes) {
  if (bytes->empty()) return std::nullopt;
  uint64_t length = 0;
  for (size_t i = 0; i < kLengthBytes && i < bytes->size(); ++i) {
    length |= uint64_t{static_cast<unsigned char>((*bytes)[i])} << (8 * i);
  }
  v1::CreateTrainingJobRequest message;
  if (bytes->size() < kLengthBytes || length > bytes->size() - kLengthBytes ||
      !message.ParseFromArray(bytes->data() + kLengthBytes, static_cast<int>(length))) {
    return absl::DataLossError("the data of the job is damaged");
  }
  bytes->remove_prefix(kLengthBytes + length);
  return message;
}

std::vector<std::string> Names(const google::protobuf::RepeatedPtrField<v1::Channel>& channels) {
  std::vector<std::string> names;
  for (const v1::Channel& channel : channels) names.push_back(channel.name());
  return names;
}

}  // namespace

std::string DatasetFrame(const v1::CreateTrainingJobRequest& message) {
  std::string frame(kLengthBytes, '\0');
  message.AppendToString(&frame);
  const uint64_t length = frame.size() - kLengthBytes;
  for (size_t i = 0; i < kLengthBytes; ++i) {
    frame[i] = static_cast<char>(static_cast<unsigned char>(length >> (8 * i)));
  }
  return frame;
}

absl::StatusOr<TrainingInput> ReadDatasetFile(std::string_view bytes) {
  METAEKF_ASSIGN_OR_RETURN(const auto first, NextMessage(&bytes));
  if (!first || !first->has_header()) return absl::DataLossError("the job's data has no header");
  const v1::CreateTrainingJobRequest::Header& header = first->header();
  TrainingInput input;
  METAEKF_ASSIGN_OR_RETURN(input.spec, ToCore("spec", header.spec()));
  input.fleet.input_names = Names(header.channels().inputs());
  input.fleet.output_names = Names(header.channels().outputs());
  input.fleet.state_names = Names(header.channels().states());
  TrajectoryAssembler assembler({.channels = CountChannels(header.channels()),
                                 .max_samples = std::numeric_limits<int64_t>::max()});
  while (true) {
    METAEKF_ASSIGN_OR_RETURN(const auto message, NextMessage(&bytes));
    if (!message) break;
    METAEKF_ASSIGN_OR_RETURN(auto complete, assembler.Add(message->samples()));
    if (complete) input.fleet.trajectories.push_back(*std::move(complete));
  }
  if (auto last = assembler.Finish()) input.fleet.trajectories.push_back(*std::move(last));
  return input;
}

}  // namespace metaekf::server
