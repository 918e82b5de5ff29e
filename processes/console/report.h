#pragma once

namespace CLI {
class App;
}

namespace bodyschema {

/// Adds `report`: what a run folder or a log tells, as one HTML file.
void add_report_command(CLI::App& console);

}  // namespace bodyschema
