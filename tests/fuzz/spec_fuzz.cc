#include <cstdlib>
#include <string>

#include "client/src/text_proto.h"
#include "core/nssm/model.h"
#include "metaekf/v1/spec.pb.h"
#include "server/convert/spec.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  metaekf::v1::TrainingSpec message;
  const std::string text(reinterpret_cast<const char*>(data), size);
  if (!metaekf::client::ParseText(text, "input", &message).ok()) return 0;
  // The channels are the data's.
  if (message.model().input_size() == 0) message.mutable_model()->set_input_size(1);
  if (message.model().output_size() == 0) message.mutable_model()->set_output_size(1);
  const auto spec = metaekf::server::ToCore("spec", message);
  if (!spec.ok()) return 0;
  (void)metaekf::nssm::Model::Create(spec->model);
  return 0;
}
