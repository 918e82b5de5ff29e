// path_truth: how far a part was from the way points of the paths of a log, by the simulator's
// truth, where the controller said that it had reached them. One line each: mm, and how much is
// broken there.
//
//   path_truth LOG PART

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <map>
#include <optional>
#include <tuple>

#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/bus/event_log.h"

using namespace bodyschema;

namespace {

std::optional<Pose> X_WB(const sim_state_t& state, int part) {
  for (std::size_t k = 0; k < state.true_part.size(); ++k)
    if (state.true_part[k] == part) return from_message(state.X_WB[k]);
  return std::nullopt;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: path_truth LOG PART\n");
    return 2;
  }
  const int part = std::atoi(argv[2]);
  try {
    std::optional<sim_state_t> state;
    std::optional<int> root;
    struct Arrival {
      std::int64_t target_id;
      double error_m;
      int num_faults;
    };
    std::map<std::tuple<std::int64_t, int>, Arrival> arrivals;  // by epoch and way point; last step
    for_each_event(argv[1], [&](const LogEvent& event) {
      if (auto heard = message_of(event, kSimState)) state = std::move(heard);
      if (const auto schema = message_of(event, kBodySchema)) root = from_message(*schema).root;
      const auto status = message_of(event, kControlStatus);
      if (!status || status->num_way_points == 0 || status->target_part != part || !state || !root)
        return;
      if (status->control_state != control_status_t::CONTROL_REACHED) return;
      const auto X_WR = X_WB(*state, *root), X_WP = X_WB(*state, part);
      if (!X_WR || !X_WP) return;
      const Eigen::Vector3d p_RT(status->target_position_m);
      const auto key = std::tuple(status->target_epoch, status->way_point);
      // It is told again once a second, whatever becomes of the arm meanwhile.
      if (const auto last = arrivals.find(key);
          last != arrivals.end() && last->second.target_id == status->target_id)
        return;
      arrivals[key] = {status->target_id, ((X_WR->inverse() * *X_WP).translation() - p_RT).norm(),
                       state->num_faults};
    });
    for (const auto& [_, arrival] : arrivals)
      std::printf("%.3f %d\n", arrival.error_m * 1e3, arrival.num_faults);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "path_truth: %s\n", error.what());
    return 1;
  }
}
