#include "processes/console/picture.h"

#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"

namespace bodyschema {
namespace {

cv::Mat decode(const camera_image_t& image) {
  cv::Mat bytes(1, static_cast<int>(image.data.size()), CV_8U,
                const_cast<std::uint8_t*>(image.data.data()));
  if (image.encoding == camera_image_t::ENCODING_GREY)
    return bytes.reshape(1, image.height).clone();
  return cv::imdecode(bytes, cv::IMREAD_GRAYSCALE);
}

/// Points of the camera's frame in the (distorted) image.
std::vector<cv::Point2d> project(const std::vector<cv::Point3d>& points,
                                 const camera_info_t& camera) {
  const cv::Matx33d K(camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1);
  std::vector<cv::Point2d> pixels;
  if (camera.distortion_model == camera_info_t::MODEL_FISHEYE) {
    std::vector<double> distortion = camera.distortion;
    distortion.resize(4);  // OpenCV wants all four
    cv::fisheye::projectPoints(points, pixels, cv::Vec3d(), cv::Vec3d(), K, distortion);
  } else {
    cv::projectPoints(points, cv::Vec3d(), cv::Vec3d(), K, camera.distortion, pixels);
  }
  return pixels;
}

void draw_marker(cv::Mat& picture, const marker_pose_t& marker, const camera_info_t& camera) {
  const auto at = [](const cv::Point2d& p) { return cv::Point(cvRound(p.x), cvRound(p.y)); };
  std::vector<cv::Point> outline;
  for (const auto& corner : marker.corner_px) outline.push_back(at({corner[0], corner[1]}));
  cv::polylines(picture, outline, true, cv::Scalar(0, 200, 255), 2, cv::LINE_AA);

  const Pose X_CM = from_message(marker.X_CM[0]);
  std::vector<cv::Point3d> ends;
  for (int axis = -1; axis < 3; ++axis) {
    Eigen::Vector3d p_M = Eigen::Vector3d::Zero();
    if (axis >= 0) p_M[axis] = 0.5 * marker.size_m;
    const Eigen::Vector3d p_C = X_CM * p_M;
    ends.emplace_back(p_C.x(), p_C.y(), p_C.z());
  }
  const auto pixels = project(ends, camera);
  const cv::Scalar colours[] = {{60, 60, 255}, {60, 220, 60}, {255, 120, 60}};
  for (int axis = 0; axis < 3; ++axis) {
    cv::line(picture, at(pixels[0]), at(pixels[axis + 1]), colours[axis], 2, cv::LINE_AA);
  }
  const std::string id = std::to_string(marker.marker_id);
  const cv::Point where = outline[0] + cv::Point(2, -5);
  cv::putText(picture, id, where, cv::FONT_HERSHEY_SIMPLEX, 0.5, cv::Scalar(0, 0, 0), 3,
              cv::LINE_AA);
  cv::putText(picture, id, where, cv::FONT_HERSHEY_SIMPLEX, 0.5, cv::Scalar(255, 255, 255), 1,
              cv::LINE_AA);
}

}  // namespace

void write_detections(const camera_image_t& image, const marker_poses_t& markers,
                      const camera_info_t& camera, const std::filesystem::path& png) {
  const cv::Mat grey = decode(image);
  if (grey.empty()) throw std::runtime_error("the camera's image cannot be decoded");
  cv::Mat picture;
  cv::cvtColor(grey, picture, cv::COLOR_GRAY2BGR);
  for (const marker_pose_t& marker : markers.markers) draw_marker(picture, marker, camera);
  std::vector<std::uint8_t> encoded;
  cv::imencode(".png", picture, encoded);
  write_file_atomically(png, std::string(encoded.begin(), encoded.end()));
}

}  // namespace bodyschema
