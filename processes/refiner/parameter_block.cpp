#include "processes/refiner/parameter_block.h"

#include <algorithm>
#include <cmath>

#include "common/kinematics/screw_chain.h"

namespace bodyschema {

Pose pose_at(const double* values) {
  Pose X;
  X.matrix() = Eigen::Map<const Eigen::Matrix4d>(values);
  return X;
}

void ParameterBlock::add(const Pose& X) {
  for (auto* numbers : {&values, &start})
    numbers->insert(numbers->end(), X.matrix().data(), X.matrix().data() + kPoseSize);
  elements += 'X';
}

void ParameterBlock::add(double scalar) {
  values.push_back(scalar);
  start.push_back(scalar);
  elements += 's';
}

int ParameterBlock::tangent_size() const {
  int size = 0;
  for (const char element : elements) size += element == 'X' ? 6 : 1;
  return size;
}

void ParameterBlock::plus(const double* x, const double* delta, double* x_plus_delta) const {
  Eigen::VectorXd step = Eigen::VectorXd::Zero(tangent_size());
  for (std::size_t n = 0; n < free.size(); ++n) step(free[n]) = delta[n];
  int at = 0;
  for (const char element : elements) {
    if (element == 's') {
      *x_plus_delta++ = *x++ + step(at++);
      continue;
    }
    Pose moved = pose_at(x) * exp(Vector6d(step.segment<6>(at)));
    moved.linear() = nearest_rotation(moved.linear());
    std::copy_n(moved.matrix().data(), kPoseSize, x_plus_delta);
    x += kPoseSize;
    x_plus_delta += kPoseSize;
    at += 6;
  }
}

Eigen::VectorXd ParameterBlock::change() const {
  Eigen::VectorXd change(tangent_size());
  int at = 0;
  const double *now = values.data(), *before = start.data();
  for (const char element : elements) {
    if (element == 's') {
      change(at++) = *now++ - *before++;
      continue;
    }
    change.segment<6>(at) = log(pose_at(before).inverse() * pose_at(now));
    now += kPoseSize;
    before += kPoseSize;
    at += 6;
  }
  return change;
}

bool BlockManifold::Plus(const double* x, const double* delta, double* x_plus_delta) const {
  block_.plus(x, delta, x_plus_delta);
  return true;
}

bool BlockManifold::PlusJacobian(const double* /*x*/, double* jacobian) const {
  Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>(
      jacobian, AmbientSize(), TangentSize())
      .setIdentity();
  return true;
}

ParameterBlock edge_block(const Edge& edge, int index, bool is_position) {
  ParameterBlock block;
  block.kind = ParameterBlock::Kind::kEdge;
  block.id = index;
  block.add(edge.left);
  const auto free_pose = [&](int at, const std::vector<int>& components) {
    for (const int component : components) block.free.push_back(at + component);
  };
  for (int d = 0; d < static_cast<int>(edge.joints.size()); ++d) {
    const ScrewJoint& joint = edge.joints[d];
    block.add(joint.slide);
    block.add(joint.turn);
    block.add(joint.X_after);
    if (joint.gain == 0) continue;  // stuck: the transform that follows has its displacement
    // The screw's axis is z of the frame that the transform before it ends in.
    const std::vector<int> axis = joint.turn != 0    ? std::vector<int>{0, 1, 3, 4}
                                  : joint.slide != 0 ? std::vector<int>{3, 4}
                                                     : std::vector<int>{};
    free_pose(ScrewChainLayout::transform(d), axis);
    if (joint.slide != 0) block.free.push_back(ScrewChainLayout::slide(d));
    if (joint.turn != 0) block.free.push_back(ScrewChainLayout::turn(d));
  }
  const std::vector<int> last =
      is_position ? std::vector<int>{0, 1, 2} : std::vector<int>{0, 1, 2, 3, 4, 5};
  free_pose(ScrewChainLayout::transform(static_cast<int>(edge.joints.size())), last);
  return block;
}

double half_travel(const BodySchema& schema, const ScrewJoint& joint) {
  const Signal& signal = schema.signals.at(joint.signal);
  return 0.5 * std::abs(joint.gain) * (signal.upper - signal.lower);
}

Edge edge_from(const ParameterBlock& block, Edge edge) {
  edge.left = pose_at(block.values.data());
  for (int d = 0; d < static_cast<int>(edge.joints.size()); ++d) {
    edge.joints[d].slide = block.values[value_of_slide(d)];
    edge.joints[d].turn = block.values[value_of_slide(d) + 1];
    edge.joints[d].X_after = pose_at(&block.values[value_of_transform(d)]);
  }
  return edge;
}

}  // namespace bodyschema
