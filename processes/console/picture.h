#pragma once

#include <filesystem>

#include "bodyschema/camera_image_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/marker_poses_t.hpp"

namespace bodyschema {

/// Writes `image` as a colour PNG with the outline, the id and the three axes (x red, y green, z
/// blue, into the marker) of every marker drawn in. @throws std::runtime_error if the image cannot
/// be decoded or the file not be written.
void write_detections(const camera_image_t& image, const marker_poses_t& markers,
                      const camera_info_t& camera, const std::filesystem::path& png);

}  // namespace bodyschema
