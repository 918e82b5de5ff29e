#pragma once

namespace CLI {
class App;
}

namespace bodyschema {

/// Adds `status`: listens to the bus for two seconds and prints how the group is.
void add_status_command(CLI::App& console);

}  // namespace bodyschema
