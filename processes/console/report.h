#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

/// Adds `report`: what a run folder or a log tells, as one HTML file.
void add_report_command(Arguments console);

}  // namespace bodyschema
