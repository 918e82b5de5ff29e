#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/sim_state_t.hpp"
#include "common/config/rig.h"
#include "common/scene/mujoco.h"
#include "common/scene/robot.h"

namespace bodyschema {

/// Description of a scene. A broken arm or an exchanged tool is another scene
/// (common/scene/faults.h).
struct SceneDescription {
  Signals signals;
  Robot robot;
  /// X_WM of tags that have fallen off their parts: their plates lie there and touch nothing.
  std::map<int, Pose> fallen_tags;

  /// The rig as built. `seed` draws its calibration errors; none: the ideal robot, for which all
  /// tables of robot.yaml are true. @throws ConfigError.
  static SceneDescription load(const std::filesystem::path& rig_folder,
                               std::optional<std::int64_t> seed = std::nullopt);
};

/// A rig folder as a MuJoCo model: robot.yaml's links, joints, servos, solids and tags' plates, a
/// floor, lights and target tags, which float and touch nothing. The simulator steps it,
/// SceneRenderer looks at it, and an experiment may do without either:
///
///   const Scene scene("config/arm7");
///   SceneRenderer renderer("config/arm7");
///   const cv::Mat image = renderer.render(scene.state_at(action, /*seed=*/1, /*action_id=*/0), 0);
///
/// Immutable; scratch memory is mjData (make_data()), so one Scene may serve several threads.
class Scene {
 public:
  /// The ideal robot. @throws ConfigError; std::runtime_error with MuJoCo's words if it refuses the
  /// model, or if the start pose collides.
  explicit Scene(const std::filesystem::path& rig_folder);
  /// Any change of a rig's description. As many geoms, joints and parts, in the same order, as the
  /// rig's own scene: its SIM_STATE can be rendered by a camera that knows the rig alone. The start
  /// pose may collide. @throws std::runtime_error if MuJoCo refuses the model.
  explicit Scene(SceneDescription description);

  const Robot& robot() const { return description_.robot; }
  const Markers& markers() const { return robot().markers; }
  const Signals& signals() const { return description_.signals; }
  const SceneDescription& description() const { return description_; }
  const mjModel& model() const { return *model_; }
  /// The model's MJCF, for example to look at it in MuJoCo's own viewer (tags are plain white).
  const std::string& mjcf() const { return mjcf_; }

  /// Geom whose front face carries tag `tag_id`. @throws std::out_of_range.
  int tag_geom(int tag_id) const;
  /// Geoms of the plates of `part`, which must become invisible to hide it.
  std::vector<int> plate_geoms(int part) const;

  /// At the start pose, at rest, forward kinematics done.
  MjDataPtr make_data() const;
  /// Puts the joints there at once, at rest, and computes all poses and contacts.
  void set_joint_positions(mjData& data, const Eigen::VectorXd& positions) const;
  Eigen::VectorXd joint_positions(const mjData& data) const;
  /// [rad/s or m/s]
  double joint_speed(const mjData& data, int joint) const;
  /// The first contact that should not be: "link 3 would touch the floor". Reads data's contacts.
  std::optional<std::string> collision(const mjData& data) const;

  /// X_WB of a part.
  Pose part_pose(const mjData& data, int part_index) const;
  /// X_WM: the marker's frame as it is now, on its part, fallen or floating. @throws
  /// std::out_of_range.
  Pose marker_pose(const mjData& data, int tag_id) const;
  /// SIM_STATE of these poses, every geom but those of tools that are not mounted opaque, utime as
  /// in `data`, seed 0 and action_id -1.
  sim_state_t state(const mjData& data) const;
  /// SIM_STATE as it is when a perfect servo has carried out `action`; no physics, no limits.
  /// @throws std::invalid_argument on a wrong number of signals.
  sim_state_t state_at(const Eigen::VectorXd& action, std::int64_t seed,
                       std::int64_t action_id) const;

 private:
  int board_geom(int tag_id) const;

  SceneDescription description_;
  std::string mjcf_;
  MjModelPtr model_;
  std::vector<int> qpos_address_;  // of each joint
  std::vector<int> dof_address_;   // of each joint
  std::vector<int> part_body_;     // MuJoCo body of each part's link
};

/// Thickness of a tag's printed sheet in the scene [m]; its front face is the marker's z = 0.
inline constexpr double kSheetThickness_m = 0.001;
/// Texels a side of a tag's texture: 10 cells of 16, so that five levels of mip maps halve exactly.
inline constexpr int kTagTexels = 160;

/// Names within the model, shared with the renderer.
std::string tag_name(int tag_id);

}  // namespace bodyschema
