#pragma once

#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

struct RandomArmOptions {
  int num_joints = 7;
  double share_sliding = 0.1;
  /// Joints turn by 0.6 to 1.6 rad per command unit, in either sense; else by 1 rad.
  bool own_gains = true;
  /// Signals are listed in another order than that of the joints.
  bool scrambled = false;
};
/// An arm of which base and hand alone are seen, parts 1 and `num_joints` + 1: neighbouring axes
/// parallel, at right angles or anyhow, links of 0.1 to 0.4 m, ranges of 60° to 240°, slides of up
/// to 0.2 m.
SyntheticRobot random_arm(const RandomArmOptions& options, Rng& rng);

/// Its samples, with as much noise of each marker, per axis.
std::vector<ActionPoseSample> noisy_babble(const SyntheticRobot& robot, int num_samples,
                                           const Noise& noise, Rng& rng);

}  // namespace bodyschema::test
