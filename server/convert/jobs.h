#pragma once

#include "metaekf/v1/training.pb.h"
#include "server/store/jobs.h"

namespace metaekf::server {

v1::Job ToMessage(const store::Job& job);

/// What a watcher is told of the job.
v1::WatchJobResponse ToWatchResponse(const store::Job& job);

}  // namespace metaekf::server
