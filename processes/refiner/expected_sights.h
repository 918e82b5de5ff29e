#pragma once

#include <Eigen/Core>
#include <map>
#include <optional>
#include <vector>

#include "common/camera/lens.h"
#include "common/schema/body_schema.h"
#include "common/schema/visibility.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// What the camera is expected to see at an action that was not taken yet: by the refined model,
/// and by what it saw at the samples. Where the root moves it is taken to be as at the last of
/// them.
class ExpectedSights {
 public:
  /// `rig`: none where poses were fitted. One sample at least has a root. All arguments must
  /// outlive this.
  ExpectedSights(const BodySchema& schema, const std::optional<RigCalibration>& rig,
                 const std::vector<RefinerSample>& samples, RefinementProblem& problem);

  struct Tag {
    TagSight sight;
    double probability = 0;
  };
  /// Tags that face the camera within kMostTilt_rad and lie in the image, as probable as they were
  /// seen where they did so, with the covariance of the sight from the most similar direction.
  std::vector<Tag> tags(const Eigen::VectorXd& action) const;

  struct Part {
    PartObservation observation;
    double probability = 0;
  };
  /// Parts that were ever seen, as probable as the VisibilityModel says, with the covariance and
  /// the tags of the sight from the most similar direction.
  std::vector<Part> parts(const Eigen::VectorXd& action) const;

  /// X_CB of all parts.
  std::map<int, Pose> poses(const Eigen::VectorXd& action) const;

  /// The sample at which a further one is taken to be: the last that has a root.
  std::int64_t sample_index() const { return last_->sample_index; }
  const Eigen::VectorXd& last_action() const { return last_->action; }

  static constexpr double kMostTilt_rad = 1.2217;  ///< 70°: steeper tags are seldom read

 private:
  /// A tag in view, and how: its corners, and the camera's direction in its frame.
  struct View {
    TagSight sight;
    Eigen::Vector3d direction;
  };
  std::optional<View> view_of(const TagPlacement& tag, const Pose& X_CB) const;
  void remember_tags(const RefinerSample& seen, const Pose& X_CR);

  struct SeenTag {
    int num_in_view = 0, num_seen = 0;
    std::vector<View> views;  ///< with the covariance of what was seen
  };
  const BodySchema& schema_;
  const std::optional<RigCalibration>& rig_;
  std::optional<Lens> lens_;
  const ActionPoseSample* last_ = nullptr;
  Pose X_CR_ = Pose::Identity();
  std::map<int, SeenTag> tags_;
  std::map<int, std::vector<const PartObservation*>> parts_;
  std::optional<VisibilityModel> visibility_;
};

}  // namespace bodyschema
