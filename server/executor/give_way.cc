#include "server/executor/give_way.h"

#include <sched.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

namespace metaekf::server {

void GiveWay() {
  // The lowest priority that has a share of its own. With less of it than others a thread still keeps a processor for milliseconds that
  // someone waits for. SCHED_IDLE sounds like more, but took longer to give way (Linux 6.18).
  constexpr int kLowest = 19;
  (void)setpriority(PRIO_PROCESS, static_cast<id_t>(syscall(SYS_gettid)), kLowest);
  const sched_param none{};
  (void)sched_setscheduler(0, SCHED_BATCH, &none);
}

}  // namespace metaekf::server
