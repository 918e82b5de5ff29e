#include "processes/console/interruption.h"

#include <csignal>

namespace bodyschema {
namespace {

volatile std::sig_atomic_t interrupted = 0;
void on_signal(int) { interrupted = 1; }

}  // namespace

void catch_interruption() {
  struct sigaction action {};
  action.sa_handler = &on_signal;  // no SA_RESTART
  ::sigaction(SIGTERM, &action, nullptr);
  ::sigaction(SIGINT, &action, nullptr);
}

bool is_interrupted() { return interrupted != 0; }

void clear_interruption() { interrupted = 0; }

}  // namespace bodyschema
