#include <map>

#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/records.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

using client::Scope;

const std::map<std::string, Scope>& Scopes() {
  static const std::map<std::string, Scope> scopes = {{"read", Scope::kRead},
                                                      {"stream", Scope::kStream},
                                                      {"write", Scope::kWrite},
                                                      {"admin", Scope::kAdmin}};
  return scopes;
}

std::string Word(Scope scope) {
  for (const auto& [word, value] : Scopes()) {
    if (value == scope) return word;
  }
  return "unknown";
}

Record ToRecord(const std::optional<client::Time>& time) {
  return time ? cli::ToRecord(*time) : Record();
}

Record ToRecord(const client::Token& token) {
  return {{"id", token.id},
          {"tenant", token.tenant},
          {"scope", Word(token.scope)},
          {"note", token.note},
          {"create_time", cli::ToRecord(token.create_time)},
          {"expire_time", ToRecord(token.expire_time)},
          {"revoke_time", ToRecord(token.revoke_time)}};
}

absl::Status Create(Console& console, const client::TokenRequest& request) {
  METAEKF_ASSIGN_OR_RETURN(const client::NewToken made, ToAbsl(console.client().CreateToken(request)));
  Record record = ToRecord(made.token);
  record["secret"] = made.secret;
  PrintRecord(console, record);
  console.err << "The secret is not kept: this is the only time that it is shown.\n";
  return absl::OkStatus();
}

absl::Status List(Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const auto tokens, ToAbsl(console.client().ListTokens()));
  std::vector<Record> records;
  for (const client::Token& token : tokens) records.push_back(ToRecord(token));
  PrintRecords(console,
               {"id", "tenant", "scope", "note", "create_time", "expire_time", "revoke_time"},
               records);
  return absl::OkStatus();
}

absl::Status Revoke(Console& console, const std::string& id) {
  METAEKF_ASSIGN_OR_RETURN(const client::Token token, ToAbsl(console.client().RevokeToken(id)));
  PrintRecord(console, ToRecord(token));
  return absl::OkStatus();
}

absl::Status PrintAudit(Console& console, const std::string& tenant, size_t most) {
  METAEKF_ASSIGN_OR_RETURN(const auto entries,
                           ToAbsl(console.client().ListAuditEntries(tenant, most)));
  std::vector<Record> records;
  for (const client::AuditEntry& entry : entries) {
    records.push_back({{"number", entry.number},
                       {"time", cli::ToRecord(entry.time)},
                       {"tenant", entry.tenant},
                       {"identity", entry.identity},
                       {"action", entry.action},
                       {"resource", entry.resource},
                       {"detail", entry.detail}});
  }
  PrintRecords(console,
               {"number", "time", "tenant", "identity", "action", "resource", "detail"}, records);
  return absl::OkStatus();
}

void AddTokens(CLI::App& admin, Console& console, Command& chosen) {
  auto* tokens = admin.add_subcommand("tokens", "Who may use the server")->require_subcommand(1);
  auto* create = tokens->add_subcommand("create", "Make a token and show its secret, once");
  struct Given {
    client::TokenRequest request{.tenant = "default"};
    std::string scope;
    double lifetime_days = 0;
  };
  auto given = std::make_shared<Given>();
  create->add_option("--tenant", given->request.tenant, "Whose things its holder works with")
      ->capture_default_str();
  create->add_option("--scope", given->scope,
                     "read: look and predict; stream: also have sessions of estimates; write: also "
                     "make, change and delete; admin: also look after the server")
      ->required()
      ->check(CLI::IsMember({"read", "stream", "write", "admin"}));
  create->add_option("--days", given->lifetime_days, "Expires after so many days; default: never")
      ->check(CLI::PositiveNumber);
  create->add_option("--note", given->request.note, "For whom it is");
  OnChosen(create, chosen, [&console, given] {
    client::TokenRequest request = given->request;
    request.scope = Scopes().at(given->scope);
    if (given->lifetime_days > 0) request.lifetime_s = 86400 * given->lifetime_days;
    return Create(console, request);
  });
  OnChosen(tokens->add_subcommand("list", "All, expired and revoked ones too"), chosen,
           [&console] { return List(console); });
  auto* revoke = tokens->add_subcommand("revoke", "From now on no call with this token begins");
  auto id = std::make_shared<std::string>();
  revoke->add_option("ID", *id, "The token's id, as \"list\" shows it")->required();
  OnChosen(revoke, chosen, [&console, id] { return Revoke(console, *id); });
}

}  // namespace

void AddAdmin(CLI::App& app, Console& console, Command& chosen) {
  auto* admin = app.add_subcommand("admin", "Look after a server")->require_subcommand(1);
  AddTokens(*admin, console, chosen);
  AddBackups(*admin, console, chosen);
  auto* audit = admin->add_subcommand("audit", "Who did what, the newest first");
  auto tenant = std::make_shared<std::string>();
  auto most = std::make_shared<size_t>(50);
  audit->add_option("--tenant", *tenant, "Of one tenant; default: of all");
  audit->add_option("--last", *most, "So many entries")->check(CLI::PositiveNumber)->capture_default_str();
  OnChosen(audit, chosen, [&console, tenant, most] { return PrintAudit(console, *tenant, *most); });
}

}  // namespace metaekf::cli
