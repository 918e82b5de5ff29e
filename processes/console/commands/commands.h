#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

// Each adds subcommands of `bodyschema`, with their options and help; results go to stdout.

/// `learn`, `predict`, `show` and `rig`: work on files, without a bus.
void add_offline_commands(Arguments console);
void add_engineer_command(Arguments console);
void add_urdf_command(Arguments console);
void add_reach_command(Arguments console);
/// Built without Ceres, `refine` says how to get it.
void add_refine_command(Arguments console);
void add_adopt_command(Arguments console);
void add_log_command(Arguments console);
void add_monitor_command(Arguments console);
void add_report_command(Arguments console);
/// `status`: listens to the bus for two seconds.
void add_status_command(Arguments console);
/// `watch`: follows the group on the bus, shows a live line of progress on stderr, and at the end
/// prints the result and writes result.json and detections.png into the run's folder.
void add_watch_command(Arguments console);
/// `target`, `hold`, `release`, `halt` and `resume`: they talk on the bus, show progress on stderr,
/// and exit with 0 only where the result is what was asked for. `stop` only says which of `halt`
/// and `./run stop` may be meant.
void add_operate_commands(Arguments console);
/// `follow`: the same along a path of way points.
void add_follow_command(Arguments console);
void add_where_command(Arguments console);
void add_fault_command(Arguments console);

}  // namespace bodyschema
