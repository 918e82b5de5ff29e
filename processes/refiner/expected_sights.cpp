#include "processes/refiner/expected_sights.h"

#include <algorithm>
#include <cmath>

#include "common/camera/fit_pose.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema {
namespace {

/// From where the camera sees it: the camera's direction in the part's frame; of a position alone
/// the part's direction in the camera's.
Eigen::Vector3d view_direction(const Pose& X_CB, bool has_rotation) {
  const Pose X = has_rotation ? X_CB.inverse() : X_CB;
  return X.translation().normalized();
}

}  // namespace

ExpectedSights::ExpectedSights(const BodySchema& schema, const std::optional<RigCalibration>& rig,
                               const std::vector<RefinerSample>& samples,
                               RefinementProblem& problem)
    : schema_(schema), rig_(rig) {
  if (rig_) lens_ = lens_of(rig_->camera);
  std::vector<SeenAction> past;
  for (const RefinerSample& seen : samples) {
    const ActionPoseSample& sample = seen.sample;
    if (!problem.has_root(sample.sample_index)) continue;
    last_ = &sample;
    X_CR_ = problem.X_CR(sample.sample_index);
    if (rig_) {
      remember_tags(seen, X_CR_);
      continue;
    }
    SeenAction& action = past.emplace_back();
    action.sample_index = sample.sample_index;
    action.action = sample.action;
    for (const PartObservation& observation : sample.parts) {
      action.parts.insert(observation.part);
      parts_[observation.part].push_back(&observation);
    }
  }
  if (!rig_) visibility_.emplace(schema, past);
}

std::optional<ExpectedSights::View> ExpectedSights::view_of(const TagPlacement& tag,
                                                            const Pose& X_CB) const {
  const Pose X_CM = X_CB * tag.X_BM.value_or(Pose::Identity());
  const Eigen::Vector3d to_tag = X_CM.translation().normalized();
  if (X_CM.linear().col(2).dot(to_tag) < std::cos(kMostTilt_rad)) return std::nullopt;
  View view;
  view.sight.tag = tag.id;
  view.direction = -(X_CM.linear().transpose() * to_tag);
  const std::vector<Eigen::Vector3d> corners = tag_corners(tag.size_m);
  for (int c = 0; c < 4; ++c) {
    const Eigen::Vector3d p_C = X_CM * corners[c];
    if (!(p_C.z() > 0)) return std::nullopt;
    const Eigen::Vector2d p_px = lens_->project(p_C.head<2>() / p_C.z());
    const bool is_inside =
        p_px.minCoeff() >= 0 && p_px.x() < lens_->width() && p_px.y() < lens_->height();
    if (!is_inside) return std::nullopt;
    view.sight.corners_px.segment<2>(2 * c) = p_px;
  }
  return view;
}

void ExpectedSights::remember_tags(const RefinerSample& seen, const Pose& X_CR) {
  const std::map<int, Pose> X_RB = schema_.predict_all(seen.sample.action);
  for (const TagPlacement& tag : rig_->markers.tags) {
    const auto part = X_RB.find(tag.part);
    if (part == X_RB.end()) continue;
    const auto sight = std::find_if(seen.tags.begin(), seen.tags.end(),
                                    [&](const TagSight& s) { return s.tag == tag.id; });
    auto view = view_of(tag, X_CR * part->second);
    if (!view) continue;
    SeenTag& memory = tags_[tag.id];
    ++memory.num_in_view;
    if (sight == seen.tags.end()) continue;
    ++memory.num_seen;
    view->sight.covariance_px2 = sight->covariance_px2;
    memory.views.push_back(std::move(*view));
  }
}

std::vector<ExpectedSights::Tag> ExpectedSights::tags(const Eigen::VectorXd& action) const {
  std::vector<Tag> result;
  const std::map<int, Pose> X_RB = schema_.predict_all(action);
  for (const TagPlacement& tag : rig_->markers.tags) {
    const auto part = X_RB.find(tag.part);
    const auto memory = tags_.find(tag.id);
    if (part == X_RB.end() || memory == tags_.end() || memory->second.views.empty() ||
        has_moved(schema_.moved_tags, tag.id, sample_index()))
      continue;
    auto view = view_of(tag, X_CR_ * part->second);
    if (!view) continue;
    const auto& [num_in_view, num_seen, views] = memory->second;
    const auto nearest =
        std::max_element(views.begin(), views.end(), [&](const View& a, const View& b) {
          return a.direction.dot(view->direction) < b.direction.dot(view->direction);
        });
    view->sight.covariance_px2 = nearest->sight.covariance_px2;
    result.push_back({view->sight, (num_seen + 1.0) / (num_in_view + 2.0)});
  }
  return result;
}

std::map<int, Pose> ExpectedSights::poses(const Eigen::VectorXd& action) const {
  std::map<int, Pose> poses = schema_.predict_all(action);
  for (auto& [part, X] : poses) X = X_CR_ * X;
  return poses;
}

std::vector<ExpectedSights::Part> ExpectedSights::parts(const Eigen::VectorXd& action) const {
  std::vector<Part> result;
  const std::map<int, Pose> X_CB = poses(action);
  const std::map<int, double> probabilities = visibility_->probabilities(action);
  for (const auto& [part, observations] : parts_) {
    const auto predicted = X_CB.find(part);
    if (predicted == X_CB.end()) continue;
    const auto likeness = [&](const PartObservation* o) {
      return view_direction(o->X_CB, o->has_rotation)
          .dot(view_direction(predicted->second, o->has_rotation));
    };
    const PartObservation* nearest =
        *std::max_element(observations.begin(), observations.end(),
                          [&](const auto* a, const auto* b) { return likeness(a) < likeness(b); });
    Part& expected = result.emplace_back(Part{*nearest, probabilities.at(part)});
    expected.observation.X_CB_other.reset();
    expected.observation.X_CB = predicted->second;
    if (!nearest->has_rotation) expected.observation.X_CB.linear().setIdentity();
  }
  return result;
}

}  // namespace bodyschema
