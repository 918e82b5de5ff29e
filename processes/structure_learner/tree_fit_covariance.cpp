#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "common/geometry/angle.h"
#include "processes/structure_learner/serial_correlation.h"
#include "processes/structure_learner/tree_fit.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
namespace {

/// Without the negative eigenvalues of its correlation matrix.
Matrix6d positive_part(const Matrix6d& matrix) {
  const Vector6d unit = matrix.diagonal().cwiseMax(0).cwiseSqrt();
  const Vector6d inverse = unit.unaryExpr([](double x) { return x > 0 ? 1 / x : 0.0; });
  const Matrix6d symmetric = 0.5 * (matrix + matrix.transpose());
  const Matrix6d correlation = inverse.asDiagonal() * symmetric * inverse.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(correlation);
  const Matrix6d V = unit.asDiagonal() * eigen.eigenvectors();
  return V * eigen.eigenvalues().cwiseMax(0).asDiagonal() * V.transpose();
}

/// Symmetric, without the negative eigenvalues.
Matrix6d square_root(const Matrix6d& matrix) {
  const Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(matrix);
  return eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0).cwiseSqrt().asDiagonal() *
         eigen.eigenvectors().transpose();
}

/// Where a part was, to within which its views are alike: pixels of a tag change with less, what a
/// lens adds changes slowly. Chosen; a part that rests has one view, one that moves many.
constexpr double kSamePosition_m = 5e-3, kSameRotation_rad = 2 * kDegree;

bool is_alike(const Pose& x, const Pose& y) {
  return (x.translation() - y.translation()).squaredNorm() < kSamePosition_m * kSamePosition_m &&
         log(x.inverse() * y).tail<3>().norm() < kSameRotation_rad;
}

}  // namespace

// By node's frame: the first frame with the same tags where the fit has the part in the same place.
std::vector<int> TreeFit::views_of(int node) const {
  const std::vector<PairFrame>& frames = data_[node].frames;
  std::vector<int> result(frames.size());
  std::map<int, std::vector<std::pair<int, const Pose*>>> firsts;  // by tags
  for (int t = 0; t < num_frames(); ++t) {
    const int frame = frame_index_[at(t, node)];
    if (frame < 0) continue;
    const Pose& X = poses_[at(t, node)];
    auto& of_tags = firsts[frames[frame].tag_set];
    const auto known = std::find_if(of_tags.begin(), of_tags.end(),
                                    [&](const auto& first) { return is_alike(*first.second, X); });
    if (known != of_tags.end()) {
      result[frame] = known->first;
    } else {
      result[frame] = frame;
      of_tags.emplace_back(frame, &X);
    }
  }
  return result;
}

// H with a prior on the gauge: a screw frame may turn about its axis and slide along it, that of a
// joint that slides anywhere, directions on which no prediction depends. They get the variance of a
// direction that is known well.
Eigen::MatrixXd TreeFit::with_fixed_gauge(const Normal& normal) const {
  Eigen::MatrixXd H = normal.H;
  for (int k = 1; k < static_cast<int>(nodes_.size()); ++k)
    for (int d = 0; d < nodes_[k].model.num_joints(); ++d)
      for (const int component : {0, 1, 2, 5}) {
        if (component < 2 && !nodes_[k].model.joints[d].slides) continue;
        Vector6d before = Vector6d::Zero();
        before(component) = 1;
        const Vector6d after = -adjoint(nodes_[k].model.joints[d].X_after.inverse()) * before;
        Eigen::Matrix<double, 14, 1> gauge;  // of the two transforms beside the joint
        gauge << before, 0, 0, after;
        if (d + 1 == nodes_[k].model.num_joints() && nodes_[k].model.is_position)
          gauge.tail<3>().setZero();
        const auto at = normal.offset[k] + ScrewChainLayout::transform(d);
        const auto diagonal = normal.H.diagonal().segment<14>(at);
        const double information =
            gauge.dot(diagonal.cwiseProduct(gauge)) / std::pow(gauge.squaredNorm(), 2);
        H.block<14, 14>(at, at) += information * gauge * gauge.transpose();
      }
  // A parameter that the data hardly determine (where the axis of a sliding joint lies) stays
  // finite in float.
  H.diagonal() *= 1 + 1e-7;
  return H;
}

// Jᵀ W r of each frame, in columns.
Eigen::MatrixXd TreeFit::scores(const Normal& normal) const {
  Eigen::MatrixXd result = Eigen::MatrixXd::Zero(normal.H.rows(), num_frames());
  for (int t = 0; t < num_frames(); ++t)
    for (int k = 0; k < static_cast<int>(nodes_.size()); ++k) {
      const ParameterJacobian& S = normal.S[at(t, k)];
      result.col(t).segment(normal.offset[k], S.cols()) = S.transpose() * normal.gradient[at(t, k)];
    }
  return result;
}

// Covariance of Σ Jᵀ W e over all markers.
Eigen::MatrixXd TreeFit::score_covariance(const Normal& normal, const MeasurementModel& measurement,
                                          double view_share, double correlation_time) const {
  const auto size = normal.H.rows();
  Eigen::MatrixXd score = Eigen::MatrixXd::Zero(size, size);
  const double lasting = serial_correlation();
  // The share that averages out, by the marker.
  std::vector<Matrix6d> own(frame_index_.size(), Matrix6d::Zero());
  for (int k = 0; k < static_cast<int>(nodes_.size()); ++k) {
    const std::vector<int> views = views_of(k);
    std::map<int, int> sizes;
    for (const int view : views) ++sizes[view];
    // What is common to a view and to all sights of a tag, parameters × effects.
    std::map<int, Eigen::MatrixXd> of_view, of_tag;
    std::vector<std::pair<int, Matrix6d>> lasting_effects;  // by frame
    for (int t = 0; t < num_frames(); ++t) {
      const int frame = frame_index_[at(t, k)];
      if (frame < 0) continue;
      const FrameFit& fit = fits_[at(t, k)];
      const Matrix6d whitening = -data_[k].hypotheses[fit.hypothesis].residual_jacobian(
          Vector6d::Zero(), poses_[at(t, k)]);
      // The whitened error of the marker as a twist in the camera's frame, weighed.
      const Matrix6d twist =
          fit.weight() * adjoint(poses_[at(t, k)].inverse()).transpose() * whitening.transpose();
      const auto add = [&](const Eigen::MatrixXd& effect, Eigen::MatrixXd* sum) {
        if (sum->size() == 0) *sum = Eigen::MatrixXd::Zero(size, effect.cols());
        for (int e = k; e >= 0; e = nodes_[e].parent) {
          const ParameterJacobian& S = normal.S[at(t, e)];
          sum->middleRows(normal.offset[e], S.cols()) += S.transpose().lazyProduct(effect);
        }
      };
      const std::vector<int>& tags = data_[k].tag_sets.at(data_[k].frames[frame].tag_set);
      const Eigen::Matrix<double, 6, 7> tag =
          whitening * measurement.effect_of_tag(poses_[at(t, k)], tags.size());
      for (const int id : tags) add(twist * tag, &of_tag[id]);
      const Matrix6d systematic =
          whitening * measurement.systematic_covariance() * whitening.transpose();
      const Matrix6d noise =
          positive_part(Matrix6d::Identity() - systematic -
                        static_cast<double>(tags.size()) * tag * tag.transpose());
      const bool is_alone = sizes.at(views[frame]) == 1;
      const double share = is_alone ? 0 : view_share;
      own[at(t, k)] = twist *
                      ((1 - share) * correlation_time * noise + (is_alone ? 1 : 0) * systematic) *
                      twist.transpose();
      if (lasting > 0)
        lasting_effects.emplace_back(t, twist * std::sqrt(1 - share) * square_root(noise));
      if (!is_alone)
        add(twist * Eigen::LLT<Matrix6d>(systematic + share * noise).matrixL().toDenseMatrix(),
            &of_view[views[frame]]);
    }
    for (const auto* common : {&of_view, &of_tag})
      for (const auto& [id, G] : *common) score += G * G.transpose();
    add_lasting(normal, k, lasting_effects, lasting, &score);
  }
  add_composites(normal, std::move(own), &score);
  return score;
}

// Of a marker's errors of which `coefficient` lasts from one sample to the next, what two of them
// have in common: Σ ρ^(t − u) (G_u G_tᵀ + G_t G_uᵀ) over u < t, with G_t = Sᵀ · effect of frame t.
void TreeFit::add_lasting(const Normal& normal, int node,
                          const std::vector<std::pair<int, Matrix6d>>& effects, double coefficient,
                          Eigen::MatrixXd* sum) const {
  if (effects.size() < 2) return;
  std::vector<int> edges;  // that lead to the marker
  std::vector<Eigen::Index> first{0};
  for (int e = node; e >= 0; e = nodes_[e].parent) {
    edges.push_back(e);
    first.push_back(first.back() + normal.S[at(0, e)].cols());
  }
  const Eigen::Index size = first.back();
  Eigen::MatrixXd cross = Eigen::MatrixXd::Zero(size, size), now(size, 6),
                  past = Eigen::MatrixXd::Zero(size, 6);  // Σ ρ^(t − u) G_u
  int before = samples_[effects.front().first];
  for (const auto& [t, effect] : effects) {
    for (std::size_t n = 0; n < edges.size(); ++n)
      now.middleRows(first[n], first[n + 1] - first[n]) =
          normal.S[at(t, edges[n])].transpose().lazyProduct(effect);
    past *= std::pow(coefficient, samples_[t] - before);
    cross.noalias() += past * now.transpose();
    past += now;
    before = samples_[t];
  }
  cross += Eigen::MatrixXd(cross.transpose());
  for (std::size_t n = 0; n < edges.size(); ++n)
    for (std::size_t m = 0; m < edges.size(); ++m) {
      const Eigen::Index rows = first[n + 1] - first[n], cols = first[m + 1] - first[m];
      sum->block(normal.offset[edges[n]], normal.offset[edges[m]], rows, cols) +=
          cross.block(first[n], first[m], rows, cols);
    }
}

// What a joint is off by in a frame is in all markers beyond it.
void TreeFit::add_scatter(const Normal& normal, const Eigen::VectorXd& scatter,
                          Eigen::MatrixXd* sum) const {
  if (scatter.isZero(0)) return;
  const int n = static_cast<int>(nodes_.size());
  for (int t = 0; t < num_frames(); ++t) {
    const std::vector<MotionJacobian> twists = joint_twists(t);
    Eigen::Index d = 0;
    for (int k = 1; k < n; ++k)
      for (Eigen::Index of_edge = 0; of_edge < twists[k].cols(); ++of_edge, ++d) {
        if (scatter(d) == 0) continue;
        const Vector6d off = scatter(d) * twists[k].col(of_edge);
        Eigen::VectorXd score = Eigen::VectorXd::Zero(sum->rows());
        for (int e = 0; e < n; ++e) {
          if (!is_below(e, k) && !is_below(k, e)) continue;
          const ParameterJacobian& S = normal.S[at(t, e)];
          const Vector6d moved = normal.I[at(t, std::max(e, k))] * off;
          score.segment(normal.offset[e], S.cols()) = S.transpose() * moved;
        }
        *sum += score * score.transpose();
      }
  }
}

// An error of a part's frame is in the edge to it and, with opposite sign, in those from it, the
// same in every frame: of the mean errors.
std::vector<Matrix6d> TreeFit::frame_covariances(const Normal& normal,
                                                 const Eigen::MatrixXd& joint) const {
  const int n = static_cast<int>(nodes_.size());
  std::vector<Matrix6d> result(n, Matrix6d::Zero());
  std::vector<int> children(n, 0);
  for (int k = 1; k < n; ++k) {
    const int parent = nodes_[k].parent;
    const auto p = normal.S[at(0, parent)].cols(), c = normal.S[at(0, k)].cols();
    const Eigen::MatrixXd cross = joint.block(normal.offset[parent], normal.offset[k], p, c);
    Eigen::MatrixXd by_parent = Eigen::MatrixXd::Zero(6, p), by_child = Eigen::MatrixXd::Zero(6, c);
    for (int t = 0; t < num_frames(); ++t) {
      const Matrix6d to_parent = adjoint(poses_[at(t, parent)].inverse());
      by_parent += to_parent * normal.S[at(t, parent)];
      by_child += to_parent * normal.S[at(t, k)];
    }
    result[parent] -= by_parent * cross * by_child.transpose() / std::pow(num_frames(), 2);
    ++children[parent];
  }
  for (int k = 0; k < n; ++k)
    if (children[k] > 0) result[k] = positive_part(result[k] / children[k]);
  return result;
}

std::optional<TreeFit::Covariance> TreeFit::covariance(const MeasurementModel& measurement,
                                                       double view_share,
                                                       const Eigen::VectorXd& scatter) const {
  if (!root_rests_) return std::nullopt;
  const Normal normal = normal_equations();
  const Eigen::MatrixXd H = with_fixed_gauge(normal);
  const Eigen::VectorXd unit = Normal::unit_of(H);
  Eigen::MatrixXd scaled = unit.asDiagonal() * H * unit.asDiagonal();
  for (Eigen::Index n = 0; n < unit.size(); ++n)
    if (unit(n) == 0) scaled(n, n) = 1;
  const Eigen::LLT<Eigen::MatrixXd> llt(scaled);
  if (llt.info() != Eigen::Success) return std::nullopt;
  const Eigen::MatrixXd inverse = unit.asDiagonal() * llt.solve(Eigen::MatrixXd(unit.asDiagonal()));
  // The prior added to H is a measurement like others.
  const bool is_stream = actions_.blocks().is_stream();
  Eigen::MatrixXd score =
      H - normal.H +
      score_covariance(normal, measurement, view_share,
                       is_stream ? correlation_time(scores(normal), inverse) : 1);
  add_scatter(normal, scatter, &score);
  const Eigen::MatrixXd joint = inverse * score * inverse;
  Covariance result;
  result.models.resize(nodes_.size());
  result.root = joint.topLeftCorner<6, 6>();
  for (std::size_t k = 1; k < nodes_.size(); ++k) {
    const int p = nodes_[k].model.num_parameters();
    result.models[k] = joint.block(normal.offset[k], normal.offset[k], p, p);
  }
  result.frames = frame_covariances(normal, joint);
  return result;
}

// Σ_t S_eᵀ (Σ own of e' and beyond) S_e' of nodes e' and their ancestors e, for a root that rests.
void TreeFit::add_composites(const Normal& normal, std::vector<Matrix6d> own,
                             Eigen::MatrixXd* sum) const {
  const int n = static_cast<int>(nodes_.size());
  Eigen::MatrixXd lower = Eigen::MatrixXd::Zero(sum->rows(), sum->cols());
  for (int t = 0; t < num_frames(); ++t) {
    for (int k = n; k-- > 0;) {
      if (k > 0) own[at(t, nodes_[k].parent)] += own[at(t, k)];
      const ParameterJacobian IS = own[at(t, k)].lazyProduct(normal.S[at(t, k)]);
      for (int e = k; e >= 0; e = nodes_[e].parent) {
        const ParameterJacobian& S = normal.S[at(t, e)];
        lower.block(normal.offset[k], normal.offset[e], IS.cols(), S.cols()) +=
            IS.transpose().lazyProduct(S);
      }
    }
  }
  *sum += Eigen::MatrixXd(lower.selfadjointView<Eigen::Lower>());
}

}  // namespace bodyschema
