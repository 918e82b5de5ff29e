#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <optional>

#include "bodyschema/motion_status_t.hpp"

namespace bodyschema {

/// Where the arm rests, as its driver says [command units]: after a MOVE that settled, and in an
/// answer that echoes no MOVE (lcmtypes/DRIVER.md, rules 2 and 10). std::nullopt while it moves,
/// after a MOVE that was rejected, stopped or expired, whose `commanded` is where it did not go,
/// and of another number of signals.
std::optional<Eigen::VectorXd> rest_position(const motion_status_t& status,
                                             std::size_t num_signals);

}  // namespace bodyschema
