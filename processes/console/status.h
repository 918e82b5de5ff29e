#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

/// Adds `status`: listens to the bus for two seconds and prints how the group is.
void add_status_command(Arguments console);

}  // namespace bodyschema
