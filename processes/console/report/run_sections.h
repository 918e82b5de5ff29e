#pragma once

#include <nlohmann/json.hpp>

#include "processes/console/report/report_page.h"

namespace bodyschema {

// The data of report.mustache about the run; null where there is nothing to show.

/// A table of the template.
nlohmann::ordered_json table(nlohmann::ordered_json rows);

/// Flaws of the logs: the page may be told from half of them.
nlohmann::ordered_json flaws_data(const Report& report);
/// `loads`, the figures, is left empty.
nlohmann::ordered_json processes_data(const RunRecord& record);
nlohmann::ordered_json events_data(const RunRecord& record);
nlohmann::ordered_json messages_data(const Report& report);
nlohmann::ordered_json configuration_data(const RunRecord& record);

}  // namespace bodyschema
