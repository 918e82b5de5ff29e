#pragma once

#include <string>
#include <string_view>

#include "processes/console/views/json.h"

namespace bodyschema {

/// `text` for an HTML page: no character of it is markup, control characters are spaces.
std::string escape_html(const std::string& text);

/// Fills in a mustache template: {{key}} escaped, {{{key}}} as it is, {{.}} the section's value,
/// {{#key}}…{{/key}} for each of an array or once, {{^key}}…{{/key}} for nothing. Nothing is null,
/// false, "" or an empty array; a key that no section around has is null. Not of the standard:
/// white space around sections stays, and no section stands in one of its own name.
/// @throws std::logic_error for a tag or section without an end.
std::string render(std::string_view text, const Json& data);

// The files of this folder, compiled in.
extern const char kReportTemplate[];  ///< report.mustache
extern const char kReportStyle[];     ///< report.css

}  // namespace bodyschema
