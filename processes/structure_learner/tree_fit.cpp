#include "processes/structure_learner/tree_fit.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include "common/estimation/levenberg_marquardt.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/serial_correlation.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
bool is_at_rest(const PairData& data, const NormalizedActions& actions,
                const ValidityOptions& options) {
  const Start start = screen_rigid(data, actions);
  if (!(start.score < kMaxRigidStartCost) && !options.allows_far_outliers) return false;
  const Fit fit = fit_local_model(start.model, data, actions, 20, 1e-4);
  return check_validity(fit, leave_one_out(fit, data, actions), data, actions, options).verdict ==
         Verdict::kValid;
}

TreeFit::TreeFit(std::vector<TreeNode> nodes, std::vector<PairData> data,
                 const NormalizedActions& actions, bool root_rests)
    : nodes_(std::move(nodes)), data_(std::move(data)), actions_(actions), root_rests_(root_rests) {
  std::set<int> seen;
  for (const PairData& d : data_)
    for (const PairFrame& f : d.frames) seen.insert(f.sample);
  samples_.assign(seen.begin(), seen.end());
  frame_index_.assign(samples_.size() * nodes_.size(), -1);
  for (std::size_t n = 0; n < nodes_.size(); ++n) {
    for (int t = 0; t < data_[n].size(); ++t) {
      const auto it = std::lower_bound(samples_.begin(), samples_.end(), data_[n].frames[t].sample);
      frame_index_[at(static_cast<int>(it - samples_.begin()), static_cast<int>(n))] = t;
    }
  }
  start_roots();
  cost_ = evaluate(nodes_, roots_, &poses_, &fits_);
}

double TreeFit::evaluate(const std::vector<TreeNode>& nodes, const std::vector<Pose>& roots,
                         std::vector<Pose>* poses, std::vector<FrameFit>* fits) const {
  poses->resize(frame_index_.size());
  fits->resize(frame_index_.size());
  double cost = 0;
  for (int t = 0; t < num_frames(); ++t) {
    for (int n = 0; n < static_cast<int>(nodes.size()); ++n) {
      Pose& X = (*poses)[at(t, n)];
      X = nodes[n].parent < 0
              ? roots[root_rests_ ? 0 : t]
              : (*poses)[at(t, nodes[n].parent)] * nodes[n].model.predict(actions_, samples_[t]);
      const int frame = frame_index_[at(t, n)];
      if (frame < 0) continue;
      FrameFit& fit = (*fits)[at(t, n)];
      fit = best_reading(data_[n], frame, X);
      cost += fit.cost();
    }
  }
  return cost;
}

// The root's poses that most markers agree with, seen through the tree.
void TreeFit::start_roots() {
  const int n = static_cast<int>(nodes_.size());
  std::vector<Pose> X_RB(frame_index_.size(), Pose::Identity());
  for (int t = 0; t < num_frames(); ++t)
    for (int k = 0; k < n; ++k)
      if (nodes_[k].parent >= 0)
        X_RB[at(t, k)] =
            X_RB[at(t, nodes_[k].parent)] * nodes_[k].model.predict(actions_, samples_[t]);
  const auto cost_at = [&](int t, const Pose& root) {
    double cost = 0;
    for (int k = 0; k < n; ++k)
      if (const int frame = frame_index_[at(t, k)]; frame >= 0)
        cost += best_reading(data_[k], frame, root * X_RB[at(t, k)]).cost();
    return cost;
  };
  if (root_rests_) {
    roots_.assign(1, Pose::Identity());
    double best = std::numeric_limits<double>::infinity();
    constexpr int kCandidates = 8;
    const int count = std::min(data_[0].size(), kCandidates);
    for (int c = 0; c < count; ++c) {
      const Pose X = data_[0].primary(c * data_[0].size() / count).z;
      double cost = 0;
      for (int t = 0; t < data_[0].size(); ++t) cost += best_reading(data_[0], t, X).cost();
      if (cost < best) {
        best = cost;
        roots_[0] = X;
      }
    }
    return;
  }
  roots_.assign(num_frames(), Pose::Identity());
  for (int t = 0; t < num_frames(); ++t) {
    double best = std::numeric_limits<double>::infinity();
    for (int k = 0; k < n; ++k) {
      const int frame = frame_index_[at(t, k)];
      if (frame < 0) continue;
      const Pose X = data_[k].primary(frame).z * X_RB[at(t, k)].inverse();
      const double cost = cost_at(t, X);
      if (cost < best) {
        best = cost;
        roots_[t] = X;
      }
    }
  }
}

double TreeFit::serial_correlation() const {
  if (actions_.blocks().is_stream()) return 0;
  SerialCorrelation series;
  for (int t = 1; t < num_frames(); ++t) {
    if (samples_[t] != samples_[t - 1] + 1) continue;
    for (int n = 0; n < static_cast<int>(nodes_.size()); ++n)
      if (frame_index_[at(t - 1, n)] >= 0 && frame_index_[at(t, n)] >= 0)
        series.add(fits_[at(t - 1, n)], fits_[at(t, n)]);
  }
  return series.coefficient(num_frames());
}

// Information and gradient of a frame: of each node's marker, and of all markers from there on.
void TreeFit::gather(int t, Normal* normal) const {
  for (int k = static_cast<int>(nodes_.size()); k-- > 0;) {
    const int index = at(t, k);
    if (const int frame = frame_index_[index]; frame >= 0) {
      const FrameFit& fit = fits_[index];
      const PairHypothesis& h = data_[k].hypotheses[fit.hypothesis];
      const Pose X_BC = poses_[index].inverse();
      const Matrix6d A = h.residual_jacobian(fit.error, poses_[index]) * adjoint(X_BC);
      const double w = fit.weight();
      normal->own_I[index].noalias() = w * A.transpose() * A;
      normal->own_gradient[index].noalias() = w * A.transpose() * fit.residual;
      normal->I[index] += normal->own_I[index];
      normal->gradient[index] += normal->own_gradient[index];
      normal->weighted += w * w * fit.squared_distance;
      normal->weights += w * fit.num_residuals;
      normal->num_residuals += fit.num_residuals;
    }
    if (k == 0) {
      normal->S[index] = adjoint(poses_[index]);
      continue;
    }
    ParameterJacobian J;
    predict_with_jacobian(nodes_[k].model, actions_, samples_[t], &J);
    normal->S[index].noalias() = adjoint(poses_[index]).lazyProduct(J);
    normal->I[at(t, nodes_[k].parent)] += normal->I[index];
    normal->gradient[at(t, nodes_[k].parent)] += normal->gradient[index];
  }
  if (root_rests_) return;
  Matrix6d total = normal->I[at(t, 0)];
  total.diagonal().array() += 1e-12 * total.trace();
  normal->inverse_total.push_back(total.llt().solve(Matrix6d::Identity()));
}

// The frame's share of H and g, blocks at (row of the later node, column of the earlier): the lower
// triangle.
void TreeFit::add_frame(int t, Normal* normal) const {
  for (int k = root_rests_ ? 0 : 1; k < static_cast<int>(nodes_.size()); ++k) {
    const ParameterJacobian& S = normal->S[at(t, k)];
    const ParameterJacobian IS = normal->I[at(t, k)].lazyProduct(S);
    normal->g.segment(normal->offset[k], S.cols()) +=
        S.transpose().lazyProduct(normal->gradient[at(t, k)]);
    for (int e = k;; e = nodes_[e].parent) {
      const ParameterJacobian& S_e = normal->S[at(t, e)];
      if (e != 0 || root_rests_)
        normal->H.block(normal->offset[k], normal->offset[e], S.cols(), S_e.cols()) +=
            IS.transpose().lazyProduct(S_e);
      if (nodes_[e].parent < 0) break;
    }
    if (root_rests_) continue;
    const ParameterJacobian TIS = normal->inverse_total[t].lazyProduct(IS);
    normal->g.segment(normal->offset[k], S.cols()) -= TIS.transpose() * normal->gradient[at(t, 0)];
    for (int e = 1; e <= k; ++e) {
      const ParameterJacobian& S_e = normal->S[at(t, e)];
      normal->H.block(normal->offset[k], normal->offset[e], S.cols(), S_e.cols()) -=
          TIS.transpose().lazyProduct(normal->I[at(t, e)].lazyProduct(S_e).eval());
    }
  }
}

TreeFit::Normal TreeFit::normal_equations() const {
  const int n = static_cast<int>(nodes_.size());
  Normal result;
  result.offset.assign(n, 0);
  int size = root_rests_ ? 6 : 0;
  for (int k = 1; k < n; ++k) {
    result.offset[k] = size;
    size += nodes_[k].model.num_parameters();
  }
  result.H = Eigen::MatrixXd::Zero(size, size);
  result.g = Eigen::VectorXd::Zero(size);
  result.S.resize(frame_index_.size());
  result.I.assign(frame_index_.size(), Matrix6d::Zero());
  result.gradient.assign(frame_index_.size(), Vector6d::Zero());
  result.own_I = result.I;
  result.own_gradient = result.gradient;
  for (int t = 0; t < num_frames(); ++t) {
    gather(t, &result);
    add_frame(t, &result);
  }
  result.H = Eigen::MatrixXd(result.H.selfadjointView<Eigen::Lower>());
  const double count = result.num_residuals;
  const double dof = std::max(count - size - (root_rests_ ? 0 : 6 * num_frames()), 1.0);
  if (result.weights > 0) result.scale = result.weighted / result.weights * (count / dof);
  return result;
}

void TreeFit::move_by(const Eigen::VectorXd& step, const Normal& normal,
                      std::vector<TreeNode>* nodes, std::vector<Pose>* roots) const {
  const int n = static_cast<int>(nodes_.size());
  const auto step_of = [&](int k) {
    return step.segment(normal.offset[k], nodes_[k].model.num_parameters());
  };
  for (int k = 1; k < n; ++k) (*nodes)[k].model = perturbed(nodes_[k].model, step_of(k));
  if (root_rests_) {
    (*roots)[0] = roots_[0] * exp(step.head<6>());
    return;
  }
  for (int t = 0; t < num_frames(); ++t) {
    Vector6d b = normal.gradient[at(t, 0)];
    for (int k = 1; k < n; ++k) b += normal.I[at(t, k)] * (normal.S[at(t, k)] * step_of(k));
    (*roots)[t] = exp(Vector6d(-normal.inverse_total[t] * b)) * roots_[t];
  }
}

void TreeFit::fit(int max_iterations, double tolerance) {
  // Where an iteration costs many times what a trial does. Chosen: longer steps may also lead to
  // another minimum, and small trees need them least.
  constexpr std::size_t kManyNodes = 15;
  constexpr double kLongestStep = 64;
  const bool goes_farther = nodes_.size() >= kManyNodes;
  LevenbergMarquardt optimizer(1e-4, 1e-10, 6);
  struct Moved {
    std::vector<TreeNode> nodes;
    std::vector<Pose> roots, poses;
    std::vector<FrameFit> fits;
    double cost;
  };
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    const Normal normal = normal_equations();
    if (normal.H.rows() == 0) return;  // one part that moves: each root is at its marker
    const auto moved = [&](const Eigen::VectorXd& step) {
      Moved result{nodes_, roots_, {}, {}, 0};
      move_by(step, normal, &result.nodes, &result.roots);
      result.cost = evaluate(result.nodes, result.roots, &result.poses, &result.fits);
      return result;
    };
    double decrease = 0;
    const bool improved = optimizer.step(normal.H, normal.g, [&](const Eigen::VectorXd& step) {
      Moved best = moved(step);
      if (!(best.cost < cost_)) return false;
      // With the weights of a heavy-tailed cost the curvature is overestimated where many residuals
      // are large, and steps are too short.
      for (double length = 2; goes_farther && length <= kLongestStep; length *= 2) {
        Moved farther = moved(length * step);
        if (!(farther.cost < best.cost)) break;
        best = std::move(farther);
      }
      decrease = cost_ - best.cost;
      cost_ = best.cost;
      nodes_ = std::move(best.nodes);
      roots_ = std::move(best.roots);
      poses_ = std::move(best.poses);
      fits_ = std::move(best.fits);
      return true;
    });
    if (!improved || decrease < tolerance) break;
  }
}

std::vector<MotionJacobian> TreeFit::joint_twists(int frame) const {
  std::vector<MotionJacobian> result(nodes_.size(), MotionJacobian(6, 0));
  for (int k = 1; k < static_cast<int>(nodes_.size()); ++k)
    result[k] =
        adjoint(pose(frame, k)) * motion_jacobian(nodes_[k].model, actions_, samples_[frame]);
  return result;
}

double TreeFit::log_likelihood() const {
  double sum = -cost_;
  for (int t = 0; t < num_frames(); ++t)
    for (std::size_t k = 0; k < nodes_.size(); ++k)
      if (const int index = at(t, static_cast<int>(k)); frame_index_[index] >= 0)
        sum -= 0.5 * data_[k].hypotheses[fits_[index].hypothesis].log_det;
  return sum;
}

bool TreeFit::is_below(int node, int ancestor) const {
  while (node > ancestor) node = nodes_[node].parent;
  return node == ancestor;
}

}  // namespace bodyschema
