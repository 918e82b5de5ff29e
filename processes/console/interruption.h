#pragma once

namespace bodyschema {

/// From now on SIGINT and SIGTERM end no program and no wait of Bus::handle; poll() and the like
/// return early.
void catch_interruption();
/// Whether such a signal came since then.
bool is_interrupted();
/// Signals that came so far are dealt with.
void clear_interruption();

}  // namespace bodyschema
