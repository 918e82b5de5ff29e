#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

/// Adds `watch`: follows the group on the bus, shows a live line of progress on stderr, and at the
/// end prints the result to stdout and writes result.json and detections.png into the run's folder.
void add_watch_command(Arguments console);

}  // namespace bodyschema
