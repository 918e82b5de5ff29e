#pragma once

#include <cstdint>
#include <set>
#include <string>
#include <vector>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

/// A fault inside a long edge, or at one of its ends.
enum class LongFault {
  kNone,
  kStuck,   ///< joint `at` stands still somewhere in the middle six tenths of its range
  kOffset,  ///< joint `at` by 20°, or 5 cm if it slides
  kGain,    ///< joint `at` goes 0.7 of the way
  kBend,    ///< the link behind joint `at`: 45° and 3 cm
  kBase,    ///< the link before the first joint: 30° and 5 cm
  kTool,    ///< the hand's marker moves with its tool: 0.25 m, 80°
  kDrift,   ///< the link behind joint `at` bends by 0.05° a sample
  kWorn     ///< joint `at` goes 0.3 sin 3q of its command farther
};
const char* name_of(LongFault fault);

struct LongArmOptions {
  int num_joints = 7;
  int slides = -1;       ///< this joint slides
  bool is_fine = false;  ///< noise of 1 mm and 0.3° and no outliers; else tag_iso
  double visible = 0.95;
  int block_length = 60;
};

/// An arm of which base (part 1) and hand (part 2) alone are seen: one edge with all its joints,
/// each with a gain of its own and a range of 60° to 240°. Its schema is right to 0.5 mm and 0.1°
/// an axis and transform, as its covariance says. The fault is there in every second block.
class LongArm {
 public:
  static constexpr int kRoot = 1, kHand = 2;

  LongArm(const LongArmOptions& options, LongFault fault, int at, int seed);

  const BodySchema& engineered() const { return engineered_; }
  /// Must be called for 0, 1, 2, … in this order.
  ActionPoseSample observe(int index);
  /// Mean distance of the hand from its position in the base by the schema, at the time of sample
  /// `index`, over 60 actions [m]; noise-free.
  double error(const BodySchema& schema, int index) const;
  /// Whether this is the fault: right cause, and of what is inside the edge the right signal.
  bool is_named_by(const AdaptationEvent& event) const;
  AdaptationOptions adaptation_options() const;

 private:
  SyntheticRobot robot_at(int index) const;

  const LongArmOptions options_;
  const LongFault fault_;
  const int at_;
  Rng rng_;
  SyntheticRobot healthy_, broken_;
  Eigen::Vector3d drift_axis_;
  BodySchema engineered_;
  std::vector<Eigen::VectorXd> test_actions_;
};

/// What a monitor made of an arm's life.
struct LongLife {
  std::vector<AdaptationEvent> events;
  std::vector<double> error;  ///< by sample
  double most_seconds = 0, mean_seconds = 0;
  /// Samples of the block after which the error stays below `most` until its end.
  int samples_until_right(int block, int block_length, double most) const;
};
LongLife live(LongArm* arm, int num_samples);

}  // namespace bodyschema::test
