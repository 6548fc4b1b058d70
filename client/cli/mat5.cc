#include "client/cli/mat5.h"

#include <zlib.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <optional>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

constexpr size_t kHeader = 128, kTag = 8;

/// Types of elements: what their bytes are.
enum Type : uint32_t {
  kInt8 = 1, kUint8 = 2, kInt16 = 3, kUint16 = 4, kInt32 = 5, kUint32 = 6, kSingle = 7, kDouble = 9, kInt64 = 12, kUint64 = 13,
  kMatrix = 14, kCompressed = 15,
};

/// Classes of arrays: what they are in MATLAB. From kDoubleClass to kLastNumericClass they are full matrices of numbers.
constexpr uint32_t kDoubleClass = 6, kSingleClass = 7, kLastNumericClass = 15;
constexpr uint32_t kComplexFlag = 0x800;

absl::Status Damaged() { return absl::InvalidArgumentError("the file is damaged"); }

template <class T>
T Value(const char* at, bool big_endian) {
  char bytes[sizeof(T)];
  if (big_endian) {
    std::reverse_copy(at, at + sizeof(T), bytes);
  } else {
    std::memcpy(bytes, at, sizeof(T));
  }
  T value;
  std::memcpy(&value, bytes, sizeof(T));
  return value;
}

struct Element {
  uint32_t type;
  std::string_view data;
};

/// Elements one behind the other: tag, data, padding.
class Elements {
 public:
  Elements(std::string_view bytes, bool big_endian) : rest_(bytes), big_endian_(big_endian) {}

  bool at_end() const { return rest_.empty(); }

  /// Errors: InvalidArgument where the next element ends behind the last byte.
  absl::StatusOr<Element> Next() {
    if (rest_.size() < kTag) return CutOff();
    const uint32_t first = Value<uint32_t>(rest_.data(), big_endian_);
    const bool is_small = first >> 16 != 0;  // up to four bytes, in the tag itself
    const uint32_t type = is_small ? first & 0xffff : first;
    const size_t size = is_small ? first >> 16 : Value<uint32_t>(rest_.data() + 4, big_endian_);
    const size_t begin = is_small ? 4 : kTag;
    if ((is_small && size > 4) || size > rest_.size() - begin) return CutOff();
    const Element element{type, rest_.substr(begin, size)};
    const size_t end = begin + size, padding = type == kCompressed ? 0 : (kTag - end % kTag) % kTag;
    rest_.remove_prefix(std::min(rest_.size(), end + padding));
    return element;
  }

 private:
  static absl::Status CutOff() { return absl::InvalidArgumentError("the file is cut off"); }

  std::string_view rest_;
  bool big_endian_;
};

/// @return what a zlib stream holds. Errors: InvalidArgument if it does not come to its end, its checksum included.
absl::StatusOr<std::string> Inflate(std::string_view compressed) {
  z_stream stream{};
  if (inflateInit(&stream) != Z_OK) return absl::ResourceExhaustedError("no memory to decompress");
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<char*>(compressed.data()));
  stream.avail_in = static_cast<uInt>(compressed.size());
  std::string inflated;
  std::vector<char> part(size_t{1} << 16);
  int code = Z_OK;
  while (code == Z_OK) {
    stream.next_out = reinterpret_cast<Bytef*>(part.data());
    stream.avail_out = static_cast<uInt>(part.size());
    code = inflate(&stream, Z_NO_FLUSH);
    inflated.append(part.data(), part.size() - stream.avail_out);
  }
  inflateEnd(&stream);
  if (code != Z_STREAM_END) return Damaged();
  return inflated;
}

template <class T>
bool Take(std::string_view data, bool big_endian, std::vector<double>* values) {
  if (data.size() != values->size() * sizeof(T)) return false;
  for (size_t i = 0; i < values->size(); ++i) (*values)[i] = static_cast<double>(Value<T>(data.data() + i * sizeof(T), big_endian));
  return true;
}

/// @return whether an element is numbers, as many as there is room for.
bool TakeNumbers(const Element& element, bool big_endian, std::vector<double>* values) {
  switch (element.type) {
    case kInt8: return Take<int8_t>(element.data, big_endian, values);
    case kUint8: return Take<uint8_t>(element.data, big_endian, values);
    case kInt16: return Take<int16_t>(element.data, big_endian, values);
    case kUint16: return Take<uint16_t>(element.data, big_endian, values);
    case kInt32: return Take<int32_t>(element.data, big_endian, values);
    case kUint32: return Take<uint32_t>(element.data, big_endian, values);
    case kSingle: return Take<float>(element.data, big_endian, values);
    case kDouble: return Take<double>(element.data, big_endian, values);
    case kInt64: return Take<int64_t>(element.data, big_endian, values);
    case kUint64: return Take<uint64_t>(element.data, big_endian, values);
    default: return false;
  }
}

/// @param matrix  the data of an element of type kMatrix: flags, sizes, name, real part, perhaps imaginary part.
/// @return nothing for what is no signal.
absl::StatusOr<std::optional<MatArray>> ReadMatrix(std::string_view matrix, bool big_endian) {
  if (matrix.empty()) return std::nullopt;  // an empty array may be written so
  Elements elements(matrix, big_endian);
  METAEKF_ASSIGN_OR_RETURN(const Element flags, elements.Next());
  if (flags.type != kUint32 || flags.data.size() != 8) return Damaged();
  const uint32_t word = Value<uint32_t>(flags.data.data(), big_endian), kind = word & 0xff;
  if (kind < kDoubleClass || kind > kLastNumericClass) return std::nullopt;
  METAEKF_ASSIGN_OR_RETURN(const Element sizes, elements.Next());
  METAEKF_ASSIGN_OR_RETURN(const Element name, elements.Next());
  if (sizes.type != kInt32 || sizes.data.size() % 4 != 0 || name.type != kInt8) return Damaged();
  if (sizes.data.size() != 8 || name.data.empty()) return std::nullopt;
  const int32_t rows = Value<int32_t>(sizes.data.data(), big_endian), columns = Value<int32_t>(sizes.data.data() + 4, big_endian);
  if (rows < 0 || columns < 0) return Damaged();
  if (int64_t{rows} * columns <= 1) return std::nullopt;
  MatArray array{.name = std::string(name.data), .rows = static_cast<size_t>(rows), .columns = static_cast<size_t>(columns),
                 .is_single = kind == kSingleClass, .values = {}};
  if ((word & kComplexFlag) != 0) return absl::InvalidArgumentError(absl::StrCat("array \"", array.name, "\" is complex: give real numbers"));
  METAEKF_ASSIGN_OR_RETURN(const Element real, elements.Next());
  const size_t count = array.rows * array.columns;  // each takes a byte at least
  if (count <= real.data.size()) array.values.resize(count);
  if (count > real.data.size() || !TakeNumbers(real, big_endian, &array.values)) {
    return absl::InvalidArgumentError(absl::StrCat("array \"", array.name, "\" says that it is ", rows, " × ", columns,
                                                   ", which is not what it holds"));
  }
  return array;
}

}  // namespace

bool IsMat5(std::string_view bytes) {
  if (bytes.size() < kHeader) return false;
  const std::string_view end = bytes.substr(kHeader - 4, 4);  // version 1.0, and the letters MI as a number
  return end == std::string_view("\0\1IM", 4) || end == std::string_view("\1\0MI", 4);
}

absl::StatusOr<std::vector<MatArray>> ReadMat5(std::string_view bytes) {
  const absl::Status no_mat_file = absl::InvalidArgumentError("not a MAT file of version 5 or 7.3");
  if (!IsMat5(bytes)) return no_mat_file;
  const bool big_endian = bytes[kHeader - 2] == 'M';
  std::vector<MatArray> arrays;
  for (Elements elements(bytes.substr(kHeader), big_endian); !elements.at_end();) {
    METAEKF_ASSIGN_OR_RETURN(Element element, elements.Next());
    std::string inflated;
    if (element.type == kCompressed) {
      METAEKF_ASSIGN_OR_RETURN(inflated, Inflate(element.data));
      METAEKF_ASSIGN_OR_RETURN(element, Elements(inflated, big_endian).Next());
    }
    if (element.type != kMatrix) return no_mat_file;
    METAEKF_ASSIGN_OR_RETURN(std::optional<MatArray> array, ReadMatrix(element.data, big_endian));
    if (array.has_value()) arrays.push_back(*std::move(array));
  }
  return arrays;
}

}  // namespace metaekf::cli
