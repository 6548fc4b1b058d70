#include <sys/resource.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "server/metrics/metrics.h"

namespace metaekf::server {
namespace {

double ResidentBytes() {
  std::ifstream statm("/proc/self/statm");
  double total = 0, resident = 0;
  statm >> total >> resident;
  return resident * static_cast<double>(sysconf(_SC_PAGESIZE));
}

double OpenFiles() {
  std::error_code error;
  double count = 0;
  for (std::filesystem::directory_iterator it("/proc/self/fd", error), end; !error && it != end; it.increment(error)) ++count;
  return count - 1;  // the one that looks
}

double ProcessorSeconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  const auto seconds = [](const timeval& time) {
    return static_cast<double>(time.tv_sec) + 1e-6 * static_cast<double>(time.tv_usec);
  };
  return seconds(usage.ru_utime) + seconds(usage.ru_stime);
}

}  // namespace

Metrics::Families ProcessMetrics() {
  prometheus::MetricFamily cpu = MakeGauges("process_cpu_seconds_total", "Processor time, of user and system together", "", {{"", 0}});
  cpu.type = prometheus::MetricType::Counter;
  cpu.metric[0].counter.value = ProcessorSeconds();
  return {cpu, MakeGauges("process_open_fds", "Open files and connections", "", {{"", OpenFiles()}}),
          MakeGauges("process_resident_memory_bytes", "Resident memory", "", {{"", ResidentBytes()}})};
}

}  // namespace metaekf::server
