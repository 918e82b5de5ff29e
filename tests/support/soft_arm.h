#pragma once

#include <set>
#include <vector>

#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

/// A soft arm of sections of constant curvature (Webster and Jones, "Design and Kinematic Modeling
/// of Constant Curvature Continuum Robots", 2010), each bent and stretched by chambers or tendons
/// around it. Part 0 is its base, part n + 1 the end of section n. No chain of few joints describes
/// it.
struct SoftArm {
  int num_sections = 3;
  int num_chambers = 3;    ///< of a section; signal n · num_chambers + c is chamber c of section n
  int num_idle = 0;        ///< signals that do nothing, the last ones
  double length_m = 0.12;  ///< of a section
  double bend_rad = 1;     ///< of a section, by opposite chambers at their ends
  double stretch = 0.15;   ///< of its length, by all chambers at their ends
  double coupling = 0;     ///< share of a section's bend that its tendons bring to the one before

  int num_signals() const { return num_sections * num_chambers + num_idle; }
  std::vector<Signal> signals() const;
  /// Those that move part n + 1 against part n.
  std::set<int> signals_of(int section) const;
  /// X_CP of all parts; `action` in [−1, 1].
  std::vector<Pose> poses(const Eigen::VectorXd& action) const;
  /// Poses at rest at random actions, every marker with noise of its own.
  std::vector<ActionPoseSample> babble(int num_samples, const Noise& noise, Rng& rng) const;

 private:
  Pose section(int n, const Eigen::VectorXd& action) const;
};

}  // namespace bodyschema::test
