// motion_client: MOTION_STATUS -> ACTION_COMMAND. Prints every change of MOTION_STATUS, one line
// each; at each SIGUSR1 it sends a MOVE by 60 units and sends it again until it is answered.

#include <csignal>
#include <cstdio>
#include <optional>
#include <string>

#include "common/bus/bus.h"
#include "common/bus/convert.h"

using namespace bodyschema;

namespace {

volatile std::sig_atomic_t wanted_moves = 0;

}  // namespace

int main() {
  constexpr const char* kStates[] = {"IDLE",     "ACCEPTED", "MOVING",  "SETTLED",
                                     "REJECTED", "STOPPED",  "EXPIRED", "HOLDING"};
  std::signal(SIGUSR1, [](int) { wanted_moves = wanted_moves + 1; });
  Bus bus(default_url(), default_url());
  std::string last_line;
  std::int64_t utime = 0, answered_id = -1;
  bus.subscribe<motion_status_t>(kMotionStatus, [&](const motion_status_t& status) {
    utime = status.utime;
    answered_id = std::max(answered_id, status.action_id);
    const std::string line = "id=" + std::to_string(status.action_id) + " " +
                             kStates[status.state] +
                             (status.rest_since_utime < 0 ? " rest=no" : " rest=yes");
    if (line != last_line) std::puts((line + " " + status.reason).c_str());
    std::fflush(stdout);
    last_line = line;
  });
  std::optional<action_command_t> command;
  for (;;) {
    bus.handle(std::chrono::milliseconds(100));
    if (wanted_moves == answered_id + 1) continue;
    if (!command || command->action_id != answered_id + 1) {
      command.emplace();
      command->utime = utime;
      command->source = "motion_client";
      command->epoch = 1;
      command->action_id = answered_id + 1;
      command->kind = action_command_t::KIND_MOVE;
      command->expiry_utime = utime + 60'000'000;
      const double far = command->action_id % 2 == 0 ? 50 : -50;
      set_array(command->num_signals, command->action, std::vector<double>{far, far, far});
    }
    bus.publish(kActionCommand, *command);
  }
}
