#pragma once

#include "common/bus/arguments.h"

namespace bodyschema {

/// bodyschema driver-test: conformance of whatever driver answers on the bus with
/// lcmtypes/DRIVER.md. One line a rule on stdout, or --json; exit code 1 if any failed, 2 if it was
/// not confirmed.
void add_driver_test_command(Arguments console);

}  // namespace bodyschema
