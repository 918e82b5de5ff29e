#pragma once

#include <limits>
#include <set>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "processes/model_monitor/adaptation.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

enum class Fault {
  kNone,
  kStuck,        ///< a joint in the middle stands still, somewhere within ±0.8 rad
  kTool,         ///< the last marker moves with its tool: 0.25 m, 80°
  kBend,         ///< a link in the middle: 45° and 3 cm
  kOffset,       ///< a joint's zero by 20°
  kGain,         ///< a joint goes 0.7 of the way
  kReversed,     ///< a joint goes the other way
  kTwo,          ///< a stuck joint and an exchanged tool
  kAdjacent,     ///< a stuck joint, and the link after the next joint bent by 40° and 10 cm
  kMarker,       ///< a marker in the middle moves on its part: 5 cm, 1 rad
  kCamera,       ///< bumped: 10 cm, 15°
  kDrift,        ///< a link bends by drift_deg a sample
  kWorn,         ///< a joint's transmission: it goes to q + 0.6 sin 3q
  kCoupled,      ///< a joint is moved by another signal too, half as far
  kElastic,      ///< the link behind a joint bends with the angle: 17° and 4 cm at 1 rad
  kIntermittent  ///< kBend comes and goes, for 3 to 12 samples each; it is never repaired
};

/// Description of a fault, as a monitor may name it.
struct TrueChange {
  int part = 0;         ///< the edge that leads to it, or its marker
  bool at_edge = true;  ///< the edge is a right answer
  bool at_marker = false;
  std::set<std::string> causes;
};

struct Scenario {
  Fault fault = Fault::kNone;
  const char* name = "";
  double visible = 1;       ///< share of the markers seen, each on its own
  double drift_deg = 0.05;  ///< kDrift: a sample, from the second block on …
  /// … until it has come so far.
  double most_drift_deg = std::numeric_limits<double>::infinity();
  double size = 1;          ///< of kTool, kBend, kOffset, kMarker and kCamera, as a share
  int joint = 4;            ///< kOffset, kGain, kReversed: that moves this part
  double range_rad = 1.35;  ///< of every joint, to both sides
};

/// The chapter's arm of Sections 5.2 and 5.3: a chain of seven parts x1 … x7, the edge i–(i+1)
/// moved by q_i, q7 idle; the camera 2 m away. Its geometry, its "engineered model" (right to 1 mm
/// and 0.2° an axis and edge) and all its observations follow from the seed.
///
/// Its life has four blocks: healthy, broken, repaired, broken again in the same way.
class BrokenArm {
 public:
  static constexpr int kNumBlocks = 4;
  static constexpr int kRoot = 1, kEndEffector = 7;

  BrokenArm(const Scenario& scenario, Regime regime, int block_length, int seed);

  const BodySchema& engineered() const { return engineered_; }
  int num_samples() const { return kNumBlocks * block_length_; }
  int block_length() const { return block_length_; }
  /// The engineered model with the edge to `part` exactly as it is at `index`.
  BodySchema engineered_but_exact(int part, int index) const;
  /// Must be called for 0, 1, 2, … in this order.
  ActionPoseSample observe(int index);
  /// Mean distance of the judged part from its position by the schema at `index`, over 60 actions
  /// [m]; noise-free. The judged part is the end effector in the root part; for a moved marker,
  /// this marker's part; for a bumped camera, the end effector in the camera.
  double error(const BodySchema& schema, int index) const;
  const std::vector<TrueChange>& changes() const { return changes_; }
  /// True for an edge or a part that is affected or next to it.
  bool is_near(int part) const;

 private:
  /// Makes the scenario's fault, in `broken_` and `changes_`.
  void break_as_told();
  SyntheticRobot robot_at(int index) const;
  bool is_broken(int index) const;

  const Scenario scenario_;
  const Regime regime_;
  const int block_length_;
  Rng rng_;
  SyntheticRobot healthy_, broken_;
  Eigen::Vector3d drift_axis_;
  BodySchema engineered_;
  std::vector<Eigen::VectorXd> test_actions_;
  std::vector<TrueChange> changes_;
  std::vector<int> turns_;  ///< kIntermittent: samples at which it breaks or is whole again
};

/// A displacement of given size, in a random direction.
Pose displacement(Rng& rng, double position_m, double rotation_rad);

/// Assumed noise is `noise_factor` times the true one. In tag noise it comes with the observations
/// (and the factor must be 1).
AdaptationOptions adaptation_options(Regime regime, double noise_factor = 1);

/// Processor time of this thread [s].
double thread_seconds();

}  // namespace bodyschema::test
