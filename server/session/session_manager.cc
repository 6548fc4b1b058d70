#include "server/session/session_manager.h"

#include <spdlog/spdlog.h>

#include <chrono>
#include <optional>

#include "absl/time/clock.h"
#include "core/base/status.h"
#include "server/convert/time.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

constexpr size_t kMostWaiting = 16;  // checkpoints of one session: of a client that tells late

/// What of a session may become durable now: sample number and checkpoint; nothing if that is so already. With its mutex held.
std::optional<std::pair<uint64_t, std::string>> NextDurable(LiveSession& live) {
  const uint64_t applied = live.session->applied_seq();
  if (!live.received_seq) return std::pair(applied, live.session->Checkpoint());
  if (live.waiting.empty() || live.waiting.back().first < applied) {
    if (live.waiting.size() == kMostWaiting) live.waiting.pop_back();
    live.waiting.emplace_back(applied, live.session->Checkpoint());
  }
  std::optional<std::pair<uint64_t, std::string>> next;
  while (!live.waiting.empty() && live.waiting.front().first <= *live.received_seq) {
    next = std::move(live.waiting.front());
    live.waiting.pop_front();
  }
  return next;
}

}  // namespace

SessionManager::SessionManager(store::Store& store, ModelCache& models, std::shared_ptr<Metrics> metrics, absl::Duration period)
    : store_(store),
      models_(models),
      metrics_(std::move(metrics)),
      period_(absl::ToChronoNanoseconds(period)),
      checkpoints_([this] { RunCheckpoints(); }) {}

SessionManager::~SessionManager() {
  {
    std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  changed_.notify_all();
  checkpoints_.join();
  Flush();
}

void SessionManager::RunCheckpoints() {
  std::unique_lock lock(mutex_);
  while (!stopping_) {
    if (period_.count() > 0) {
      changed_.wait_for(lock, period_, [this] { return stopping_; });
    } else {
      changed_.wait(lock, [this] { return stopping_ || closed_; });
    }
    closed_ = false;
    if (dirty_.empty() || stopping_) continue;
    lock.unlock();
    Flush();
    lock.lock();
  }
}

absl::StatusOr<std::shared_ptr<LiveSession>> SessionManager::Open(store::TenantStore& mine, const v1::OpenSession& open) {
  METAEKF_ASSIGN_OR_RETURN(const std::shared_ptr<const ServedModel> model, models_.Get(mine.tenant(), "open.target", open.target()));
  // What is stored is the version that the name means now: a resumed session goes on with the same weights.
  v1::OpenSession settings = open;
  settings.set_target(model->adaptation.empty() ? model->model_version : model->adaptation);
  METAEKF_ASSIGN_OR_RETURN(std::unique_ptr<Session> session, Session::Open(model, settings));
  METAEKF_ASSIGN_OR_RETURN(const store::NewSession made,
                           mine.sessions().Create(settings.target(), settings.SerializeAsString()));
  return Attach(mine.tenant(), made.session, made.token, std::move(session), model->filter_model);
}

absl::StatusOr<std::shared_ptr<LiveSession>> SessionManager::Resume(store::TenantStore& mine, const v1::ResumeSession& resume) {
  METAEKF_ASSIGN_OR_RETURN(const int64_t number, ParseSessionName("resume.session", resume.session()));
  // What an earlier stream applied here need not be sent again.
  Flush();
  const absl::StatusOr<store::Session> claimed = mine.sessions().Claim(number, resume.token());
  if (absl::IsResourceExhausted(claimed.status())) return WithRetryDelay(claimed.status(), absl::Seconds(1));  // of room on the disk
  METAEKF_ASSIGN_OR_RETURN(const store::Session stored, claimed);
  v1::OpenSession settings;
  if (!settings.ParseFromString(stored.settings)) return absl::DataLossError("the session's settings are damaged");
  METAEKF_ASSIGN_OR_RETURN(const std::shared_ptr<const ServedModel> model, models_.Get(mine.tenant(), "target", settings.target()));
  METAEKF_ASSIGN_OR_RETURN(std::unique_ptr<Session> session, Session::Open(model, settings));
  if (!stored.checkpoint.empty()) {
    const std::shared_ptr<BatchQueue> queue = QueueOf(model->filter_model);
    std::unique_ptr<filter::FilterModel::Scratch> scratch = queue->Take();
    const absl::Status restored = session->Restore(stored.checkpoint, scratch.get());
    queue->GiveBack(std::move(scratch));
    METAEKF_RETURN_IF_ERROR(restored);
  }
  return Attach(mine.tenant(), stored, "", std::move(session), model->filter_model);
}

std::shared_ptr<LiveSession> SessionManager::Attach(const std::string& tenant, const store::Session& stored, const std::string& token, std::unique_ptr<Session> session,
                                                    const std::shared_ptr<const filter::FilterModel>& model) {
  auto live = std::make_shared<LiveSession>();
  live->tenant = tenant;
  live->number = stored.number;
  live->epoch = static_cast<uint64_t>(stored.epoch);
  live->token = token;
  live->durable_seq = static_cast<uint64_t>(stored.durable_seq);
  live->session = std::move(session);
  live->queue = QueueOf(model);
  std::shared_ptr<LiveSession> before;
  {
    std::lock_guard lock(mutex_);
    before = std::exchange(live_[{tenant, stored.number}], live);
  }
  if (before != nullptr) {
    std::lock_guard lock(before->mutex);
    before->taken_over = true;
  }
  return live;
}

std::shared_ptr<BatchQueue> SessionManager::QueueOf(const std::shared_ptr<const filter::FilterModel>& model) {
  std::lock_guard lock(mutex_);
  std::erase_if(queues_, [](const std::weak_ptr<BatchQueue>& queue) { return queue.expired(); });
  for (const std::weak_ptr<BatchQueue>& weak : queues_) {
    std::shared_ptr<BatchQueue> queue = weak.lock();
    if (queue != nullptr && queue->model() == model) return queue;
  }
  auto queue = std::make_shared<BatchQueue>(model);
  queues_.push_back(queue);
  return queue;
}

void SessionManager::MarkDirty(const std::shared_ptr<LiveSession>& live) {
  std::lock_guard lock(mutex_);
  if (dirty_.empty()) dirty_since_ = absl::Now();
  dirty_.insert(live);
}

void SessionManager::Close(const std::shared_ptr<LiveSession>& live, bool all_arrived) {
  if (all_arrived) {
    {
      std::lock_guard lock(live->mutex);
      if (live->received_seq) live->received_seq = live->session->applied_seq();
    }
    MarkDirty(live);
  }
  std::lock_guard lock(mutex_);
  const auto it = live_.find({live->tenant, live->number});
  if (it != live_.end() && it->second == live) live_.erase(it);
  closed_ = true;
  if (period_.count() == 0) changed_.notify_all();
}

void SessionManager::Flush() {
  std::lock_guard one_at_a_time(flush_mutex_);
  std::vector<std::shared_ptr<LiveSession>> sessions;
  {
    std::lock_guard lock(mutex_);
    sessions.assign(dirty_.begin(), dirty_.end());
    dirty_.clear();
    flushed_since_ = std::exchange(dirty_since_, absl::InfiniteFuture());
  }
  if (sessions.empty()) return;
  std::vector<store::SessionCheckpoint> checkpoints;
  std::erase_if(sessions, [&](const std::shared_ptr<LiveSession>& live) {
    std::lock_guard lock(live->mutex);
    std::optional<std::pair<uint64_t, std::string>> next = NextDurable(*live);
    if (!next) return true;
    checkpoints.push_back({live->tenant, live->number, static_cast<int64_t>(live->epoch), static_cast<int64_t>(next->first),
                           std::move(next->second)});
    return false;
  });
  if (sessions.empty()) {
    std::lock_guard lock(mutex_);
    flushed_since_ = absl::InfiniteFuture();
    return;
  }
  const absl::Time start = absl::Now();
  const absl::StatusOr<std::vector<bool>> written = store_.SaveCheckpoints(checkpoints);
  {
    std::lock_guard lock(mutex_);
    const absl::Time since = std::exchange(flushed_since_, absl::InfiniteFuture());
    if (!written.ok()) dirty_since_ = std::min(dirty_since_, since);
  }
  if (!written.ok()) {
    // Nothing became durable; clients keep their samples. The next commit tries again.
    spdlog::error("checkpoints of {} sessions not written: {}", sessions.size(), written.status().ToString());
    for (size_t i = 0; i < sessions.size(); ++i) {
      std::lock_guard lock(sessions[i]->mutex);
      if (!sessions[i]->received_seq) continue;
      sessions[i]->waiting.emplace_front(static_cast<uint64_t>(checkpoints[i].durable_seq), std::move(checkpoints[i].checkpoint));
    }
    std::lock_guard lock(mutex_);
    dirty_.insert(sessions.begin(), sessions.end());
    return;
  }
  metrics_->CountCheckpoints(static_cast<int64_t>(sessions.size()), absl::Now() - start);
  for (size_t i = 0; i < sessions.size(); ++i) {
    std::lock_guard lock(sessions[i]->mutex);
    if ((*written)[i]) {
      sessions[i]->durable_seq = static_cast<uint64_t>(checkpoints[i].durable_seq);
    } else {
      sessions[i]->taken_over = true;
    }
  }
}

std::map<std::string, int64_t> SessionManager::CountStreaming() {
  std::lock_guard lock(mutex_);
  std::map<std::string, int64_t> counts;
  for (const auto& [key, live] : live_) ++counts[key.first];
  return counts;
}

absl::Duration SessionManager::CheckpointLag() {
  std::lock_guard lock(mutex_);
  const absl::Time since = std::min(dirty_since_, flushed_since_);
  return since == absl::InfiniteFuture() ? absl::ZeroDuration() : absl::Now() - since;
}

std::shared_ptr<LiveSession> SessionManager::FindLive(const std::string& tenant, int64_t number) {
  std::lock_guard lock(mutex_);
  const auto it = live_.find({tenant, number});
  return it == live_.end() ? nullptr : it->second;
}

v1::Session SessionManager::ToMessage(const std::string& tenant, const store::Session& stored) {
  v1::Session message;
  message.set_name(SessionName(stored.number));
  message.set_target(stored.target);
  message.set_epoch(static_cast<uint64_t>(stored.epoch));
  message.set_durable_seq(static_cast<uint64_t>(stored.durable_seq));
  *message.mutable_create_time() = ToTimestamp(stored.create_time);
  const std::shared_ptr<LiveSession> live = FindLive(tenant, stored.number);
  if (live != nullptr) {
    std::lock_guard lock(live->mutex);
    message.set_streaming(true);
    message.set_applied_seq(live->session->applied_seq());
  }
  return message;
}

absl::StatusOr<v1::Session> SessionManager::Get(store::TenantStore& mine, const std::string& name) {
  METAEKF_ASSIGN_OR_RETURN(const int64_t number, ParseSessionName("name", name));
  METAEKF_ASSIGN_OR_RETURN(const store::Session stored, mine.sessions().Get(number));
  return ToMessage(mine.tenant(), stored);
}

absl::StatusOr<v1::ListSessionsResponse> SessionManager::List(store::TenantStore& mine, const v1::ListSessionsRequest& request) {
  METAEKF_ASSIGN_OR_RETURN(const store::Page<store::Session> page,
                           mine.sessions().List({request.page_size(), request.page_token()}));
  v1::ListSessionsResponse response;
  for (const store::Session& stored : page.items) *response.add_sessions() = ToMessage(mine.tenant(), stored);
  response.set_next_page_token(page.next_page_token);
  return response;
}

absl::Status SessionManager::Delete(store::TenantStore& mine, const std::string& name) {
  METAEKF_ASSIGN_OR_RETURN(const int64_t number, ParseSessionName("name", name));
  METAEKF_RETURN_IF_ERROR(mine.sessions().Delete(number));
  const std::shared_ptr<LiveSession> live = FindLive(mine.tenant(), number);
  if (live != nullptr) {
    std::lock_guard lock(live->mutex);
    live->taken_over = true;
  }
  return absl::OkStatus();
}

}  // namespace metaekf::server
