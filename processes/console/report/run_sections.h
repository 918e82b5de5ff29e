#pragma once

#include "processes/console/report/report_page.h"
#include "processes/console/views/json.h"

namespace bodyschema {

// The data of report.mustache about the run; null where there is nothing to show.

/// A table of the template.
Json table(nlohmann::ordered_json rows);

/// Flaws of the logs: the page may be told from half of them.
Json flaws_data(const Report& report);
/// `loads`, the figures, is left empty.
Json processes_data(const RunRecord& record);
Json events_data(const RunRecord& record);
Json messages_data(const Report& report);
Json configuration_data(const RunRecord& record);

}  // namespace bodyschema
