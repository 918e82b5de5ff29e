#pragma once

namespace CLI {
class App;
}

namespace bodyschema {

/// Adds `log`: what an LCM log holds, what of it cannot be read, and a copy of some of its
/// channels.
void add_log_command(CLI::App& console);

}  // namespace bodyschema
