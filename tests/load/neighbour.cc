// A neighbour of those who throw bombs, in a process of its own: one stream that sends a sample a millisecond and waits for its
// estimate, and now and then asks for the server's health.
//
//   neighbour ADDRESS RECONNECT_FOR_S     RECONNECT_FOR_S 0: its connection is not to be lost, and the server is to be healthy
//
// Prints a line after every kNeighbourRound answers, and at the end: how long each took, in ms. Ends with SIGTERM; with status 1 and
// the reason if it was not served.

#include <fcntl.h>
#include <signal.h>
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>

#include "metaekf/client.h"
#include "tests/load/neighbour.h"
#include "tests/server/support/client.h"
#include "tests/support/stream_signal.h"

namespace metaekf::server {
namespace {

using std::chrono::steady_clock;

volatile sig_atomic_t ended = 0;

int Fail(const std::string& why) {
  std::fprintf(stderr, "neighbour: %s\n", why.c_str());
  return 1;
}

void Tell(std::vector<double>& round_ms) {
  for (const double ms : round_ms) std::printf("%.3f ", ms);
  std::printf("\n");
  std::fflush(stdout);
  round_ms.clear();
}

int Run(const std::string& address, double reconnect_for_s) {
  client::Client client({.server = address});
  client::EstimationOptions options;
  options.target.model = "robot";
  options.reconnect_for_s = reconnect_for_s;
  const auto session = client.OpenEstimation(options);
  if (!session.ok()) return Fail(session.status().message);
  Client health(address);
  std::vector<double> round_ms;
  for (uint64_t seq = 1; ended == 0; ++seq) {
    if (reconnect_for_s == 0 && seq % 16 == 0 && health.Health() != "SERVING") return Fail("the server is not healthy");
    const auto start = steady_clock::now();
    const client::Status sent = (*session)->Send(metaekf::testing::SignalSamples(0, seq, 1)).status();
    if (!sent.ok()) return Fail(sent.message);
    const auto batch = (*session)->Receive();
    if (!batch.ok()) return Fail(batch.status().message);
    round_ms.push_back(std::chrono::duration<double, std::milli>(steady_clock::now() - start).count());
    if (round_ms.size() == kNeighbourRound) Tell(round_ms);
    std::this_thread::sleep_for(std::chrono::milliseconds(1));  // a sensor's pace
  }
  Tell(round_ms);
  return 0;
}

}  // namespace
}  // namespace metaekf::server

int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: neighbour ADDRESS RECONNECT_FOR_S\n");
    return 2;
  }
  signal(SIGTERM, [](int) { metaekf::server::ended = 1; });
  // Whoever reads may do so at the end only.
  if (fcntl(STDOUT_FILENO, F_SETPIPE_SZ, 1 << 20) < 0) std::perror("neighbour: a larger pipe");
  return metaekf::server::Run(argv[1], std::atof(argv[2]));
}
