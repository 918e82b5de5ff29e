#include "processes/console/picture.h"

#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/camera/decode_image.h"
#include "common/camera/lens.h"

namespace bodyschema {
namespace {

void draw_marker(cv::Mat& picture, const marker_pose_t& marker, const Lens& lens) {
  const auto at = [](const cv::Point2d& p) { return cv::Point(cvRound(p.x), cvRound(p.y)); };
  std::vector<cv::Point> outline;
  for (const auto& corner : marker.corner_px) outline.push_back(at({corner[0], corner[1]}));
  cv::polylines(picture, outline, true, cv::Scalar(0, 200, 255), 2, cv::LINE_AA);

  const Pose X_CM = from_message(marker.X_CM[0]);
  const auto pixel = [&](const Eigen::Vector3d& p_M) {
    const Eigen::Vector3d p_C = X_CM * p_M;
    const Eigen::Vector2d p_px = lens.project(p_C.head<2>() / p_C.z());
    return at({p_px.x(), p_px.y()});
  };
  const cv::Scalar colours[] = {{60, 60, 255}, {60, 220, 60}, {255, 120, 60}};
  for (int axis = 0; axis < 3; ++axis) {
    const Eigen::Vector3d end = 0.5 * marker.size_m * Eigen::Vector3d::Unit(axis);
    cv::line(picture, pixel(Eigen::Vector3d::Zero()), pixel(end), colours[axis], 2, cv::LINE_AA);
  }
  const std::string id = std::to_string(marker.marker_id);
  const cv::Point where = outline[0] + cv::Point(2, -5);
  for (const auto& [colour, width] : {std::pair(cv::Scalar(0, 0, 0), 3), {{255, 255, 255}, 1}})
    cv::putText(picture, id, where, cv::FONT_HERSHEY_SIMPLEX, 0.5, colour, width, cv::LINE_AA);
}

/// An image and its markers come within so many of each.
constexpr std::size_t kKept = 8;

template <class Message>
void keep(std::deque<Message>* kept, const Message& message) {
  kept->push_back(message);
  if (kept->size() > kKept) kept->pop_front();
}

}  // namespace

std::string draw_detections(const camera_image_t& image, const marker_poses_t& markers,
                            const camera_info_t& camera, const std::string& format) {
  const cv::Mat grey = decode_image(image);
  if (grey.empty()) throw std::runtime_error("the camera's image cannot be decoded");
  const Lens lens(camera);
  cv::Mat picture;
  cv::cvtColor(grey, picture, cv::COLOR_GRAY2BGR);
  for (const marker_pose_t& marker : markers.markers) draw_marker(picture, marker, lens);
  std::vector<std::uint8_t> encoded;
  std::vector<int> options;
  if (format == ".jpg") options = {cv::IMWRITE_JPEG_QUALITY, 85};
  cv::imencode(format, picture, encoded, options);
  return {encoded.begin(), encoded.end()};
}

void BestPicture::on_image(const camera_image_t& image) {
  keep(&images_, image);
  match();
}

void BestPicture::on_markers(const marker_poses_t& markers) {
  keep(&markers_, markers);
  match();
}

void BestPicture::match() {
  for (const camera_image_t& image : images_) {
    for (const marker_poses_t& markers : markers_) {
      if (image.utime != markers.utime || image.camera_name != markers.camera_name ||
          markers.num_markers <= best_markers_.num_markers)
        continue;
      best_image_ = image;
      best_markers_ = markers;
    }
  }
}

bool BestPicture::write(const std::filesystem::path& png) const {
  if (!best_image_ || !info_) return false;
  write_file_atomically(png, draw_detections(*best_image_, best_markers_, *info_, ".png"));
  return true;
}

}  // namespace bodyschema
