#include <unistd.h>

#include <cstdlib>
#include <iostream>

#include "client/cli/app.h"

int main(int argc, char** argv) {
  std::ios::sync_with_stdio(false);
  std::cin.tie(nullptr);
  metaekf::cli::Console console(std::cin, std::cout, std::cerr, isatty(STDERR_FILENO) != 0);
  const int status = metaekf::cli::Run({argv + 1, argv + argc}, console);
  std::cout.flush();
  // Not all of exit: a thread may still wait for standard input.
  std::_Exit(status == 0 && !std::cout ? 1 : status);
}
