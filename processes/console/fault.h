#pragma once

namespace CLI {
class App;
}

namespace bodyschema {

/// bodyschema fault KIND …: breaks the simulated arm and says what is broken then.
void add_fault_command(CLI::App& console);

}  // namespace bodyschema
