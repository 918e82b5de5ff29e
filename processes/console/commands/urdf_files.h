#pragma once

#include <string>

#include "processes/console/urdf_model.h"
#include "processes/console/views/json.h"

namespace bodyschema {

/// Writes a schema as a URDF and, unless `placement` is "", its signals and parts as the YAML that
/// `engineer` reads. `schema_file` stands in errors. Returns what was written.
/// @throws std::runtime_error as urdf_model(), before anything is written.
UrdfModel write_urdf(const BodySchema& schema, const std::string& schema_file, bool nominal,
                     const std::string& urdf, const std::string& placement);

/// What write_urdf() wrote into the file `urdf`, for people and for programs.
std::string urdf_text(const UrdfModel& model, const std::string& urdf);
Json urdf_json(const UrdfModel& model, const std::string& urdf);

}  // namespace bodyschema
