#include "core/meta/training_state.h"

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/nssm/safetensors.h"

namespace metaekf::meta {

std::string WriteCheckpoint(const TrainingState& state, const std::string& training_digest) {
  nssm::Safetensors file;
  for (const auto& [name, values] : state.values) {
    file.tensors.push_back({.name = name, .shape = {static_cast<int64_t>(values.size())}, .values = values});
  }
  file.metadata = {{"training", training_digest},
                   {"iteration", std::to_string(state.iteration)},
                   {"best_validation_loss", base::FormatExact(state.best_validation_loss)},
                   {"validation_loss", base::FormatExact(state.validation_loss)},
                   {"training_loss", base::FormatExact(state.training_loss)}};
  return nssm::WriteSafetensors(file);
}

absl::StatusOr<TrainingState> ReadCheckpoint(const std::string& bytes, const std::string& training_digest) {
  METAEKF_ASSIGN_OR_RETURN(nssm::Safetensors file, nssm::ReadSafetensors(bytes));
  if (file.metadata["training"] != training_digest) {
    return absl::InvalidArgumentError("the checkpoint belongs to another training");
  }
  TrainingState state;
  const auto number = [&file](const std::string& name) { return base::ParseDouble(file.metadata[name]); };
  const auto iteration = number("iteration"), best = number("best_validation_loss"), validation = number("validation_loss"),
             training = number("training_loss");
  if (!iteration || !best || !validation || !training) {
    return absl::InvalidArgumentError("the checkpoint's metadata is damaged");
  }
  state.iteration = static_cast<int32_t>(*iteration);
  state.best_validation_loss = *best;
  state.validation_loss = *validation;
  state.training_loss = *training;
  for (nssm::Safetensors::Tensor& tensor : file.tensors) state.values[tensor.name] = std::move(tensor.values);
  return state;
}

}  // namespace metaekf::meta
