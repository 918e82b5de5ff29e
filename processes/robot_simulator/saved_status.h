#pragma once

#include <string>

#include "bodyschema/motion_status_t.hpp"
#include "common/config/yaml.h"

namespace bodyschema {

/// An answer as a YAML flow mapping, and read again. Times and the latch are not in it: they are
/// the arm's. @{
std::string saved_status(const motion_status_t& status);
motion_status_t load_status(const Yaml& yaml);  ///< @throws ConfigError.
/// @}

}  // namespace bodyschema
