#include "client/src/text_proto.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/io/tokenizer.h>
#include <google/protobuf/text_format.h>

#include "client/src/status.h"

namespace metaekf::client {
namespace {

/// Keeps the first error.
class FirstError : public google::protobuf::io::ErrorCollector {
 public:
  void AddError(int line, int column, const std::string& message) override {
    if (!message_.empty()) return;
    message_ = message;
    place_ = std::to_string(line + 1) + ":" + std::to_string(column + 1);
  }
  const std::string& message() const { return message_; }
  const std::string& place() const { return place_; }

 private:
  std::string message_;
  std::string place_;
};

/// For the parser's 'Message type "T" has no field named "f".': the fields that T has.
std::string FieldsThatExist(const std::string& error) {
  constexpr char kStart[] = "Message type \"";
  if (!error.starts_with(kStart) || error.find("has no field named") == std::string::npos) {
    return "";
  }
  const size_t start = sizeof(kStart) - 1;
  const std::string type = error.substr(start, error.find('"', start) - start);
  const auto* descriptor =
      google::protobuf::DescriptorPool::generated_pool()->FindMessageTypeByName(type);
  if (descriptor == nullptr) return "";
  std::string fields = " Its fields are ";
  for (int i = 0; i < descriptor->field_count(); ++i) {
    fields += (i > 0 ? ", " : "") + descriptor->field(i)->name();
  }
  return fields + ".";
}

}  // namespace

Status ParseText(const std::string& text, const std::string& source,
                 google::protobuf::Message* message) {
  google::protobuf::TextFormat::Parser parser;
  FirstError error;
  parser.RecordErrorsTo(&error);
  if (parser.ParseFromString(text, message)) return {};
  return Error(Code::kInvalidArgument, source + ":" + error.place() + ": " + error.message() +
                                           FieldsThatExist(error.message()));
}

std::string PrintText(const google::protobuf::Message& message) {
  std::string text;
  google::protobuf::TextFormat::PrintToString(message, &text);
  return text;
}

}  // namespace metaekf::client
