#include "processes/robot_simulator/saved_status.h"

#include <sstream>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/convert.h"

namespace bodyschema {

std::string saved_status(const motion_status_t& status) {
  std::ostringstream text;
  text << "{source: " << yaml_quoted(status.source) << ", epoch: " << status.epoch
       << ", action_id: " << status.action_id << ", kind: " << int{status.kind}
       << ", purpose: " << int{status.purpose} << ", state: " << int{status.state}
       << ", reason: " << yaml_quoted(status.reason)
       << ", commanded: " << yaml_list(status.commanded) << "}";
  return text.str();
}

motion_status_t load_status(const Yaml& yaml) {
  motion_status_t status{};
  status.source = yaml.text("source");
  status.epoch = yaml.integer("epoch", 0);
  status.action_id = yaml.integer("action_id", -1);
  status.kind = static_cast<std::int8_t>(yaml.integer("kind", 0, action_command_t::KIND_RESUME));
  status.purpose =
      static_cast<std::int8_t>(yaml.integer("purpose", 0, action_command_t::PURPOSE_CONTROL));
  status.state = static_cast<std::int8_t>(yaml.integer("state", 0, motion_status_t::STATE_HOLDING));
  status.reason = yaml.text("reason");
  set_array(status.num_signals, status.commanded, yaml.numbers("commanded"));
  return status;
}

}  // namespace bodyschema
