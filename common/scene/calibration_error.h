#pragma once

#include <cstdint>

namespace bodyschema {

class Yaml;
struct Robot;

/// robot.yaml's calibration_error: difference between the robot, its tags and its lens and the
/// tables there, 1 σ each. All 0: an ideal robot. GROUND TRUTH, as all of robot.yaml.
struct CalibrationError {
  double tag_position_m = 0;      ///< of each tag on its part, per axis of its frame
  double tag_rotation_rad = 0;    ///< of each tag on its part, per axis of its frame
  double tag_size_share = 0;      ///< of each tag's printed side
  double focal_length_share = 0;  ///< of both focal lengths alike
  double distortion_k1 = 0;       ///< added to the first distortion coefficient
  double backlash_rad = 0;        ///< whole width, of every revolute joint
  double droop_share = 0;         ///< of gravity at each joint that its servo does not compensate

  /// Whole percents, degrees and mm in the file. @throws ConfigError.
  static CalibrationError load(const Yaml& yaml);
  bool operator==(const CalibrationError&) const = default;
};

/// One robot of those that robot.yaml describes: tags and lens displaced by a draw of
/// robot.calibration_error. A function of its arguments; each tag's draw hangs on the seed and its
/// id alone. Backlash and droop are the simulator's.
Robot with_calibration_error(Robot robot, std::int64_t seed);

/// Position of a joint's far side within its play, after the near side came to `position` [rad];
/// the far side stood at `before` (absolute) and stays as near to there as the play of `width` lets
/// it.
/// @return relative to the middle, −width/2 … width/2 [rad].
double play_after(double position, double before, double width);

}  // namespace bodyschema
