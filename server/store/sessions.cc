#include "server/store/sessions.h"

#include <optional>

#include "core/base/status.h"
#include "server/store/audit.h"
#include "server/store/secret.h"

namespace metaekf::store {
namespace {

constexpr const char* kSelect =
    "SELECT number, target, settings, epoch, durable_seq, checkpoint, create_time FROM sessions "
    "WHERE tenant = ?1 ";

Session ReadSession(const Row& row) {
  return {row.Int(0),
          row.Text(1),
          row.Text(2),
          row.Int(3),
          row.Int(4),
          row.Text(5),
          absl::FromUnixMicros(row.Int(6))};
}

absl::StatusOr<Session> Find(const Context& context, Connection& connection, int64_t number) {
  std::optional<Session> found;
  METAEKF_RETURN_IF_ERROR(connection.Execute(absl::StrCat(kSelect, "AND number = ?2"),
                                             {context.tenant, number},
                                             [&](const Row& row) { found = ReadSession(row); }));
  if (found) return *std::move(found);
  return absl::NotFoundError(absl::StrCat("there is no session ", number));
}

std::string Resource(int64_t number) { return absl::StrCat("sessions/", number); }

}  // namespace

absl::StatusOr<NewSession> SessionStore::Create(const std::string& target,
                                                const std::string& settings) {
  METAEKF_ASSIGN_OR_RETURN(const std::string token, NewSecret());
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<NewSession> {
    METAEKF_RETURN_IF_ERROR(CheckMaySession(context_, connection));
    METAEKF_ASSIGN_OR_RETURN(const int64_t number, NextNumber(context_, connection, "session"));
    const int64_t now = absl::ToUnixMicros(context_.clock());
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "INSERT INTO sessions (tenant, number, token_digest, target, settings, epoch, create_time) "
        "VALUES (?1, ?2, ?3, ?4, ?5, 1, ?6)",
        {context_.tenant, number, Sha256Hex(token), target, Bytes{settings}, now}));
    METAEKF_RETURN_IF_ERROR(
        Audit(context_, connection, "OpenSession", Resource(number), target));
    METAEKF_ASSIGN_OR_RETURN(Session session, Find(context_, connection, number));
    return NewSession{std::move(session), token};
  });
}

absl::StatusOr<Session> SessionStore::Claim(int64_t number, const std::string& token) {
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<Session> {
    METAEKF_RETURN_IF_ERROR(
        connection.Execute("UPDATE sessions SET epoch = epoch + 1 "
                           "WHERE tenant = ?1 AND number = ?2 AND token_digest = ?3",
                           {context_.tenant, number, Sha256Hex(token)}));
    if (connection.changes() == 0) {
      return absl::NotFoundError(absl::StrCat("there is no session ", number, " with this token"));
    }
    METAEKF_ASSIGN_OR_RETURN(Session session, Find(context_, connection, number));
    METAEKF_RETURN_IF_ERROR(
        Audit(context_, connection, "ResumeSession", Resource(number), session.target));
    return session;
  });
}

absl::StatusOr<Session> SessionStore::Get(int64_t number) {
  return context_.database.Read(
      [&](Connection& connection) { return Find(context_, connection, number); });
}

absl::StatusOr<Page<Session>> SessionStore::List(const PageRequest& request) {
  const std::string list = "sessions";
  METAEKF_ASSIGN_OR_RETURN(const PageCursor cursor, ParsePage(list, request));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Page<Session>> {
    std::vector<Session> sessions;
    METAEKF_RETURN_IF_ERROR(
        connection.Execute(absl::StrCat(kSelect, "AND number < ?2 ORDER BY number DESC LIMIT ?3"),
                           {context_.tenant, NumberLimit(cursor), cursor.size + 1},
                           [&](const Row& row) { sessions.push_back(ReadSession(row)); }));
    return MakePage(list, cursor, std::move(sessions),
                    [](const Session& session) { return absl::StrCat(session.number); });
  });
}

absl::Status SessionStore::Delete(int64_t number) {
  return context_.database.Write([&](Connection& connection) -> absl::Status {
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "DELETE FROM sessions WHERE tenant = ?1 AND number = ?2", {context_.tenant, number}));
    if (connection.changes() == 0) {
      return absl::NotFoundError(absl::StrCat("there is no session ", number));
    }
    return Audit(context_, connection, "DeleteSession", Resource(number));
  });
}

absl::StatusOr<std::vector<bool>> SaveCheckpoints(
    Database& database, const std::vector<SessionCheckpoint>& checkpoints) {
  return database.Write([&](Connection& connection) -> absl::StatusOr<std::vector<bool>> {
    std::vector<bool> written;
    for (const SessionCheckpoint& checkpoint : checkpoints) {
      METAEKF_RETURN_IF_ERROR(
          connection.Execute("UPDATE sessions SET durable_seq = ?4, checkpoint = ?5 "
                             "WHERE tenant = ?1 AND number = ?2 AND epoch = ?3",
                             {checkpoint.tenant, checkpoint.number, checkpoint.epoch,
                              checkpoint.durable_seq, Bytes{checkpoint.checkpoint}}));
      written.push_back(connection.changes() > 0);
    }
    return written;
  });
}

}  // namespace metaekf::store
