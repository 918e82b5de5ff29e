#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

// Each adds subcommands of `bodyschema` with their options; the result goes to stdout.

/// `learn`, `predict`, `show` and `rig`: work on files, without a bus.
void add_offline_commands(Arguments console);
/// `engineer`: a schema file from a URDF, marker placements and a recording that tells where the
/// camera stands.
void add_engineer_command(Arguments console);
/// `urdf`: its inverse, a URDF and placements from a schema file.
void add_urdf_command(Arguments console);
/// `reach`: an action that brings a part to a pose by a schema file.
void add_reach_command(Arguments console);
/// `refine`: fits all parameters of a schema to a recording, by Ceres; where this was built without
/// it, says how to get it.
void add_refine_command(Arguments console);
/// `adopt`: writes the tags and the lens that a run proposes into its rig, with consent, after
/// showing what is another.
void add_adopt_command(Arguments console);
/// `log`: what an LCM log holds, and whether it is whole and of this version.
void add_log_command(Arguments console);
/// `monitor`: keeps a schema true over a recording; its events and errors, line by line.
void add_monitor_command(Arguments console);
/// `report`: what a run folder or a log tells, as one HTML file.
void add_report_command(Arguments console);
/// `status`: listens to the bus for two seconds and prints how the group is.
void add_status_command(Arguments console);
/// `watch`: follows the group on the bus, shows a live line of progress on stderr, and at the end
/// prints the result and writes result.json and detections.png into the run's folder.
void add_watch_command(Arguments console);
/// `target`, `hold`, `release`, `halt` and `resume`: they talk on the bus, show progress on stderr,
/// and exit with 0 only where the result is what was asked for. `stop` does nothing but say which
/// of `halt` and `./run stop` may be meant.
void add_operate_commands(Arguments console);
/// `follow`: the same along a path of way points.
void add_follow_command(Arguments console);
/// `where`: where parts are and can go, by the schema of the group on the bus or of a file.
void add_where_command(Arguments console);
/// `fault KIND …`: breaks the simulated arm and says what is broken then.
void add_fault_command(Arguments console);

}  // namespace bodyschema
