#include "core/nssm/safetensors.h"

#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>
#include <set>

#include "core/base/json_fields.h"
#include "core/base/status.h"

namespace metaekf::nssm {
namespace {

using nlohmann::json;

static_assert(std::endian::native == std::endian::little, "safetensors files are little-endian");

constexpr uint64_t kMaxHeader = 1 << 20;
constexpr size_t kMaxTensors = 4096;

absl::Status Malformed(const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat("not a valid safetensors file: ", what));
}

/// Parses JSON and refuses objects that name a key twice, which readers would understand differently.
absl::Status ParseHeader(const std::string& text, json* header) {
  std::vector<std::set<std::string>> keys;
  std::string duplicate;
  const auto callback = [&](int, json::parse_event_t event, json& parsed) {
    if (event == json::parse_event_t::object_start) keys.emplace_back();
    if (event == json::parse_event_t::object_end) keys.pop_back();
    if (event == json::parse_event_t::key && !keys.back().insert(parsed.get<std::string>()).second) {
      duplicate = parsed.get<std::string>();
    }
    return true;
  };
  *header = json::parse(text, callback, /*allow_exceptions=*/false);
  if (header->is_discarded() || !header->is_object()) return Malformed("the header is not a JSON object");
  if (!duplicate.empty()) return Malformed(absl::StrCat("\"", duplicate, "\" stands twice in the header"));
  return absl::OkStatus();
}

/// The place of one tensor's values.
struct Extent {
  uint64_t begin, end;
};

absl::StatusOr<Extent> ReadEntry(const std::string& name, const json& entry, Safetensors::Tensor* tensor) {
  const auto malformed = [&name](const std::string& what) {
    return Malformed(absl::StrCat("tensor \"", name, "\": ", what));
  };
  if (!entry.is_object() || !entry.contains("dtype") || !entry.contains("shape") || !entry.contains("data_offsets")) {
    return malformed("needs dtype, shape and data_offsets");
  }
  const json& type = entry["dtype"];
  if (type != "F32" && type != "F64") return malformed(absl::StrCat("dtype ", type.dump(), " is not F32 or F64"));
  tensor->name = name;
  tensor->is_float32 = type == "F32";
  const uint64_t element = tensor->is_float32 ? 4 : 8;
  uint64_t size = element;
  if (!entry["shape"].is_array()) return malformed("shape is not a list");
  for (const json& dimension : entry["shape"]) {
    if (!dimension.is_number_unsigned()) return malformed("a dimension is not a whole number");
    const uint64_t n = dimension.get<uint64_t>();
    if (n > (uint64_t{1} << 40) || __builtin_mul_overflow(size, n, &size)) return malformed("its shape is too large");
    tensor->shape.push_back(static_cast<int64_t>(n));
  }
  const json& offsets = entry["data_offsets"];
  if (!offsets.is_array() || offsets.size() != 2 || !offsets[0].is_number_unsigned() ||
      !offsets[1].is_number_unsigned()) {
    return malformed("data_offsets are not two whole numbers");
  }
  const Extent extent{offsets[0].get<uint64_t>(), offsets[1].get<uint64_t>()};
  if (extent.end < extent.begin || extent.end - extent.begin != size) {
    return malformed(absl::StrCat("its data has ", extent.end - extent.begin, " bytes, its shape needs ", size));
  }
  return extent;
}

absl::Status ReadValues(const char* data, const Extent& extent, Safetensors::Tensor* tensor) {
  const size_t element = tensor->is_float32 ? 4 : 8;
  const size_t count = (extent.end - extent.begin) / element;
  tensor->values.resize(count);
  for (size_t i = 0; i < count; ++i) {
    if (tensor->is_float32) {
      float value;
      std::memcpy(&value, data + extent.begin + 4 * i, 4);
      tensor->values[i] = static_cast<double>(value);
    } else {
      std::memcpy(&tensor->values[i], data + extent.begin + 8 * i, 8);
    }
    if (!std::isfinite(tensor->values[i])) {
      return absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor->name, "\": value ", i, " is not finite"));
    }
  }
  return absl::OkStatus();
}

}  // namespace

std::string WriteSafetensors(const Safetensors& file) {
  nlohmann::ordered_json header;
  if (!file.metadata.empty()) header["__metadata__"] = file.metadata;
  uint64_t offset = 0;
  for (const Safetensors::Tensor& tensor : file.tensors) {
    const uint64_t size = tensor.values.size() * (tensor.is_float32 ? 4 : 8);
    header[tensor.name] = {{"dtype", tensor.is_float32 ? "F32" : "F64"},
                           {"shape", tensor.shape},
                           {"data_offsets", {offset, offset + size}}};
    offset += size;
  }
  std::string text = header.dump();
  text.append((8 - text.size() % 8) % 8, ' ');  // values start aligned
  const uint64_t header_size = text.size();
  std::string bytes(8, '\0');
  std::memcpy(bytes.data(), &header_size, 8);
  bytes += text;
  bytes.reserve(bytes.size() + offset);
  for (const Safetensors::Tensor& tensor : file.tensors) {
    for (const double value : tensor.values) {
      const float narrow = static_cast<float>(value);
      const char* raw = tensor.is_float32 ? reinterpret_cast<const char*>(&narrow) : reinterpret_cast<const char*>(&value);
      bytes.append(raw, tensor.is_float32 ? 4 : 8);
    }
  }
  return bytes;
}

absl::StatusOr<Safetensors> ReadSafetensors(const std::string& bytes) {
  uint64_t header_size = 0;
  if (bytes.size() < 8) return Malformed("it is shorter than its own header");
  std::memcpy(&header_size, bytes.data(), 8);
  if (header_size > kMaxHeader) return Malformed(absl::StrCat("its header claims ", header_size, " bytes"));
  if (bytes.size() - 8 < header_size) return Malformed("it ends inside its header");
  json header;
  METAEKF_RETURN_IF_ERROR(ParseHeader(bytes.substr(8, header_size), &header));
  if (header.size() > kMaxTensors) return Malformed(absl::StrCat("it has ", header.size(), " tensors"));

  Safetensors file;
  std::map<uint64_t, std::pair<Extent, Safetensors::Tensor>> by_offset;
  for (const auto& [name, entry] : header.items()) {
    if (name == "__metadata__") {
      if (!entry.is_object()) return Malformed("its metadata is not an object");
      for (const auto& [key, value] : entry.items()) {
        if (!value.is_string()) return Malformed(absl::StrCat("metadata \"", key, "\" is not text"));
        file.metadata[key] = value.get<std::string>();
      }
      continue;
    }
    Safetensors::Tensor tensor;
    METAEKF_ASSIGN_OR_RETURN(const Extent extent, ReadEntry(name, entry, &tensor));
    if (extent.begin == extent.end) return Malformed(absl::StrCat("tensor \"", name, "\" is empty"));
    if (!by_offset.emplace(extent.begin, std::pair{extent, std::move(tensor)}).second) {
      return Malformed(absl::StrCat("tensor \"", name, "\" overlaps another"));
    }
  }
  const char* data = bytes.data() + 8 + header_size;
  uint64_t expected = 0;
  for (auto& [begin, item] : by_offset) {
    if (begin != expected) return Malformed(absl::StrCat("tensor \"", item.second.name, "\" leaves a gap or overlaps another"));
    expected = item.first.end;
    if (expected > bytes.size() - 8 - header_size) {
      return Malformed(absl::StrCat("it ends inside tensor \"", item.second.name, "\""));
    }
    METAEKF_RETURN_IF_ERROR(ReadValues(data, item.first, &item.second));
    file.tensors.push_back(std::move(item.second));
  }
  if (expected != bytes.size() - 8 - header_size) return Malformed("bytes follow the last tensor");
  return file;
}

}  // namespace metaekf::nssm
