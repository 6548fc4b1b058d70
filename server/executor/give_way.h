#pragma once

namespace metaekf::server {

/// Has the calling thread, and those that it starts from then on, work in the time that others leave: for adaptations and trainings, which
/// last, beside estimates, which someone waits for. Where the system refuses, it works all the same, only less politely.
void GiveWay();

}  // namespace metaekf::server
