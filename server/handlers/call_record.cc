#include "server/handlers/call_record.h"

#include <spdlog/spdlog.h>

#include <algorithm>

#include "absl/strings/ascii.h"
#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "server/status/grpc_status.h"

namespace metaekf::server {
namespace {

constexpr char kRequestId[] = "x-request-id";
constexpr size_t kMaxIdBytes = 64;

/// Names of requests of this server: no two are the same.
std::string NewRequestId() {
  static std::atomic<uint64_t> count{0};
  static const std::string start = absl::StrCat(absl::Hex(absl::ToUnixMicros(absl::Now())));
  return absl::StrCat(start, "-", ++count);
}

/// What a client sends goes into the log: nothing but what an id needs.
bool IsId(absl::string_view text) {
  return !text.empty() && text.size() <= kMaxIdBytes && std::all_of(text.begin(), text.end(), [](char c) {
    return absl::ascii_isalnum(c) || c == '-' || c == '_' || c == '.';
  });
}

std::string RequestIdOf(const grpc::CallbackServerContext& call) {
  const auto found = call.client_metadata().find(kRequestId);
  if (found == call.client_metadata().end()) return NewRequestId();
  const std::string given(found->second.data(), found->second.size());
  return IsId(given) ? given : NewRequestId();
}

}  // namespace

void LiveCalls::Add() {
  std::lock_guard lock(mutex_);
  ++count_;
}

void LiveCalls::Remove() {
  std::lock_guard lock(mutex_);
  if (--count_ == 0) changed_.notify_all();
}

void LiveCalls::WaitForNone(absl::Time deadline) {
  std::unique_lock lock(mutex_);
  changed_.wait_until(lock, absl::ToChronoTime(deadline), [this] { return count_ == 0; });
}

CallRecord::CallRecord(const Rpc& rpc, grpc::CallbackServerContext& call, std::shared_ptr<Metrics> metrics,
                       LiveCalls& live)
    : rpc_(rpc), metrics_(std::move(metrics)), live_(live), start_(absl::Now()), request_id_(RequestIdOf(call)) {
  call.AddTrailingMetadata(kRequestId, request_id_);
  live_.Add();
}

CallRecord::~CallRecord() { live_.Remove(); }

void CallRecord::SetCaller(const Caller& caller) {
  tenant_ = caller.tenant;
  identity_ = caller.identity;
}

grpc::Status CallRecord::End(const absl::Status& status) {
  if (!ended_.exchange(true)) {
    const absl::Duration duration = absl::Now() - start_;
    metrics_->CountCall(rpc_.name, absl::StatusCodeToString(status.code()), duration);
    Log(status, duration);
  }
  return ToGrpcStatus(status);
}

void CallRecord::Log(const absl::Status& status, absl::Duration duration) const {
  // Calls that look at something and find it are many, and tell little.
  const bool worth_it = !status.ok() || rpc_.scope > store::Scope::kRead;
  const auto level = worth_it ? spdlog::level::info : spdlog::level::debug;
  if (!spdlog::should_log(level)) return;
  std::string line =
      absl::StrCat("call=", rpc_.name, " request_id=", request_id_, " code=", absl::StatusCodeToString(status.code()),
                   " duration_ms=", absl::ToDoubleMilliseconds(duration));
  if (!identity_.empty()) absl::StrAppend(&line, " tenant=", tenant_, " identity=\"", identity_, "\"");
  if (!status.ok()) absl::StrAppend(&line, " error=\"", absl::CHexEscape(status.message()), "\"");
  spdlog::log(level, "{}", line);
}

}  // namespace metaekf::server
