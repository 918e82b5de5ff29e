#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

/// bodyschema fault KIND …: breaks the simulated arm and says what is broken then.
void add_fault_command(Arguments console);

}  // namespace bodyschema
