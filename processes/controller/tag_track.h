#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>

namespace bodyschema {

/// Where a target tag stands in the camera's frame C, by the frames of an arm at rest.
///
/// Its place is the mean over the frames since it came there, weighted by their covariances; the
/// older ones fade. A frame that is too far from the mean for the noise of both begins another
/// place.
class TagTrack {
 public:
  /// Frames that must agree. Chosen: as many as the simulated camera takes of a rest; a tag in a
  /// moving hand is elsewhere in the second one.
  static constexpr int kFrames = 2;
  /// Frames that the mean is worth at most. Chosen: two seconds of a camera of 15 Hz, after which a
  /// move within the noise is forgotten.
  static constexpr int kWindow = 30;

  struct Sight {
    Eigen::Vector3d p_CM = Eigen::Vector3d::Zero();            ///< its centre [m]
    Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();  ///< [m²]
  };
  /// The next frame; std::nullopt: it does not show the tag.
  void see(const std::optional<Sight>& sight);

  bool is_seen() const { return is_seen_; }  ///< in the newest frame
  /// Seen, and kFrames agree on the place.
  bool is_known() const { return is_seen_ && num_frames_ >= kFrames; }
  /// Counts the places.
  int place() const { return place_; }
  /// The mean [m]; of a place with one frame or more.
  Eigen::Vector3d p_CM() const;
  /// For people: "is not seen", "moved by 83 mm".
  std::string account() const;

 private:
  bool is_seen_ = false;
  int place_ = 0;
  int num_frames_ = 0;  ///< in the mean
  double moved_m_ = 0;  ///< to the present place from that before
  Eigen::Matrix3d information_ = Eigen::Matrix3d::Zero();  ///< sum over the frames [1/m²]
  Eigen::Vector3d weighted_ = Eigen::Vector3d::Zero();     ///< information times position [1/m]
};

}  // namespace bodyschema
