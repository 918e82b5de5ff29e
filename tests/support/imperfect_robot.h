#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "common/schema/sample.h"
#include "common/schema/signal.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

/// Differences of a robot, or of its observations, from a perfect one with independent noise. Zero
/// is perfect.
struct Imperfection {
  std::string name;
  double backlash_deg = 0;      ///< play between motor and link, both ways together
  double command_step_deg = 0;  ///< motors go to multiples of this alone
  double droop_deg = 0;         ///< of a joint under the greatest torque that gravity can bring
  double view_bias_m = 0;       ///< rms over all views of a tag, a smooth function of the view
  double view_bias_deg = 0;     ///< likewise
  double correlation = 0;       ///< of the noise from one sample to the next: AR(1)
  double student_nu = 0;        ///< degrees of freedom of t-distributed noise, above 2; 0: Gaussian
  double outlier_share = 0;     ///< anywhere within 1 m
  double flip_share = 0;        ///< the tag's normal mirrored at the line of sight
  double missing_share = 0;
  double range_deg = 0;      ///< of every joint; 0: 120° to 240° each
  double placement_m = 0;    ///< 1 σ an axis: displacement of the four tags of a part
  double placement_deg = 0;  ///< likewise
  double tag_size = 0;       ///< 1 σ: a tag is this share larger than assumed
  double focal_length = 0;   ///< the lens is this share longer than assumed
  double distortion = 0;     ///< at 45° from the optical axis a ray is off by this share
  double lag = 0;            ///< of the poses of wander() behind their commands [samples]
  double drive = 0;          ///< time constant by which these follow, of first order [samples]
};

/// One imperfection a cell, and a perfect robot.
const std::vector<Imperfection>& imperfections();

/// A robot of revolute joints whose markers are seen with 3 mm and 1° of noise per axis, and that
/// is imperfect in some way. Ground truth: no code in common with a model that is learned.
class ImperfectRobot {
 public:
  /// A chain or a tree of so many joints; all else by the seed. Every link bears a marker.
  ImperfectRobot(int num_joints, bool is_chain, const Imperfection& imperfection,
                 std::uint64_t seed);

  const std::vector<Signal>& signals() const { return structure_.signals; }
  /// As it was built, without its imperfections: for judge().
  const SyntheticRobot& structure() const { return structure_; }
  Eigen::VectorXd random_action();
  /// Carries out an action and returns its observation.
  ActionPoseSample go(const Eigen::VectorXd& action);
  std::vector<ActionPoseSample> babble(int num_samples);
  /// A recording of smooth motion: every joint swings to and fro in about `period` samples.
  std::vector<ActionPoseSample> wander(int num_samples, double period);
  /// The link of a part bends, behind its joint: by so much in a random direction each.
  void bend(int part, double position_m, double rotation_rad);
  /// Pose of part n + 1 at the last action, in the camera's frame.
  const std::vector<Eigen::Isometry3d>& poses() const { return poses_; }

 private:
  struct Tag {
    Eigen::Isometry3d X_BT;            ///< its assumed pose
    Eigen::Isometry3d placement;       ///< X_BT_true = X_BT · placement
    double size = 1;                   ///< true over assumed
    Eigen::Matrix<double, 6, 9> bias;  ///< of (translation, rotation), of monomials of the view
  };
  struct Link {
    int parent = -1;
    Eigen::Isometry3d before, after;  ///< of the joint, which turns about z
    std::vector<Tag> tags = {};
    double angle = 0;  ///< of the joint, now
    Eigen::Matrix<double, 6, 1> noise =
        Eigen::Matrix<double, 6, 1>::Zero();  ///< of the marker, now
  };
  void move(const Eigen::VectorXd& action);
  std::vector<Eigen::Isometry3d> poses_at(const std::vector<double>& angles) const;
  const Tag& facing(const Link& link, const Eigen::Isometry3d& X_CB) const;

  const Imperfection is_;
  Rng rng_;
  SyntheticRobot structure_;
  std::vector<Link> links_;  ///< parents before children; links_[n] is part n + 1
  Eigen::Isometry3d X_CR_;
  Eigen::Vector3d down_;  ///< in the root's frame
  std::vector<Eigen::Isometry3d> poses_;
  std::int64_t num_samples_ = 0;
};

}  // namespace bodyschema::test
