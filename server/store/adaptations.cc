#include "server/store/adaptations.h"

#include "core/base/status.h"
#include "server/store/audit.h"
#include "server/store/names.h"

namespace metaekf::store {
namespace {

std::string Resource(const std::string& id) { return absl::StrCat("adaptations/", id); }

constexpr const char* kRequestKind = "adaptation";
constexpr const char* kSelect =
    "SELECT id, model, version, digest, size_bytes, receipt_json, create_time FROM adaptations "
    "WHERE tenant = ?1 ";

Adaptation ReadAdaptation(const Row& row) {
  return {row.Text(0),
          row.Text(1),
          row.Int(2),
          row.Text(3),
          row.Int(4),
          row.Text(5),
          absl::FromUnixMicros(row.Int(6))};
}

absl::StatusOr<Adaptation> Find(const Context& context, Connection& connection,
                                const std::string& id) {
  std::optional<Adaptation> found;
  METAEKF_RETURN_IF_ERROR(connection.Execute(absl::StrCat(kSelect, "AND id = ?2"),
                                             {context.tenant, id},
                                             [&](const Row& row) { found = ReadAdaptation(row); }));
  if (found) return *std::move(found);
  return absl::NotFoundError(absl::StrCat("there is no adaptation '", id, "'"));
}

/// "a1", "a2", …, passing over those that someone has chosen.
absl::StatusOr<std::string> ChooseId(const Context& context, Connection& connection) {
  while (true) {
    METAEKF_ASSIGN_OR_RETURN(const int64_t number, NextNumber(context, connection, "adaptation"));
    std::string id = absl::StrCat("a", number);
    const absl::Status taken = Find(context, connection, id).status();
    if (absl::IsNotFound(taken)) return id;
    METAEKF_RETURN_IF_ERROR(taken);
  }
}

absl::StatusOr<Adaptation> Insert(const Context& context, Connection& connection,
                                  NewAdaptation& wanted) {
  const int64_t now = absl::ToUnixMicros(context.clock());
  Adaptation adaptation{wanted.id,
                        wanted.model,
                        wanted.version,
                        wanted.file.digest(),
                        wanted.file.size_bytes(),
                        wanted.receipt_json,
                        absl::FromUnixMicros(now)};
  if (adaptation.id.empty()) {
    METAEKF_ASSIGN_OR_RETURN(adaptation.id, ChooseId(context, connection));
  }
  METAEKF_RETURN_IF_ERROR(connection.Execute(
      "INSERT INTO adaptations SELECT ?1, ?2, model, version, ?5, ?6, ?7, ?8 FROM versions "
      "WHERE tenant = ?1 AND model = ?3 AND version = ?4",
      {context.tenant, adaptation.id, adaptation.model, adaptation.version, adaptation.digest,
       adaptation.size_bytes, adaptation.receipt_json, now}));
  if (connection.changes() == 0) {
    return absl::NotFoundError(absl::StrCat("model '", wanted.model, "' has no version ",
                                            wanted.version, " to keep an adaptation of"));
  }
  METAEKF_RETURN_IF_ERROR(
      Audit(context, connection, "CreateAdaptation", Resource(adaptation.id),
            absl::StrCat("models/", adaptation.model, "/versions/", adaptation.version)));
  METAEKF_RETURN_IF_ERROR(context.blobs.Publish(wanted.file));
  return adaptation;
}

}  // namespace

absl::StatusOr<Adaptation> AdaptationStore::Create(NewAdaptation wanted) {
  if (!wanted.id.empty()) METAEKF_RETURN_IF_ERROR(CheckName("adaptation id", wanted.id));
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<Adaptation> {
    METAEKF_ASSIGN_OR_RETURN(const auto before,
                             FindRequest(context_, connection, kRequestKind, wanted.request));
    if (before) return Find(context_, connection, before->name);
    const absl::Status taken = Find(context_, connection, wanted.id).status();
    if (taken.ok()) {
      return absl::AlreadyExistsError(absl::StrCat("there is an adaptation '", wanted.id,
                                                   "'; choose another id or delete that one"));
    }
    if (!absl::IsNotFound(taken)) return taken;
    METAEKF_RETURN_IF_ERROR(CheckMayAdaptation(context_, connection));
    METAEKF_RETURN_IF_ERROR(CheckMayStore(context_, connection, wanted.file.size_bytes()));
    METAEKF_ASSIGN_OR_RETURN(Adaptation adaptation, Insert(context_, connection, wanted));
    METAEKF_RETURN_IF_ERROR(
        RecordRequest(context_, connection, kRequestKind, wanted.request, {adaptation.id, 0}));
    return adaptation;
  });
}

absl::StatusOr<std::optional<Adaptation>> AdaptationStore::FindByRequest(const RequestId& request) {
  using Found = absl::StatusOr<std::optional<Adaptation>>;
  return context_.database.Read([&](Connection& connection) -> Found {
    METAEKF_ASSIGN_OR_RETURN(const auto before,
                             FindRequest(context_, connection, kRequestKind, request));
    if (!before) return std::nullopt;
    return Find(context_, connection, before->name);
  });
}

absl::StatusOr<Adaptation> AdaptationStore::Get(const std::string& id) {
  METAEKF_RETURN_IF_ERROR(CheckName("adaptation id", id));
  return context_.database.Read(
      [&](Connection& connection) { return Find(context_, connection, id); });
}

absl::StatusOr<Page<Adaptation>> AdaptationStore::List(const PageRequest& request) {
  const std::string list = "adaptations";
  METAEKF_ASSIGN_OR_RETURN(const PageCursor cursor, ParsePage(list, request));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Page<Adaptation>> {
    std::vector<Adaptation> adaptations;
    METAEKF_RETURN_IF_ERROR(
        connection.Execute(absl::StrCat(kSelect, "AND id > ?2 ORDER BY id LIMIT ?3"),
                           {context_.tenant, cursor.after, cursor.size + 1},
                           [&](const Row& row) { adaptations.push_back(ReadAdaptation(row)); }));
    return MakePage(list, cursor, std::move(adaptations),
                    [](const Adaptation& adaptation) { return adaptation.id; });
  });
}

absl::Status AdaptationStore::Delete(const std::string& id) {
  METAEKF_ASSIGN_OR_RETURN(
      const Adaptation deleted,
      context_.database.Write([&](Connection& connection) -> absl::StatusOr<Adaptation> {
        METAEKF_ASSIGN_OR_RETURN(Adaptation found, Find(context_, connection, id));
        METAEKF_RETURN_IF_ERROR(connection.Execute(
            "DELETE FROM adaptations WHERE tenant = ?1 AND id = ?2", {context_.tenant, id}));
        METAEKF_RETURN_IF_ERROR(Audit(context_, connection, "DeleteAdaptation", Resource(id)));
        return found;
      }));
  RemoveIfUnreferenced(context_, deleted.digest);
  return absl::OkStatus();
}

absl::StatusOr<std::string> AdaptationStore::ReadFile(const Adaptation& adaptation) {
  auto bytes =
      context_.blobs.Read(adaptation.digest, absl::StrCat("adaptation '", adaptation.id, "'"));
  // One deleted meanwhile is no loss.
  if (!bytes.ok()) METAEKF_RETURN_IF_ERROR(Get(adaptation.id).status());
  return bytes;
}

}  // namespace metaekf::store
