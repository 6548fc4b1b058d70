#include "server/handlers/watch_call.h"

#include "server/convert/jobs.h"
#include "server/handlers/overload.h"
#include "server/names/resource_names.h"

namespace metaekf::server {

WatchCall::WatchCall(CallContext context, std::shared_ptr<CallRecord> record, const std::string& name)
    : context_(std::move(context)), record_(std::move(record)) {
  const auto job = ParseJobName("name", name);
  if (!job.ok()) {
    FinishWith(job.status());
    return;
  }
  job_ = *job;
  subscription_ = context_.server.jobs.Subscribe(
      {context_.caller.tenant, job_}, [this](JobFeed::Event event) { OnEvent(event); });
  std::unique_lock lock(mutex_);
  state_ = State::kIdle;
  Advance(std::move(lock));
}

void WatchCall::OnEvent(JobFeed::Event event) {
  std::unique_lock lock(mutex_);
  changed_ = true;
  if (event == JobFeed::Event::kClosed) {
    stop_ = absl::UnavailableError("the server stops; the job goes on when it is back");
  }
  Advance(std::move(lock));
}

void WatchCall::OnCancel() {
  std::unique_lock lock(mutex_);
  stop_ = absl::CancelledError("the call was cancelled");
  Advance(std::move(lock));
}

void WatchCall::OnWriteDone(bool ok) {
  std::unique_lock lock(mutex_);
  state_ = State::kIdle;
  if (ended_) stop_ = absl::OkStatus();
  if (!ok) stop_ = absl::CancelledError("the call was cancelled");
  Advance(std::move(lock));
}

void WatchCall::OnDone() {
  if (subscription_) context_.server.jobs.Unsubscribe(*subscription_);
  delete this;
}

void WatchCall::Advance(std::unique_lock<std::mutex> lock) {
  if (state_ != State::kIdle || (!stop_ && !changed_)) return;
  const std::optional<absl::Status> stop = stop_;
  state_ = stop ? State::kFinished : State::kBusy;
  changed_ = false;
  lock.unlock();
  if (stop) return Finish(record_->End(*stop));
  if (!context_.server.io.Submit([this] { Look(); })) FinishWith(Overloaded());
}

void WatchCall::Look() {
  const auto job = context_.store.jobs().Get(job_);
  if (!job.ok()) return FinishWith(job.status());
  v1::WatchJobResponse response = ToWatchResponse(*job);
  std::string told = response.SerializeAsString();
  std::unique_lock lock(mutex_);
  if (told == last_told_) {
    state_ = State::kIdle;
    return Advance(std::move(lock));
  }
  response_.Swap(&response);
  last_told_ = std::move(told);
  ended_ = job->state != store::JobState::kQueued && job->state != store::JobState::kRunning;
  lock.unlock();
  StartWrite(&response_);
}

/// While busy, so that nothing else is under way.
void WatchCall::FinishWith(const absl::Status& status) {
  {
    std::lock_guard lock(mutex_);
    state_ = State::kFinished;
  }
  Finish(record_->End(status));
}

}  // namespace metaekf::server
