#include "common/bus/rest_position.h"

#include "bodyschema/action_command_t.hpp"

namespace bodyschema {

std::optional<Eigen::VectorXd> rest_position(const motion_status_t& status,
                                             std::size_t num_signals) {
  const bool is_settled =
      status.state == motion_status_t::STATE_SETTLED && status.kind == action_command_t::KIND_MOVE;
  const bool is_told = status.action_id < 0 || status.kind != action_command_t::KIND_MOVE;
  if (status.rest_since_utime < 0 || status.commanded.size() != num_signals) return std::nullopt;
  if (!is_settled && !is_told) return std::nullopt;
  return Eigen::VectorXd::Map(status.commanded.data(), static_cast<Eigen::Index>(num_signals));
}

}  // namespace bodyschema
