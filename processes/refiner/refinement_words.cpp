#include "processes/refiner/refinement_words.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <set>
#include <utility>

#include "common/kinematics/screw_chain.h"

namespace bodyschema {
namespace {

using Kind = ParameterBlock::Kind;

constexpr std::array<const char*, 6> kPoseWords = {"x", "y", "z", "about x", "about y", "about z"};
/// A parameter that has more of it than this is named with a direction that nothing tells: chosen,
/// a direction of many parameters has a hundredth of each.
constexpr double kNamedShare = 0.01;
/// With a larger deviation a turn or a length, a gain's over half its range, is not told: chosen,
/// errors are no longer linear in such a turn, and no arm is built so badly.
constexpr double kLargestDeviation_rad = 0.5, kLargestDeviation_m = 0.1;
/// A signal that spans more of its range need not move farther; chosen.
constexpr double kFarShare = 0.5;

/// The last transform of an edge with joints, and where it is in the tangent; −1: none.
int last_transform(const Edge& edge) {
  return edge.joints.empty() ? -1 : ScrewChainLayout::transform(std::ssize(edge.joints));
}

}  // namespace

RefinementWords::RefinementWords(const BodySchema& start, const Information& information,
                                 std::vector<int> frame_tags, std::vector<SignalCoverage> coverage)
    : schema_(start),
      information_(information),
      frame_tags_(std::move(frame_tags)),
      coverage_(std::move(coverage)),
      covariance_(information.covariance()) {
  const Eigen::MatrixXd& open = information.undetermined();
  undetermined_shares_ = open.cols() > 0 ? Eigen::VectorXd(open.rowwise().squaredNorm())
                                         : Eigen::VectorXd::Zero(covariance_.rows());
  for (const ParameterBlock* block : information.blocks()) add(*block);
}

void RefinementWords::add(const ParameterBlock& block) {
  Eigen::VectorXd change = block.change();
  const int first = information_.offset(&block);
  if (block.kind == Kind::kEdge) {
    const Edge edge = edge_from(block, schema_.edges[block.id]);
    const int last = last_transform(edge);
    // A part of which positions alone are known has a free translation alone.
    if (last >= 0 && block.free.back() == last + 5) {
      const Matrix6d to_joint = adjoint(edge.joints.back().X_after);
      const auto row = first + block.num_free() - 6;
      change.segment<6>(last) = (to_joint * change.segment<6>(last)).eval();
      covariance_.middleRows<6>(row) = (to_joint * covariance_.middleRows<6>(row)).eval();
      covariance_.middleCols<6>(row) =
          (covariance_.middleCols<6>(row) * to_joint.transpose()).eval();
    }
  }
  for (int n = 0; n < block.num_free(); ++n) {
    const int direction = block.free[n];
    places_.push_back({&block, direction, name_of(block, direction)});
    RefinedParameter parameter{places_.back().element, block.kind == Kind::kTag ? block.id : -1,
                               unit_of(block, direction), change(direction), std::nullopt};
    determined_.push_back(is_determined(places_.back(), first + n));
    if (determined_.back())
      parameter.sd = std::sqrt(std::max(covariance_(first + n, first + n), 0.0));
    parameters_.push_back(std::move(parameter));
  }
}

bool RefinementWords::is_determined(const Place& place, Eigen::Index row) const {
  if (undetermined_shares_(row) >= kNamedShare) return false;
  const std::string unit = unit_of(*place.block, place.direction);
  double reach = 1;
  if (unit.ends_with("/unit"))
    reach = half_travel(schema_, joint_of(*place.block, place.direction));
  const double sd = reach * std::sqrt(std::max(covariance_(row, row), 0.0));
  if (unit.starts_with("rad")) return sd <= kLargestDeviation_rad;
  return !unit.starts_with("m") || sd <= kLargestDeviation_m;
}

std::string RefinementWords::thing_of(const ParameterBlock& block) const {
  switch (block.kind) {
    case Kind::kInstant:
      break;
    case Kind::kRoot:
      return "root in the camera's frame";
    case Kind::kEdge: {
      const Edge& edge = schema_.edges[block.id];
      return fmt::format("{}→{}", edge.from, edge.to);
    }
    case Kind::kDrive:
      return "commands";
    case Kind::kTag:
      return fmt::format("tag {}", block.id);
    case Kind::kLens:
      return "lens";
  }
  return "";
}

const ScrewJoint& RefinementWords::joint_of(const ParameterBlock& block, int direction) const {
  const std::vector<ScrewJoint>& joints = schema_.edges[block.id].joints;
  return joints[std::min(static_cast<std::size_t>(ScrewChainLayout::screw_of(direction)),
                         joints.size() - 1)];
}

std::string RefinementWords::edge_name(const ParameterBlock& block, int direction) const {
  const Edge& edge = schema_.edges[block.id];
  std::string thing = thing_of(block);
  if (edge.joints.empty()) return fmt::format("{}, {}", thing, kPoseWords[direction]);
  const int d = ScrewChainLayout::screw_of(direction);
  const int component = direction - ScrewChainLayout::transform(d);
  const int num_joints = static_cast<int>(edge.joints.size());
  const ScrewJoint& joint = joint_of(block, direction);
  const std::string& signal = schema_.signals.at(joint.signal).name;
  if (std::ranges::count(edge.joints, joint.signal, &ScrewJoint::signal) > 1)
    thing += fmt::format(", joint {}", std::min(d, num_joints - 1) + 1);
  if (d == num_joints) {
    if (component == 5 && joint.turn != 0) return fmt::format("offset of {} ({})", signal, thing);
    return fmt::format("link after {} ({}), {}", signal, thing, kPoseWords[component]);
  }
  if (component == 6) return fmt::format("travel of {} ({})", signal, thing);
  if (component == 7) return fmt::format("gain of {} ({})", signal, thing);
  return fmt::format("axis of {} ({}), {}", signal, thing, kPoseWords[component]);
}

std::string RefinementWords::name_of(const ParameterBlock& block, int direction) const {
  switch (block.kind) {
    case Kind::kInstant:
      break;
    case Kind::kRoot:
      return fmt::format("{}, {}", thing_of(block), kPoseWords[direction]);
    case Kind::kEdge:
      return edge_name(block, direction);
    case Kind::kDrive:
      return block.names.at(direction);
    case Kind::kTag:
      if (direction == 6) return fmt::format("size of tag {}", block.id);
      return fmt::format("placement of tag {}, {}", block.id, kPoseWords[direction]);
    case Kind::kLens: {
      constexpr std::array<const char*, 4> kWords = {"focal length x", "focal length y", "centre x",
                                                     "centre y"};
      if (direction < 4) return kWords[direction];
      return fmt::format("distortion {}", direction - 3);
    }
  }
  return "";
}

std::string RefinementWords::unit_of(const ParameterBlock& block, int direction) const {
  if (block.kind == Kind::kLens) return direction < 4 ? "px" : "1";
  if (block.kind == Kind::kDrive) return "unit";
  if (block.kind == Kind::kTag && direction == 6) return "1";
  const int component =
      block.kind == Kind::kEdge
          ? direction - ScrewChainLayout::transform(ScrewChainLayout::screw_of(direction))
          : direction;
  constexpr std::array<const char*, 8> kUnits = {"m",   "m",   "m",      "rad",
                                                 "rad", "rad", "m/unit", "rad/unit"};
  return kUnits[component];
}

std::vector<std::string> RefinementWords::undetermined() const {
  const Eigen::MatrixXd& open = information_.undetermined();
  const Eigen::MatrixXd shared = open * open.transpose();
  std::vector<std::vector<Eigen::Index>> groups;  // of blocks that share open directions
  for (Eigen::Index n = 0; n < std::ssize(places_); ++n) {
    if (determined_[n]) continue;
    std::vector<Eigen::Index> group = {n};
    std::erase_if(groups, [&](const std::vector<Eigen::Index>& other) {
      const bool is_same = std::ranges::any_of(other, [&](Eigen::Index m) {
        return places_[m].block == places_[n].block || std::abs(shared(n, m)) >= kNamedShare;
      });
      if (is_same) group.insert(group.begin(), other.begin(), other.end());
      return is_same;
    });
    groups.push_back(std::move(group));
  }
  std::vector<std::string> result;
  for (const std::vector<Eigen::Index>& group : groups) {
    std::vector<Place> places;
    std::vector<std::string> names;
    for (const Eigen::Index n : group) {
      places.push_back(places_[n]);
      names.push_back(places_[n].element);
    }
    const bool is_of_one = std::ranges::all_of(
        places, [&](const Place& place) { return place.block == places.front().block; });
    const std::string listed = fmt::format("{}", fmt::join(names, "; "));
    std::string sentence = is_of_one ? fmt::format("the samples do not tell {}: {}",
                                                   thing_of(*places.front().block), listed)
                                     : fmt::format("the samples do not tell apart {}", listed);
    if (const std::string more = advice(places); !more.empty()) sentence += ": " + more;
    result.push_back(std::move(sentence));
  }
  return result;
}

std::string RefinementWords::advice(const std::vector<Place>& places) const {
  std::set<int> tags;
  std::set<std::string> signals, hardly_moved;
  for (const Place& place : places) {
    const ParameterBlock& block = *place.block;
    if (block.kind == Kind::kLens) return "show tags nearer and farther, and at the image's border";
    if (block.kind == Kind::kTag) tags.insert(block.id);
    if (block.kind != Kind::kEdge || schema_.edges[block.id].joints.empty()) continue;
    const SignalCoverage& signal = coverage_.at(joint_of(block, place.direction).signal);
    signals.insert(signal.signal);
    if (signal.share <= kFarShare) hardly_moved.insert(signal.signal);
  }
  if (tags.size() > 1) return fmt::format("show tags {} in one image", fmt::join(tags, ", "));
  if (signals.empty()) return "";
  const std::string names = fmt::format("{}", fmt::join(signals, ", "));
  if (!tags.empty()) return fmt::format("show tag {} while {} moves", *tags.begin(), names);
  if (hardly_moved.empty()) return "show a part farther from the axis of " + names;
  return fmt::format("move {} farther{}", fmt::join(hardly_moved, ", "),
                     hardly_moved.size() > 1 ? " and in other combinations" : "");
}

// The covariance given what is_frame() says. Zero rows where that is.
Eigen::MatrixXd RefinementWords::in_frames_of_tags() const {
  std::vector<Eigen::Index> given;
  for (std::size_t n = 0; n < places_.size(); ++n)
    if (is_frame(frame_tags_, *places_[n].block, places_[n].direction))
      given.push_back(static_cast<Eigen::Index>(n));
  if (given.empty()) return covariance_;
  const Eigen::MatrixXd of_given = covariance_(given, given);
  const Eigen::MatrixXd mixed = covariance_(Eigen::all, given);
  Eigen::MatrixXd rest = covariance_ - mixed * of_given.ldlt().solve(mixed.transpose());
  for (const Eigen::Index n : given) rest.row(n).setZero();
  for (const Eigen::Index n : given) rest.col(n).setZero();
  return rest;
}

std::vector<ParameterCorrelation> RefinementWords::correlations(std::size_t most) const {
  std::vector<ParameterCorrelation> result;
  const Eigen::MatrixXd covariance = in_frames_of_tags();
  const Eigen::VectorXd sd = covariance.diagonal().cwiseMax(0).cwiseSqrt();
  for (Eigen::Index i = 0; i < covariance.rows(); ++i) {
    for (Eigen::Index j = 0; j < i; ++j) {
      if (!determined_[i] || !determined_[j]) continue;
      const double correlation = covariance(i, j) / (sd(i) * sd(j));
      if (!(std::abs(correlation) > kHighCorrelation)) continue;
      const Place &one = places_[j], &other = places_[i];
      // Terms of one curve.
      if (one.block->kind == Kind::kDrive && other.block->kind == Kind::kDrive) continue;
      result.push_back({one.element, other.element, correlation, advice({one, other})});
    }
  }
  std::stable_sort(result.begin(), result.end(), [](const auto& a, const auto& b) {
    return std::abs(a.correlation) > std::abs(b.correlation);
  });
  if (result.size() > most) result.resize(most);
  return result;
}

}  // namespace bodyschema
