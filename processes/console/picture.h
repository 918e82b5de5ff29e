#pragma once

#include <deque>
#include <filesystem>
#include <optional>
#include <string>

#include "bodyschema/camera_image_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/marker_poses_t.hpp"

namespace bodyschema {

/// `image` in colours with the outline, the id and the three axes (x red, y green, z blue, into the
/// marker) of every marker drawn in, as the bytes of a file of `format`, ".png" or ".jpg".
/// @throws std::runtime_error if the image cannot be decoded.
std::string draw_detections(const camera_image_t& image, const marker_poses_t& markers,
                            const camera_info_t& camera, const std::string& format);

/// Keeps the picture with the most markers whose image and markers were both heard.
class BestPicture {
 public:
  void on_image(const camera_image_t& image);
  void on_markers(const marker_poses_t& markers);
  void on_info(const camera_info_t& info) { info_ = info; }
  /// Whether there was one, which is a PNG file then. @throws as draw_detections(), also
  /// if the file cannot be written.
  bool write(const std::filesystem::path& png) const;

 private:
  void match();

  std::deque<camera_image_t> images_;
  std::deque<marker_poses_t> markers_;
  std::optional<camera_info_t> info_;
  std::optional<camera_image_t> best_image_;
  marker_poses_t best_markers_{};
};

}  // namespace bodyschema
