#include <stdexcept>

#include "processes/console/commands/commands.h"

namespace bodyschema {

void add_refine_command(Arguments console) {
  Arguments refine = console.add_subcommand(
      "refine", "Fit all parameters of a schema to a recording (built without Ceres)");
  refine.allow_extras();
  refine.callback([] {
    throw std::runtime_error(
        "refine: built without Ceres; install it (apt-get install libceres-dev) and build anew");
  });
}

}  // namespace bodyschema
