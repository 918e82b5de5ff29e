#pragma once

#include <vector>

#include "processes/refiner/refine.h"
#include "processes/refiner/refiner_sample.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

/// A synthetic robot with tags on its parts and the lens that it is seen through, as they truly
/// are.
struct TaggedRobot {
  SyntheticRobot robot;
  RigCalibration truth;
};

/// Differences of a rig's files from the truth, standard deviations.
struct RigError {
  TagCalibration tags = {};
  double focal_length_share = 0;
  double centre_px = 0;
  double distortion = 0;
};

/// As many tags on every visible part, 50 mm from its origin and each another way round, 60 mm
/// wide; 1280×960 px, f = 1100 px, a little distortion.
TaggedRobot tagged(const SyntheticRobot& robot, int tags_a_part, Rng& rng);

/// What the rig's files claim. The first tag of the root is where they say.
RigCalibration claimed(const TaggedRobot& robot, const RigError& error, Rng& rng);

/// The tags that face the camera at each action, their corners with as much noise; the poses of
/// parts, by what `rig` claims.
std::vector<RefinerSample> seen_corners(const TaggedRobot& robot, const RigCalibration& rig,
                                        int num_samples, double noise_px, Rng& rng);

}  // namespace bodyschema::test
