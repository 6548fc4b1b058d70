#pragma once

#include <cstdint>
#include <string>

#include "metaekf/client.h"

/// Between the names that people write and the server's resource names.
namespace metaekf::client {

/// models/{m}, models/{m}/versions/{v} or models/{m}/aliases/{a} from NAME, NAME@V, NAME@A; a name
/// that starts with "models/" stays as it is. Errors: InvalidArgument with what a name looks like.
Result<std::string> ModelResource(const std::string& model);

/// models/{m} from NAME. Errors: also for NAME@….
Result<std::string> BareModelResource(const std::string& model);

/// COLLECTION/{id}; an id with the collection before it stays as it is. Errors: InvalidArgument.
Result<std::string> Resource(const std::string& collection, const std::string& id);

/// The model's or adaptation's resource name. Errors: also unless one of the two is given.
Result<std::string> TargetResource(const Target& target);

/// Segment `index` of a resource name, counted from 0; empty if there is none.
std::string Segment(const std::string& resource, int index);
/// The version of models/{m}/versions/{v}; 0 if it has none.
uint32_t VersionOf(const std::string& resource);

}  // namespace metaekf::client
