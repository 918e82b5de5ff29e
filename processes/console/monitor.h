#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

/// Adds `monitor`: keeps a schema true over a recording in which the body changes, and tells what
/// it found.
void add_monitor_command(Arguments console);

}  // namespace bodyschema
