#pragma once

#include <fmt/format.h>

#include <string>

#include "common/geometry/angle.h"

namespace bodyschema {

/// "3.21 mm 0.41°".
inline std::string pose_text(double position_m, double rotation_rad, int decimals_mm = 2) {
  return fmt::format("{:.{}f} mm {:.2f}°", position_m * 1e3, decimals_mm, rotation_rad / kDegree);
}

}  // namespace bodyschema
