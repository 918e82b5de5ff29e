#include "processes/structure_learner/tree_fit.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <boost/math/special_functions/gamma.hpp>
#include <cmath>
#include <limits>
#include <set>

#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
namespace {

// Of 3 or 6 dimensions, without a heap; one type, for the decompositions are long to compile.
using UpTo6x6 = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 6, 6>;
using UpTo6 = Eigen::Matrix<double, Eigen::Dynamic, 1, Eigen::ColMajor, 6, 1>;

double log_chi_square_tail(double x, int dof) {
  const double tail = boost::math::gamma_q(0.5 * dof, 0.5 * x);
  // Far out the tail underflows; its logarithm is −x/2 to leading order.
  return tail > 1e-300 ? std::log(tail) : -0.5 * x;
}

// X Exp(ŝ) X⁻¹ = Exp(ξ): the frame X of a screw and its slide and turn.
struct Screw {
  Pose X = Pose::Identity();
  double slide = 0, turn = 0;
};

Screw screw_of(const Vector6d& xi, bool slides) {
  const Eigen::Vector3d v = xi.head<3>(), w = xi.tail<3>();
  Screw screw;
  const Eigen::Vector3d direction = slides ? v : w;
  if (!(direction.norm() > 1e-12)) return screw;
  screw.X.linear().col(2) = direction.normalized();
  screw.X.linear().col(0) = screw.X.linear().col(2).unitOrthogonal();
  screw.X.linear().col(1) =
      Eigen::Vector3d(screw.X.linear().col(2)).cross(Eigen::Vector3d(screw.X.linear().col(0)));
  if (slides) {
    screw.slide = v.norm();
  } else {
    screw.X.translation() = w.cross(v) / w.squaredNorm();
    screw.turn = w.norm();
    screw.slide = direction.normalized().dot(v);
  }
  return screw;
}

}  // namespace

bool is_at_rest(const PairData& data, const NormalizedActions& actions,
                const ValidityOptions& options) {
  const Start start = screen_rigid(data, actions);
  if (!(start.score < kMaxRigidStartCost)) return false;
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
      cost += robust_cost(fit.squared_distance);
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
        cost += robust_cost(best_reading(data_[k], frame, root * X_RB[at(t, k)]).squared_distance);
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
      for (int t = 0; t < data_[0].size(); ++t)
        cost += robust_cost(best_reading(data_[0], t, X).squared_distance);
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
  double weighted = 0, weights = 0;
  int count = 0;
  for (int t = 0; t < num_frames(); ++t) {
    for (int k = n; k-- > 0;) {
      const int index = at(t, k);
      if (const int frame = frame_index_[index]; frame >= 0) {
        const FrameFit& fit = fits_[index];
        const PairHypothesis& h = data_[k].hypotheses[fit.hypothesis];
        const Pose X_BC = poses_[index].inverse();
        const Matrix6d A = -(h.whitening * right_jacobian_inverse(-fit.error)) * adjoint(X_BC);
        const double w = robust_weight(fit.squared_distance);
        result.own_I[index].noalias() = w * A.transpose() * A;
        result.own_gradient[index].noalias() = w * A.transpose() * fit.residual;
        result.I[index] += result.own_I[index];
        result.gradient[index] += result.own_gradient[index];
        weighted += w * w * fit.squared_distance;
        weights += w;
        ++count;
      }
      if (k == 0) {
        result.S[index] = adjoint(poses_[index]);
        continue;
      }
      ParameterJacobian J;
      predict_with_jacobian(nodes_[k].model, actions_, samples_[t], &J);
      result.S[index].noalias() = adjoint(poses_[index]).lazyProduct(J);
      result.I[at(t, nodes_[k].parent)] += result.I[index];
      result.gradient[at(t, nodes_[k].parent)] += result.gradient[index];
    }
    if (!root_rests_) {
      Matrix6d total = result.I[at(t, 0)];
      total.diagonal().array() += 1e-12 * total.trace();
      result.inverse_total.push_back(total.llt().solve(Matrix6d::Identity()));
    }
    for (int k = root_rests_ ? 0 : 1; k < n; ++k) {
      const ParameterJacobian& S = result.S[at(t, k)];
      const ParameterJacobian IS = result.I[at(t, k)].lazyProduct(S);
      result.g.segment(result.offset[k], S.cols()) +=
          S.transpose().lazyProduct(result.gradient[at(t, k)]);
      for (int e = k;; e = nodes_[e].parent) {
        const ParameterJacobian& S_e = result.S[at(t, e)];
        if (e != 0 || root_rests_)
          result.H.block(result.offset[k], result.offset[e], S.cols(), S_e.cols()) +=
              IS.transpose().lazyProduct(S_e);
        if (nodes_[e].parent < 0) break;
      }
      if (root_rests_) continue;
      const ParameterJacobian TIS = result.inverse_total[t].lazyProduct(IS);
      result.g.segment(result.offset[k], S.cols()) -= TIS.transpose() * result.gradient[at(t, 0)];
      for (int e = 1; e <= k; ++e) {
        const ParameterJacobian& S_e = result.S[at(t, e)];
        result.H.block(result.offset[k], result.offset[e], S.cols(), S_e.cols()) -=
            TIS.transpose().lazyProduct(result.I[at(t, e)].lazyProduct(S_e).eval());
      }
    }
  }
  // Blocks were written at (row of the later node, column of the earlier): the lower triangle.
  result.H = Eigen::MatrixXd(result.H.selfadjointView<Eigen::Lower>());
  const double dof = std::max(6.0 * count - size - (root_rests_ ? 0 : 6 * num_frames()), 1.0);
  if (weights > 0) result.scale = weighted / weights / 6 * (6.0 * count / dof);
  return result;
}

void TreeFit::fit(int max_iterations, double tolerance) {
  double damping = 1e-4;
  std::vector<Pose> poses;
  std::vector<FrameFit> fits;
  const int n = static_cast<int>(nodes_.size());
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    const Normal normal = normal_equations();
    if (normal.H.rows() == 0) return;  // one part that moves: each root is at its marker
    bool improved = false;
    double decrease = 0;
    for (int attempt = 0; attempt < 6 && !improved; ++attempt) {
      Eigen::MatrixXd damped = normal.H;
      damped.diagonal() += damping * normal.H.diagonal();
      damped.diagonal().array() += 1e-14 * normal.H.diagonal().maxCoeff();
      const Eigen::LLT<Eigen::MatrixXd> llt(damped);
      damping *= 10;
      if (llt.info() != Eigen::Success) continue;
      const Eigen::VectorXd step = -llt.solve(normal.g);
      if (!step.allFinite()) continue;
      std::vector<TreeNode> nodes = nodes_;
      std::vector<Pose> roots = roots_;
      for (int k = 1; k < n; ++k)
        nodes[k].model = perturbed(
            nodes_[k].model, step.segment(normal.offset[k], nodes_[k].model.num_parameters()));
      if (root_rests_) {
        roots[0] = roots_[0] * exp(step.head<6>());
      } else {
        for (int t = 0; t < num_frames(); ++t) {
          Vector6d b = normal.gradient[at(t, 0)];
          for (int k = 1; k < n; ++k)
            b += normal.I[at(t, k)] *
                 (normal.S[at(t, k)] *
                  step.segment(normal.offset[k], nodes_[k].model.num_parameters()));
          roots[t] = exp(Vector6d(-normal.inverse_total[t] * b)) * roots_[t];
        }
      }
      const double cost = evaluate(nodes, roots, &poses, &fits);
      if (!(cost < cost_)) continue;
      decrease = cost_ - cost;
      cost_ = cost;
      nodes_ = std::move(nodes);
      roots_ = std::move(roots);
      poses_.swap(poses);
      fits_.swap(fits);
      improved = true;
      damping = std::max(damping / 100, 1e-10);
    }
    if (!improved || decrease < tolerance) break;
  }
}

double TreeFit::log_likelihood() const {
  double sum = -cost_;
  for (int t = 0; t < num_frames(); ++t)
    for (std::size_t k = 0; k < nodes_.size(); ++k)
      if (const int index = at(t, static_cast<int>(k)); frame_index_[index] >= 0)
        sum -= 0.5 * data_[k].hypotheses[fits_[index].hypothesis].log_det;
  return sum;
}

std::vector<int> TreeFit::full_edges(const MissingJoint& joint) const {
  std::vector<int> result;
  const bool is_full = nodes_[joint.top].model.num_joints == kMaxJoints;
  const std::vector<int> cluster = cluster_of(joint.top);
  const auto unmoved = static_cast<std::ptrdiff_t>(joint.members.size()) < std::ssize(cluster);
  if (!unmoved && is_full && joint.top > 0) result.push_back(joint.top);
  for (int k = 1; k < static_cast<int>(nodes_.size()); ++k) {
    if (nodes_[k].model.num_joints < kMaxJoints ||
        !std::count(cluster.begin(), cluster.end(), nodes_[k].parent))
      continue;
    const bool moves = std::count(joint.branches.begin(), joint.branches.end(), k) > 0;
    if (moves ? joint.members.empty() : !unmoved) result.push_back(k);
  }
  return result;
}

// Nodes from `top` down that rigid edges connect.
std::vector<int> TreeFit::cluster_of(int top) const {
  std::vector<bool> in(nodes_.size(), false);
  std::vector<int> members{top};
  in[top] = true;
  for (int k = top + 1; k < static_cast<int>(nodes_.size()); ++k)
    if (nodes_[k].parent >= 0 && in[nodes_[k].parent] && nodes_[k].model.num_joints == 0) {
      in[k] = true;
      members.push_back(k);
    }
  return members;
}

bool TreeFit::is_below(int node, int ancestor) const {
  while (node > ancestor) node = nodes_[node].parent;
  return node == ancestor;
}

std::vector<MissingJoint> TreeFit::missing_joints(const Noise& bias) const {
  const int n = static_cast<int>(nodes_.size());
  const int T = num_frames();
  const Normal normal = normal_equations();
  const std::optional<Eigen::MatrixXd> inverse = normal.inverse();
  if (!inverse) return {};
  const Eigen::VectorXd newton = *inverse * normal.g;

  const auto& moving = actions_.moving();
  const int m = static_cast<int>(moving.size());
  Eigen::MatrixXd q(T, m);
  for (int t = 0; t < T; ++t)
    for (int s = 0; s < m; ++s) q(t, s) = actions_(samples_[t], moving[s]);
  const Eigen::MatrixXd q2 = q.cwiseProduct(q);
  const double noise_scale = normal.noise_scale();
  Vector6d bias_variances;
  bias_variances << Eigen::Vector3d::Constant(std::pow(bias.position_m, 2)),
      Eigen::Vector3d::Constant(std::pow(bias.rotation_rad, 2));

  std::vector<MissingJoint> result;
  for (int top = 0; top < n; ++top) {
    if (top > 0 && nodes_[top].model.num_joints == 0) continue;
    const std::vector<int> members = cluster_of(top);
    // What may move: the markers of the cluster and the branches on it.
    struct Item {
      int node;
      bool is_branch;
    };
    std::vector<Item> items;
    for (const int k : members)
      if (data_[k].size() > 0) items.push_back({k, false});
    for (int k = top + 1; k < n; ++k)
      if (nodes_[k].model.num_joints > 0 &&
          std::count(members.begin(), members.end(), nodes_[k].parent))
        items.push_back({k, true});
    const int num_items = static_cast<int>(items.size());
    // Of a bias about where the item is, as a twist in the cluster's frame.
    std::vector<Matrix6d> bias_covariance;
    for (const Item& item : items) {
      Pose at_item = Pose::Identity();
      for (int t = 0; t < T; ++t)
        at_item.translation() +=
            (poses_[at(t, top)].inverse() * poses_[at(t, item.node)]).translation() / T;
      const Matrix6d F = adjoint(at_item);
      bias_covariance.push_back(F * bias_variances.asDiagonal() * F.transpose());
    }

    // Parameters that share a marker with the cluster.
    std::vector<int> blocks, columns;
    for (int k = root_rests_ ? 0 : 1; k < n; ++k) {
      if (root_rests_ && !is_below(k, top) && !is_below(top, k)) continue;
      blocks.push_back(k);
      const int p = k == 0 ? 6 : nodes_[k].model.num_parameters();
      for (int c = 0; c < p; ++c) columns.push_back(normal.offset[k] + c);
    }
    const auto p = static_cast<Eigen::Index>(columns.size());
    const Eigen::MatrixXd inverse_related = (*inverse)(columns, columns);
    const Eigen::VectorXd newton_related = newton(columns);

    // Stacked over the frames, for q = 1 and F = Ad(X_top): F_tᵀJ_t, F_tᵀr_t, F_tᵀF_t of each item.
    std::vector<Eigen::MatrixXd> FJ(num_items, Eigen::MatrixXd::Zero(6 * p, T));
    std::vector<Eigen::MatrixXd> Fr(num_items, Eigen::MatrixXd(6, T));
    std::vector<Eigen::MatrixXd> FF(num_items * num_items);
    for (int i = 0; i < num_items; ++i)
      for (int j = 0; j < num_items; ++j)
        if (i == j || !root_rests_) FF[i * num_items + j] = Eigen::MatrixXd::Zero(36, T);
    std::vector<Matrix6d> FI(num_items);
    for (int t = 0; t < T; ++t) {
      const Matrix6d F = adjoint(poses_[at(t, top)]);
      for (int i = 0; i < num_items; ++i) {
        const int k = items[i].node;
        Matrix6d I = normal.I[at(t, k)];
        Vector6d gradient = normal.gradient[at(t, k)];
        if (!items[i].is_branch) {
          // The marker's own share.
          I = normal.own_I[at(t, k)];
          gradient = normal.own_gradient[at(t, k)];
        }
        FI[i] = F.transpose() * I;
        Vector6d r = F.transpose() * gradient;
        if (!root_rests_) r -= FI[i] * (normal.inverse_total[t] * normal.gradient[at(t, 0)]);
        Fr[i].col(t) = r;
        Eigen::Map<Matrix6d>(FF[i * num_items + i].col(t).data()) = FI[i] * F;
        Eigen::Map<Eigen::MatrixXd> fj(FJ[i].col(t).data(), 6, p);
        Eigen::Index column = 0;
        for (const int e : blocks) {
          const ParameterJacobian& S = normal.S[at(t, e)];
          auto block = fj.middleCols(column, S.cols());
          if (items[i].is_branch && is_below(e, k))
            block = (F.transpose() * normal.I[at(t, e)]).lazyProduct(S);
          else if (is_below(k, e))
            block = FI[i].lazyProduct(S);
          if (!root_rests_)
            block -= (FI[i] * normal.inverse_total[t] * normal.I[at(t, e)]).lazyProduct(S);
          column += S.cols();
        }
      }
      if (!root_rests_)
        for (int i = 0; i < num_items; ++i)
          for (int j = 0; j < num_items; ++j)
            Eigen::Map<Matrix6d>(FF[i * num_items + j].col(t).data()) -=
                FI[i] * normal.inverse_total[t] * FI[j].transpose();
    }

    std::vector<MissingJoint> best(m);
    std::vector<Eigen::MatrixXd> B(num_items);
    Eigen::MatrixXd all_B(6 * num_items, p);
    for (int i = 0; i < num_items; ++i) FJ[i] = (FJ[i] * q).eval();
    for (int s = 0; s < m; ++s) {
      Eigen::VectorXd u(6 * num_items);
      for (int i = 0; i < num_items; ++i) {
        all_B.middleRows<6>(6 * i) = Eigen::Map<const Eigen::MatrixXd>(FJ[i].col(s).data(), 6, p);
        u.segment<6>(6 * i) = Fr[i] * q.col(s);
      }
      u -= all_B * newton_related;
      Eigen::MatrixXd C = -all_B * inverse_related * all_B.transpose();
      Eigen::MatrixXd own = Eigen::MatrixXd::Zero(6, 6 * num_items);
      for (int i = 0; i < num_items; ++i)
        for (int j = 0; j < num_items; ++j) {
          if (i != j && root_rests_) continue;
          const Eigen::Matrix<double, 36, 1> sum = FF[i * num_items + j] * q2.col(s);
          C.block<6, 6>(6 * i, 6 * j) += Eigen::Map<const Matrix6d>(sum.data());
          if (i == j) own.middleCols<6>(6 * i) = Eigen::Map<const Matrix6d>(sum.data());
        }

      const auto test = [&](const std::vector<bool>& moves) {
        Matrix6d C_S = Matrix6d::Zero(), all = Matrix6d::Zero();
        Matrix6d bias_S = Matrix6d::Zero();
        Vector6d u_S = Vector6d::Zero();
        for (int i = 0; i < num_items; ++i) {
          if (!moves[i]) continue;
          u_S += u.segment<6>(6 * i);
          all += own.middleCols<6>(6 * i);
          bias_S += bias_covariance[i];
          for (int j = 0; j < num_items; ++j)
            if (moves[j]) C_S += C.block<6, 6>(6 * i, 6 * j);
        }
        MissingJoint joint;
        joint.top = top;
        joint.signal = moving[s];
        joint.log_tail = 0;
        bias_S /= static_cast<double>(std::count(moves.begin(), moves.end(), true));
        const Vector6d d = all.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
        const Vector6d unit_u = d.cwiseProduct(u_S);
        const Matrix6d unit_C = d.asDiagonal() * C_S * d.asDiagonal();
        const Matrix6d unit_bias =
            d.cwiseInverse().asDiagonal() * bias_S * d.cwiseInverse().asDiagonal();
        const auto offer = [&](int dof) {
          const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(
              Eigen::MatrixXd(unit_C.topLeftCorner(dof, dof)));
          const UpTo6x6 V = eigen.eigenvectors();
          // ξ along the eigenvectors, and its covariance: of the noise and of the bias. Directions
          // that the tree's other parameters take over are no evidence.
          UpTo6 xi = V.transpose() * unit_u.head(dof);
          UpTo6x6 covariance = V.transpose() * unit_bias.topLeftCorner(dof, dof) * V;
          for (int i = 0; i < dof; ++i) {
            if (eigen.eigenvalues()(i) < 1e-4) {
              xi(i) = 0;
              covariance.row(i).setZero();
              covariance.col(i).setZero();
              covariance(i, i) = 1;
            } else {
              xi(i) /= eigen.eigenvalues()(i);
              covariance(i, i) += noise_scale / eigen.eigenvalues()(i);
            }
          }
          const double sum = xi.dot(covariance.ldlt().solve(xi));
          const double log_tail = log_chi_square_tail(sum, dof);
          if (log_tail >= joint.log_tail) return;
          joint.log_tail = log_tail;
          joint.statistic = sum;
          joint.slides = dof == 3;
          joint.xi.setZero();
          joint.xi.head(dof) = -d.head(dof).cwiseProduct(V * xi);
        };
        offer(3);
        offer(6);
        return joint;
      };
      for (int first = 0; first < num_items; ++first) {
        std::vector<bool> moves(num_items, false);
        moves[first] = true;
        MissingJoint joint = test(moves);
        for (bool changed = true; changed;) {
          changed = false;
          for (int i = 0; i < num_items; ++i) {
            if (i == first) continue;
            moves[i] = !moves[i];
            MissingJoint other = test(moves);
            if (other.log_tail < joint.log_tail - 1e-9) {
              joint = other;
              changed = true;
            } else {
              moves[i] = !moves[i];
            }
          }
        }
        // A resting root does not move.
        if (top == 0 && !std::count(moves.begin(), moves.end(), false)) continue;
        if (first > 0 && joint.log_tail >= best[s].log_tail) continue;
        for (int i = 0; i < num_items; ++i)
          if (moves[i])
            (items[i].is_branch ? joint.branches : joint.members).push_back(items[i].node);
        joint.log_ways = num_items * std::log(2.0);
        best[s] = joint;
      }
      if (best[s].log_tail < 0) result.push_back(best[s]);
    }
  }
  std::stable_sort(result.begin(), result.end(),
                   [](const auto& x, const auto& y) { return x.log_tail < y.log_tail; });
  return result;
}

Eigen::MatrixXd TreeFit::joint_information() const {
  const int n = static_cast<int>(nodes_.size());
  const int T = num_frames();
  const auto& moving = actions_.moving();
  const auto m = static_cast<Eigen::Index>(moving.size());
  Eigen::MatrixXd result = Eigen::MatrixXd::Zero(n, m);
  const Normal normal = normal_equations();
  const auto size = normal.H.rows();
  const std::optional<Eigen::MatrixXd> inverse = normal.inverse();
  if (!inverse) return result;
  Eigen::MatrixXd q(T, m);
  for (int t = 0; t < T; ++t)
    for (Eigen::Index s = 0; s < m; ++s) q(t, s) = actions_(samples_[t], moving[s]);
  const Eigen::MatrixXd q2 = q.cwiseProduct(q);
  for (int k = 1; k < n; ++k) {
    // Stacked over the frames, for q = 1: what the three axes share with each other and with the
    // tree's parameters.
    Eigen::MatrixXd own(9, T);
    Eigen::MatrixXd shared = Eigen::MatrixXd::Zero(3 * size, T);
    for (int t = 0; t < T; ++t) {
      const Eigen::Matrix<double, 6, 3> axes = adjoint(poses_[at(t, k)]).rightCols<3>();
      const Eigen::Matrix<double, 3, 6> AI = axes.transpose() * normal.I[at(t, k)];
      const Eigen::Matrix<double, 3, 6> AIT =
          root_rests_ ? Eigen::Matrix<double, 3, 6>::Zero() : (AI * normal.inverse_total[t]).eval();
      Eigen::Map<Eigen::Matrix3d>(own.col(t).data()) = AI * axes - AIT * AI.transpose();
      Eigen::Map<Eigen::MatrixXd> row(shared.col(t).data(), 3, size);
      for (int e = root_rests_ ? 0 : 1; e < n; ++e) {
        const ParameterJacobian& S = normal.S[at(t, e)];
        auto block = row.middleCols(normal.offset[e], S.cols());
        if (is_below(e, k))
          block = (axes.transpose() * normal.I[at(t, e)]).lazyProduct(S);
        else if (is_below(k, e))
          block = AI.lazyProduct(S);
        if (!root_rests_) block -= (AIT * normal.I[at(t, e)]).lazyProduct(S);
      }
    }
    const Eigen::MatrixXd owns = own * q2, shares = shared * q;
    for (Eigen::Index s = 0; s < m; ++s) {
      const Eigen::Map<const Eigen::MatrixXd> B(shares.col(s).data(), 3, size);
      const Eigen::Matrix3d C =
          Eigen::Map<const Eigen::Matrix3d>(owns.col(s).data()) - B * *inverse * B.transpose();
      const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(C, Eigen::EigenvaluesOnly);
      result(k, s) = std::max(eigen.eigenvalues()(0), 0.0) / normal.noise_scale();
    }
  }
  return result;
}

std::optional<std::vector<TreeEdge>> TreeFit::with_joint(const MissingJoint& joint) const {
  const int n = static_cast<int>(nodes_.size());
  const std::vector<int> cluster = cluster_of(joint.top);
  std::vector<Pose> X_TN(n, Pose::Identity());  // of the cluster's nodes in its top's frame
  std::vector<int> side(n, -1);                 // 1 moves, 0 rests
  for (const int k : cluster) {
    if (k != joint.top) X_TN[k] = X_TN[nodes_[k].parent] * nodes_[k].model.A[0];
    side[k] = static_cast<int>(std::count(joint.members.begin(), joint.members.end(), k));
  }
  const auto rigid = [](const Pose& X) {
    LocalModel model;
    model.A[0] = X;
    return model;
  };
  // Δ_a,top Exp(ξ q) Δ_top,b around whatever follows.
  const Screw screw = screw_of(joint.xi, joint.slides);
  const auto in_front = [&](const Pose& X_NT, double sense, const LocalModel& model) {
    LocalModel r;
    r.num_joints = model.num_joints + 1;
    r.signal[0] = joint.signal;
    r.slide[0] = sense * screw.slide;
    r.turn[0] = sense * screw.turn;
    r.A[0] = X_NT * screw.X;
    r.A[1] = screw.X.inverse() * X_NT.inverse() * model.A[0];
    for (int d = 0; d < model.num_joints; ++d) {
      r.signal[d + 1] = model.signal[d];
      r.slide[d + 1] = model.slide[d];
      r.turn[d + 1] = model.turn[d];
      r.A[d + 2] = model.A[d + 1];
    }
    return r;
  };
  // The cluster's two sides, each rigid, and a joint between them.
  int base[2] = {-1, -1};
  std::vector<TreeEdge> edges;
  for (const int k : cluster) {
    int& b = base[side[k]];
    if (b < 0)
      b = k;
    else if (k != joint.top && side[nodes_[k].parent] == side[k])
      edges.push_back({nodes_[k].parent, k, nodes_[k].model});
    else
      edges.push_back({b, k, rigid(X_TN[b].inverse() * X_TN[k])});
  }
  if (base[0] >= 0 && base[1] >= 0)
    edges.push_back(
        {base[0], base[1],
         in_front(X_TN[base[0]].inverse(), 1, rigid(X_TN[base[0]].inverse() * X_TN[base[1]]))});
  // A branch goes to its own side; where that has no part, its edge gets the joint.
  const auto attach = [&](int node, LocalModel model, int parent, bool moves) {
    const int own = base[moves];
    if (own >= 0) {
      const int to = side[parent] == static_cast<int>(moves) ? parent : own;
      model.A[0] = X_TN[to].inverse() * X_TN[parent] * model.A[0];
      edges.push_back({to, node, model});
      return true;
    }
    if (model.num_joints == kMaxJoints) return false;
    edges.push_back({parent, node, in_front(X_TN[parent].inverse(), moves ? 1 : -1, model)});
    return true;
  };
  for (int k = 1; k < n; ++k) {
    if (k == joint.top) {
      // What the cluster hangs on rests.
      if (!attach(nodes_[k].parent, nodes_[k].model.inverse(), k, false)) return std::nullopt;
    } else if (side[k] < 0 && side[nodes_[k].parent] >= 0) {
      const bool moves = std::count(joint.branches.begin(), joint.branches.end(), k) > 0;
      if (!attach(k, nodes_[k].model, nodes_[k].parent, moves)) return std::nullopt;
    } else if (side[k] < 0) {
      edges.push_back({nodes_[k].parent, k, nodes_[k].model});
    }
  }
  return edges;
}

}  // namespace bodyschema
