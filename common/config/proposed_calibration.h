#pragma once

namespace bodyschema {

/// First line of files that propose a calibration, followed by its calibration_id(): the two files
/// of one proposal have the same.
inline constexpr const char* kProposalMark = "# Proposed by `bodyschema refine`: calibration";

}  // namespace bodyschema
