#pragma once

namespace CLI {
class App;
}

namespace bodyschema {

/// Adds `monitor`: keeps a schema true over a recording in which the body changes, and tells what
/// it found.
void add_monitor_command(CLI::App& console);

}  // namespace bodyschema
