#include "server/store/models.h"

#include <optional>

#include "core/base/status.h"
#include "server/store/audit.h"
#include "server/store/names.h"

namespace metaekf::store {
namespace {

constexpr const char* kRequestKind = "version";
constexpr const char* kSelectVersion =
    "SELECT model, version, digest, size_bytes, metadata_json, create_time FROM versions "
    "WHERE tenant = ?1 AND model = ?2 ";
constexpr const char* kSelectModel =
    "SELECT model, max(version), count(*), min(create_time) FROM versions WHERE tenant = ?1 ";

ModelVersion ReadVersion(const Row& row) {
  return {row.Text(0), row.Int(1),  row.Text(2),
          row.Int(3),  row.Text(4), absl::FromUnixMicros(row.Int(5))};
}

Model ReadModel(const Row& row) {
  return {row.Text(0), row.Int(1), row.Int(2), absl::FromUnixMicros(row.Int(3)), {}};
}

absl::Status NoSuchModel(const std::string& model) {
  return absl::NotFoundError(absl::StrCat("there is no model '", model, "'"));
}

absl::Status NoSuchAlias(const std::string& model, const std::string& alias) {
  return absl::NotFoundError(absl::StrCat("model '", model, "' has no alias '", alias, "'"));
}

absl::Status ReadAliases(const Context& context, Connection& connection, Model& model) {
  return connection.Execute(
      "SELECT alias, version FROM aliases WHERE tenant = ?1 AND model = ?2 ORDER BY alias",
      {context.tenant, model.name}, [&](const Row& row) {
        model.aliases.push_back({row.Text(0), row.Int(1)});
      });
}

absl::StatusOr<ModelVersion> FindVersion(const Context& context, Connection& connection,
                                         const std::string& model, int64_t version) {
  std::optional<ModelVersion> found;
  METAEKF_RETURN_IF_ERROR(connection.Execute(absl::StrCat(kSelectVersion, "AND version = ?3"),
                                             {context.tenant, model, version},
                                             [&](const Row& row) { found = ReadVersion(row); }));
  if (found) return *std::move(found);
  return absl::NotFoundError(absl::StrCat("model '", model, "' has no version ", version));
}

absl::Status CheckUnused(const Context& context, Connection& connection, const std::string& model,
                         int64_t version) {
  std::string user;
  METAEKF_RETURN_IF_ERROR(connection.Execute(
      "SELECT 'alias ' || alias FROM aliases WHERE tenant = ?1 AND model = ?2 AND version = ?3 "
      "UNION ALL SELECT 'adaptation ' || id FROM adaptations "
      "WHERE tenant = ?1 AND model = ?2 AND version = ?3 LIMIT 1",
      {context.tenant, model, version}, [&](const Row& row) { user = row.Text(0); }));
  if (user.empty()) return absl::OkStatus();
  return absl::FailedPreconditionError(absl::StrCat(
      "version ", version, " of model '", model, "' is in use by ", user, "; delete that first"));
}

std::string VersionResource(const std::string& model, int64_t version) {
  return absl::StrCat("models/", model, "/versions/", version);
}

std::string AliasResource(const std::string& model, const std::string& alias) {
  return absl::StrCat("models/", model, "/aliases/", alias);
}

}  // namespace

absl::StatusOr<ModelVersion> InsertVersion(const Context& context, Connection& connection,
                                           const std::string& model, StagedBlob& file,
                                           const std::string& metadata_json) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  METAEKF_ASSIGN_OR_RETURN(const int64_t number,
                           NextNumber(context, connection, absl::StrCat("version of ", model)));
  // To microseconds, as it will be read back.
  const int64_t now = absl::ToUnixMicros(context.clock());
  ModelVersion version{
      model, number, file.digest(), file.size_bytes(), metadata_json, absl::FromUnixMicros(now)};
  METAEKF_RETURN_IF_ERROR(connection.Execute(
      "INSERT INTO versions VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
      {context.tenant, model, number, version.digest, version.size_bytes, metadata_json, now}));
  METAEKF_RETURN_IF_ERROR(
      Audit(context, connection, "CreateModelVersion", VersionResource(model, number)));
  METAEKF_RETURN_IF_ERROR(context.blobs.Publish(file));
  return version;
}

absl::StatusOr<ModelVersion> ModelStore::AddVersion(const std::string& model, StagedBlob file,
                                                    const std::string& metadata_json,
                                                    const RequestId& request) {
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<ModelVersion> {
    METAEKF_ASSIGN_OR_RETURN(const auto before,
                             FindRequest(context_, connection, kRequestKind, request));
    if (before) return FindVersion(context_, connection, before->name, before->number);
    METAEKF_RETURN_IF_ERROR(CheckMayStore(context_, connection, file.size_bytes()));
    METAEKF_ASSIGN_OR_RETURN(ModelVersion version,
                             InsertVersion(context_, connection, model, file, metadata_json));
    METAEKF_RETURN_IF_ERROR(
        RecordRequest(context_, connection, kRequestKind, request, {model, version.version}));
    return version;
  });
}

absl::StatusOr<Model> ModelStore::Get(const std::string& model) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Model> {
    std::optional<Model> found;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        absl::StrCat(kSelectModel, "AND model = ?2 GROUP BY model"), {context_.tenant, model},
        [&](const Row& row) { found = ReadModel(row); }));
    if (!found) return NoSuchModel(model);
    METAEKF_RETURN_IF_ERROR(ReadAliases(context_, connection, *found));
    return *std::move(found);
  });
}

absl::StatusOr<Page<Model>> ModelStore::List(const PageRequest& request) {
  const std::string list = "models";
  METAEKF_ASSIGN_OR_RETURN(const PageCursor cursor, ParsePage(list, request));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Page<Model>> {
    std::vector<Model> models;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        absl::StrCat(kSelectModel, "AND model > ?2 GROUP BY model ORDER BY model LIMIT ?3"),
        {context_.tenant, cursor.after, cursor.size + 1},
        [&](const Row& row) { models.push_back(ReadModel(row)); }));
    for (Model& model : models) {
      METAEKF_RETURN_IF_ERROR(ReadAliases(context_, connection, model));
    }
    return MakePage(list, cursor, std::move(models), [](const Model& model) { return model.name; });
  });
}

absl::StatusOr<ModelVersion> ModelStore::GetVersion(const std::string& model, int64_t version) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  return context_.database.Read(
      [&](Connection& connection) { return FindVersion(context_, connection, model, version); });
}

absl::StatusOr<ModelVersion> ModelStore::GetLatest(const std::string& model) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<ModelVersion> {
    std::optional<ModelVersion> found;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        absl::StrCat(kSelectVersion, "ORDER BY version DESC LIMIT 1"), {context_.tenant, model},
        [&](const Row& row) { found = ReadVersion(row); }));
    if (!found) return NoSuchModel(model);
    return *std::move(found);
  });
}

absl::StatusOr<ModelVersion> ModelStore::GetByAlias(const std::string& model,
                                                    const std::string& alias) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  METAEKF_RETURN_IF_ERROR(CheckAlias(alias));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<ModelVersion> {
    std::optional<ModelVersion> found;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        absl::StrCat(kSelectVersion,
                     "AND version = (SELECT version FROM aliases "
                     "WHERE tenant = ?1 AND model = ?2 AND alias = ?3)"),
        {context_.tenant, model, alias}, [&](const Row& row) { found = ReadVersion(row); }));
    if (!found) return NoSuchAlias(model, alias);
    return *std::move(found);
  });
}

absl::StatusOr<Page<ModelVersion>> ModelStore::ListVersions(const std::string& model,
                                                            const PageRequest& request) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  const std::string list = absl::StrCat("versions of ", model);
  METAEKF_ASSIGN_OR_RETURN(const PageCursor cursor, ParsePage(list, request));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Page<ModelVersion>> {
    std::vector<ModelVersion> versions;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        absl::StrCat(kSelectVersion, "AND version < ?3 ORDER BY version DESC LIMIT ?4"),
        {context_.tenant, model, NumberLimit(cursor), cursor.size + 1},
        [&](const Row& row) { versions.push_back(ReadVersion(row)); }));
    if (versions.empty() && cursor.after.empty()) return NoSuchModel(model);
    return MakePage(list, cursor, std::move(versions),
                    [](const ModelVersion& version) { return absl::StrCat(version.version); });
  });
}

absl::StatusOr<std::string> ModelStore::ReadFile(const ModelVersion& version) {
  auto bytes = context_.blobs.Read(
      version.digest, absl::StrCat("model '", version.model, "' version ", version.version));
  // A version deleted meanwhile is no loss.
  if (!bytes.ok()) {
    METAEKF_RETURN_IF_ERROR(GetVersion(version.model, version.version).status());
  }
  return bytes;
}

absl::Status ModelStore::SetAlias(const std::string& model, const std::string& alias,
                                  int64_t version) {
  METAEKF_RETURN_IF_ERROR(CheckName("model name", model));
  METAEKF_RETURN_IF_ERROR(CheckAlias(alias));
  return context_.database.Write([&](Connection& connection) -> absl::Status {
    METAEKF_RETURN_IF_ERROR(FindVersion(context_, connection, model, version).status());
    METAEKF_RETURN_IF_ERROR(
        connection.Execute("INSERT INTO aliases VALUES (?1, ?2, ?3, ?4) "
                           "ON CONFLICT DO UPDATE SET version = excluded.version",
                           {context_.tenant, model, alias, version}));
    return Audit(context_, connection, "SetModelAlias", AliasResource(model, alias),
                 VersionResource(model, version));
  });
}

absl::Status ModelStore::DeleteAlias(const std::string& model, const std::string& alias) {
  return context_.database.Write([&](Connection& connection) -> absl::Status {
    METAEKF_RETURN_IF_ERROR(
        connection.Execute("DELETE FROM aliases WHERE tenant = ?1 AND model = ?2 AND alias = ?3",
                           {context_.tenant, model, alias}));
    if (connection.changes() == 0) return NoSuchAlias(model, alias);
    return Audit(context_, connection, "DeleteModelAlias", AliasResource(model, alias));
  });
}

absl::Status ModelStore::DeleteVersion(const std::string& model, int64_t version) {
  METAEKF_ASSIGN_OR_RETURN(
      const ModelVersion deleted,
      context_.database.Write([&](Connection& connection) -> absl::StatusOr<ModelVersion> {
        METAEKF_RETURN_IF_ERROR(CheckUnused(context_, connection, model, version));
        METAEKF_ASSIGN_OR_RETURN(ModelVersion found,
                                 FindVersion(context_, connection, model, version));
        METAEKF_RETURN_IF_ERROR(connection.Execute(
            "DELETE FROM versions WHERE tenant = ?1 AND model = ?2 AND version = ?3",
            {context_.tenant, model, version}));
        METAEKF_RETURN_IF_ERROR(Audit(context_, connection, "DeleteModelVersion",
                                      VersionResource(model, version)));
        return found;
      }));
  RemoveIfUnreferenced(context_, deleted.digest);
  return absl::OkStatus();
}

}  // namespace metaekf::store
