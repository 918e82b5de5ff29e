#include "processes/refiner/part_chain.h"

#include "common/kinematics/screw_chain.h"
#include "processes/refiner/parameter_block.h"

namespace bodyschema {

PartChain::PartChain(const std::vector<const Edge*>& edges, const Eigen::VectorXd& theta,
                     const std::map<const Edge*, int>& first_play) {
  for (const Edge* edge : edges) {
    Link& link = links_.emplace_back();
    link.has_block = has_block(*edge);
    link.X = link.has_block ? edge->right : edge->predict(theta);
    num_edge_blocks_ += link.has_block ? 1 : 0;
    const auto play = first_play.find(edge);
    for (const ScrewJoint& joint : edge->joints) {
      const int d = static_cast<int>(link.q.size());
      link.play.push_back(play == first_play.end() ? -1 : play->second + d);
      link.gain.push_back(joint.gain);
      link.q.push_back(joint.gain * theta(joint.signal) + joint.offset);
    }
  }
}

Pose PartChain::pose(double const* const* blocks, const Pose& suffix,
                     std::vector<Jacobian>* jacobians, const double* play,
                     Jacobian* by_play) const {
  if (jacobians) jacobians->resize(num_blocks());
  Pose X = suffix;
  int block = num_edge_blocks_;
  std::vector<Pose> transforms;
  for (auto link = links_.rbegin(); link != links_.rend(); ++link) {
    if (!link->has_block) {
      X = link->X * X;
      continue;
    }
    const double* values = blocks[block];
    const int num_joints = static_cast<int>(link->q.size());
    transforms.clear();
    for (int d = -1; d < num_joints; ++d)
      transforms.push_back(pose_at(values + value_of_transform(d)));
    const ScrewChain chain(transforms.front(), num_joints, [&](int d) {
      const double* screw = values + value_of_slide(d);
      const double beyond = play && link->play[d] >= 0 ? link->gain[d] * play[link->play[d]] : 0;
      return ScrewLink{{screw[0], screw[1]}, link->q[d] + beyond, transforms[d + 1]};
    });
    Jacobian unwanted;
    X = chain.predict_by_parameters(jacobians ? &(*jacobians)[block] : &unwanted, link->X * X);
    // A screw's motion is one of the frame before it, along and about z.
    for (int d = 0; by_play && d < num_joints; ++d) {
      if (link->play[d] < 0) continue;
      const auto before = (*jacobians)[block].middleCols<6>(ScrewChainLayout::transform(d));
      const double* screw = values + value_of_slide(d);
      by_play->col(link->play[d]) =
          link->gain[d] * (screw[0] * before.col(2) + screw[1] * before.col(5));
    }
    --block;
  }
  if (jacobians) jacobians->front() = adjoint(X.inverse());
  return pose_at(blocks[0]) * X;
}

}  // namespace bodyschema
