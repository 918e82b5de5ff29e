#include "processes/model_monitor/likelihood/tree_filter.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include "common/estimation/chi_square.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

constexpr double kRoom_m3 = 8;
/// Tilt of a marker that was read in its other way, standard deviation about x and y.
constexpr double kTilt_rad = 35 * kDegree;
/// Below this squared distance an outlier density cannot matter.
constexpr double kClearInlier = 10;
/// Reading a marker by its second pose is one in ten.
constexpr double kLogOtherReading = -2.3;
/// Markers from which the belief behind a cut edge is begun anew.
constexpr std::size_t kMaxStarters = 3;
/// A beginning farther away is taken if it is likelier by this much: what lies on its way is
/// counted twice [nats].
constexpr double kMuchLikelier = 3;

double log_sum_exp(const std::vector<double>& terms) {
  const double largest = *std::ranges::max_element(terms);
  if (!std::isfinite(largest)) return largest;
  double sum = 0;
  for (const double term : terms) sum += std::exp(term - largest);
  return largest + std::log(sum);
}

/// The pose that a planar marker at X shows in its second reading: its normal mirrored at the line
/// of sight.
Pose flipped(const Pose& X) {
  const Eigen::Vector3d sight = X.translation().normalized();
  const Eigen::Vector3d normal = X.linear().col(2);
  const Eigen::Vector3d axis = normal.cross(sight);
  const double sine = axis.norm(), cosine = normal.dot(sight);
  Pose result = X;
  if (sine > 1e-9)
    result.linear() = exp_so3(2 * std::atan2(sine, cosine) / sine * axis) * X.linear();
  return result;
}

}  // namespace

Matrix6d model_covariance(const Edge& edge, const Eigen::VectorXd& theta) {
  Matrix6d covariance = edge.prediction_covariance(theta) + edge.scatter_covariance(theta);
  if (edge.residual_gp) covariance += edge.empirical_covariance();
  return covariance;
}

namespace {

/// log N(x; 0, S), and xᵀ S⁻¹ x; `llt` of S.
template <int size>
std::pair<double, double> log_normal(const Eigen::Vector<double, size>& x,
                                     const Eigen::LLT<Eigen::Matrix<double, size, size>>& llt) {
  const double d2 = llt.matrixL().solve(x).squaredNorm();
  const double log_det = 2 * llt.matrixLLT().diagonal().array().log().sum();
  return {-0.5 * (d2 + log_det + size * std::log(2 * M_PI)), d2};
}

}  // namespace

double log_flat_density() { return -std::log(8 * M_PI * M_PI * kRoom_m3); }

double log_normal_density(const Vector6d& xi, const Matrix6d& S) {
  const Eigen::LLT<Matrix6d> llt(S);
  return llt.info() == Eigen::Success ? log_normal(xi, llt).first
                                      : -std::numeric_limits<double>::infinity();
}

namespace {

/// log g of a marker's pose `X_CB` under a belief `X` with S = P + Σ_y; `marker_covariance`: Σ_y.
double log_outlier_density(const Pose& X, const Pose& X_CB, const Matrix6d& S,
                           const Matrix6d& marker_covariance) {
  const Vector6d xi = log(X.inverse() * X_CB);
  const Matrix6d variances = marker_covariance.diagonal().asDiagonal();
  Matrix6d flip = S.diagonal().asDiagonal();
  flip.diagonal().head<3>().array() += 0.01 * 0.01;
  flip.diagonal().tail<3>().array() += std::pow(2 * kDegree, 2);
  Matrix6d tilt = S;
  tilt.diagonal().segment<2>(3).array() += kTilt_rad * kTilt_rad;
  // Anywhere near by, any orientation.
  const Eigen::Matrix3d near =
      S.topLeftCorner<3, 3>() + 100 * Eigen::Matrix3d(variances.topLeftCorner<3, 3>());
  const Eigen::LLT<Eigen::Matrix3d> llt(near);
  const double log_near =
      log_normal(Eigen::Vector3d(xi.head<3>()), llt).first - std::log(8 * M_PI * M_PI);
  const double quarter = std::log(0.25), eighth = std::log(0.125);
  // A flip is mirrored exactly, or nearly so.
  const Vector6d from_flip = log(flipped(X).inverse() * X_CB);
  return log_sum_exp(
      {eighth + log_normal_density(from_flip, S), eighth + log_normal_density(from_flip, flip),
       quarter + log_normal_density(xi, tilt), eighth + log_normal_density(xi, S + 9 * variances),
       eighth + log_normal_density(xi, S + 100 * variances), eighth + log_near,
       eighth + log_flat_density()});
}

/// log [(1 − ρ) N(ξ; 0, S) + ρ g(ξ)] of the same; half of g is where the marker was `misread`
/// before, in its part's frame. Sets whether the marker is to be believed.
double log_marker_density(const Pose& X, const Pose& X_CB, const Matrix6d& S,
                          const Matrix6d& marker_covariance, double outlier_rate,
                          const std::vector<Pose>& misread, bool* is_inlier,
                          double* squared_distance) {
  const Vector6d xi = log(X.inverse() * X_CB);
  const auto [log_density, d2] = log_normal(xi, Eigen::LLT<Matrix6d>(S));
  const double inlier = std::log1p(-outlier_rate) + log_density;
  *squared_distance = d2;
  *is_inlier = true;
  if (d2 < kClearInlier) return inlier;
  std::vector<double> outliers{log_outlier_density(X, X_CB, S, marker_covariance)};
  for (const Pose& place : misread)
    outliers.push_back(
        log_normal_density(log((X * place).inverse() * X_CB), S + marker_covariance) -
        std::log(static_cast<double>(misread.size())));
  const double half = misread.empty() ? 0 : std::log(0.5);
  const double outlier = std::log(outlier_rate) + half + log_sum_exp(outliers);
  *is_inlier = inlier >= outlier;
  return log_sum_exp({inlier, outlier});
}

}  // namespace

TreeFilter::TreeFilter(const BodySchema& schema, const MeasurementModel& measurement)
    : schema_(schema), measurement_(measurement) {
  if (schema_.root < 0) return;
  const auto misread = [&](int part) {
    const auto found = measurement_.misread.find(part);
    return found == measurement_.misread.end() ? std::vector<Pose>{} : found->second;
  };
  nodes_.push_back({schema_.root, -1, -1, false, misread(schema_.root), {}});
  std::set<int> reached{schema_.root};
  for (std::size_t n = 0; n < nodes_.size(); ++n) {
    for (std::size_t e = 0; e < schema_.edges.size(); ++e) {
      const Edge& edge = schema_.edges[e];
      if (edge.from != nodes_[n].part || !reached.insert(edge.to).second) continue;
      nodes_[n].children.push_back(static_cast<int>(nodes_.size()));
      nodes_.push_back({edge.to,
                        static_cast<int>(n),
                        static_cast<int>(e),
                        edge.state == EdgeState::kInvalid,
                        misread(edge.to),
                        {}});
    }
  }
}

int TreeFilter::node_of(int part) const {
  for (std::size_t n = 0; n < nodes_.size(); ++n)
    if (nodes_[n].part == part) return static_cast<int>(n);
  return -1;
}

TreeFilter::Instant TreeFilter::prepare(const ActionPoseSample& sample) const {
  const Eigen::VectorXd theta = schema_.displacements(sample.action);
  const std::size_t n = nodes_.size();
  Instant instant;
  instant.delta.resize(n);
  instant.transport.resize(n);
  instant.edge_covariance.resize(n);
  instant.seen.resize(n);
  std::vector<Pose> X_C(n);  // of the nodes, predicted
  for (std::size_t k = 0; k < n; ++k) {
    const Node& node = nodes_[k];
    if (node.edge < 0) {
      instant.delta[k] = schema_.X_CR;
      instant.edge_covariance[k] = schema_.X_CR_covariance;
    } else {
      const Edge& edge = schema_.edges[static_cast<std::size_t>(node.edge)];
      instant.delta[k] = edge.predict(theta);
      instant.edge_covariance[k] = model_covariance(edge, theta);
    }
    instant.edge_covariance[k].diagonal().array() += 1e-12;  // what is exact can still be inverted
    instant.transport[k] = adjoint(instant.delta[k].inverse());
    X_C[k] = node.parent < 0 ? instant.delta[k]
                             : X_C[static_cast<std::size_t>(node.parent)] * instant.delta[k];
    if (const PartObservation* o = sample.find(node.part)) {
      const auto [X_CB, covariance, num_residuals] = measurement_.reading(*o, X_C[k]);
      instant.seen[k] = Instant::Seen{X_CB, covariance, num_residuals, o->X_CB_other, covariance};
      if (o->X_CB_other) instant.seen[k]->covariance_other = covariance_of_other(*o, covariance);
    }
  }
  return instant;
}

/// One pass over the tree.
class TreeFilter::Walk {
 public:
  Walk(const TreeFilter& filter, const Instant& instant, const Alternative& alternative)
      : filter_(filter), instant_(instant), alternative_(alternative) {
    judgement.squared_distance.assign(filter.nodes_.size(), -1);
    judgement.believed.assign(filter.nodes_.size(), -1);
  }

  Judgement judgement;

  bool is_cut(int node) const {
    return filter_.nodes_[node].is_cut ||
           std::ranges::find(alternative_.cut_edges, node) != alternative_.cut_edges.end();
  }

  /// Everything from the camera on.
  void all() {
    if (is_cut(0)) {
      behind_cut(0);
      return;
    }
    Belief belief = descend({}, 0);
    subtree(0, &belief);
  }

  /// The marker of `node`, then all children but `except`.
  void subtree(int node, Belief* belief, int except = -1) {
    if (node != skipped_) marker(node, belief);
    for (const int child : filter_.nodes_[node].children)
      if (child != except) branch(child, belief);
  }

  /// A child's subtree; what it learns goes back to its parent.
  void branch(int child, Belief* parent) {
    if (is_cut(child)) {
      behind_cut(child);
      return;
    }
    const Belief before = descend(*parent, child);
    Belief after = before;
    subtree(child, &after);
    const Matrix6d& F = instant_.transport[child];
    const Matrix6d G = (before.P.ldlt().solve(F * parent->P)).transpose();
    parent->X = parent->X * exp(G * log(before.X.inverse() * after.X));
    parent->P += G * (after.P - before.P) * G.transpose();
    parent->P = (0.5 * (parent->P + parent->P.transpose())).eval();
  }

  Belief descend(const Belief& parent, int child) const {
    const Matrix6d& F = instant_.transport[child];
    Belief belief{parent.X * instant_.delta[child],
                  F * parent.P * F.transpose() + instant_.edge_covariance[child]};
    if (child == alternative_.inflated_edge) {
      // In units of a marker's noise, wherever there is one.
      for (const auto& seen : instant_.seen) {
        if (!seen) continue;
        const Vector6d variances = seen->covariance.diagonal();
        belief.P.diagonal() += std::pow(alternative_.inflation, 2) * variances;
        break;
      }
    }
    return belief;
  }

  /// Visible nodes of a subtree that can be reached without crossing a cut, nearest first.
  std::vector<int> visible_below(int top) const {
    std::vector<int> queue{top}, visible;
    for (std::size_t n = 0; n < queue.size(); ++n) {
      if (instant_.seen[queue[n]] && queue[n] != skipped_ && queue[n] != alternative_.detached_node)
        visible.push_back(queue[n]);
      for (const int child : filter_.nodes_[queue[n]].children)
        if (!is_cut(child)) queue.push_back(child);
    }
    return visible;
  }

  /// The belief on `top` from the marker of one node of its subtree.
  Belief begun_at(int node, int top) const {
    Belief belief{instant_.seen[node]->X_CB, instant_.seen[node]->covariance};
    for (; node != top; node = filter_.nodes_[node].parent) {
      const Matrix6d A = adjoint(instant_.delta[node]);
      belief.X = belief.X * instant_.delta[node].inverse();
      belief.P = (A * (belief.P + instant_.edge_covariance[node]) * A.transpose()).eval();
    }
    return belief;
  }

  /// A subtree whose edge says nothing: begun anew from one of its markers, each with equal odds.
  /// The belief of the nearest beginning that is likely; std::nullopt if nothing was seen there.
  std::optional<Belief> behind_cut(int top) {
    std::vector<int> starters = visible_below(top);
    if (starters.size() > kMaxStarters) starters.resize(kMaxStarters);
    if (starters.empty()) {
      // Further cuts below may hide markers of their own.
      for (const int child : filter_.nodes_[top].children) below_nothing(child);
      if (instant_.seen[top]) judgement.log_likelihood += log_flat_density();
      return std::nullopt;
    }
    std::vector<double> scores;
    std::optional<Walk> best;
    Belief best_belief;
    double best_score = 0;
    for (const int starter : starters) {
      Walk walk = *this;
      walk.judgement.log_likelihood = log_flat_density();
      walk.judgement.believed[starter] = 1;
      walk.judgement.squared_distance[starter] = 0;
      walk.skipped_ = starter;
      Belief belief = begun_at(starter, top);
      walk.subtree(top, &belief);
      walk.skipped_ = skipped_;
      scores.push_back(walk.judgement.log_likelihood);
      if (!best || scores.back() > best_score + kMuchLikelier) {
        best.emplace(walk);
        best_belief = belief;
        best_score = scores.back();
      }
    }
    const double so_far = judgement.log_likelihood;
    judgement = best->judgement;
    judgement.log_likelihood =
        so_far + log_sum_exp(scores) - std::log(static_cast<double>(scores.size()));
    return best_belief;
  }

 private:
  void below_nothing(int node) {
    if (is_cut(node)) {
      behind_cut(node);
      return;
    }
    for (const int child : filter_.nodes_[node].children) below_nothing(child);
  }

  void marker(int node, Belief* belief) {
    const auto& seen = instant_.seen[node];
    if (!seen) return;
    Matrix6d S = belief->P + seen->covariance;
    if (node == alternative_.detached_node) {
      double detached = log_outlier_density(belief->X, seen->X_CB, S, seen->covariance);
      if (seen->X_CB_other)
        detached = std::max(
            detached, kLogOtherReading + log_outlier_density(belief->X, *seen->X_CB_other,
                                                             belief->P + seen->covariance_other,
                                                             seen->covariance_other));
      judgement.log_likelihood += detached;
      return;
    }
    const double rate = filter_.measurement_.outlier_rate;
    const std::vector<Pose>& misread = filter_.nodes_[node].misread;
    Pose X_CB = seen->X_CB;
    bool is_inlier = true;
    double d2 = 0;
    double density =
        log_marker_density(belief->X, X_CB, S, seen->covariance, rate, misread, &is_inlier, &d2);
    // Where the marker does not sit at the part's origin only its other reading knows where a
    // flip's part is; and that may be an outlier in turn.
    if (seen->X_CB_other && d2 > kClearInlier) {
      const Matrix6d S_other = belief->P + seen->covariance_other;
      bool is_other_inlier = false;
      double other_d2 = 0;
      const double other =
          kLogOtherReading + log_marker_density(belief->X, *seen->X_CB_other, S_other,
                                                seen->covariance_other, rate, misread,
                                                &is_other_inlier, &other_d2);
      if (other > density) {
        density = other;
        S = S_other;
        X_CB = *seen->X_CB_other;
        is_inlier = is_other_inlier;
        d2 = other_d2;
      }
    }
    judgement.log_likelihood += density;
    judgement.squared_distance[node] = as_of_six(d2, seen->num_residuals);
    judgement.believed[node] = is_inlier;
    if (!is_inlier) return;
    const Matrix6d K = S.ldlt().solve(belief->P).transpose();
    belief->X = belief->X * exp(K * log(belief->X.inverse() * X_CB));
    belief->P -= K * belief->P;
    belief->P = (0.5 * (belief->P + belief->P.transpose())).eval();
  }

  const TreeFilter& filter_;
  const Instant& instant_;
  const Alternative& alternative_;
  int skipped_ = -1;  // its marker began the belief
};

TreeFilter::Judgement TreeFilter::judge(const Instant& instant,
                                        const Alternative& alternative) const {
  Walk walk(*this, instant, alternative);
  if (!nodes_.empty()) walk.all();
  walk.judgement.log_likelihood *= measurement_.worth;
  return walk.judgement;
}

std::optional<VirtualMeasurement> TreeFilter::measure_edge(const Instant& instant, int node) const {
  const Alternative as_it_is;
  Walk right(*this, instant, as_it_is);
  const auto child = right.behind_cut(node);
  if (!child) return std::nullopt;
  if (nodes_[node].parent < 0) return VirtualMeasurement{child->X, child->P};

  // Down the path from the last edge that says something (the camera's, if none is cut) to the
  // parent, side branches on the way.
  std::vector<int> path;
  for (int n = nodes_[node].parent; n >= 0; n = nodes_[n].parent) path.push_back(n);
  std::ranges::reverse(path);
  Walk left(*this, instant, as_it_is);
  std::optional<Belief> belief = Belief{};
  bool is_whole = false;  // the belief has all markers below in it
  for (std::size_t k = 0; k < path.size(); ++k) {
    if (left.is_cut(path[k])) {
      // Nothing from above: what is below begins anew, without the branch in question.
      const Alternative above{.cut_edges = {node}};
      belief = Walk(*this, instant, above).behind_cut(path[k]);
      if (!belief) return std::nullopt;
      is_whole = true;
      continue;
    }
    belief = left.descend(*belief, path[k]);
    if (!is_whole) left.subtree(path[k], &*belief, k + 1 < path.size() ? path[k + 1] : node);
  }
  const Pose z = belief->X.inverse() * child->X;
  return VirtualMeasurement{z, relative_covariance(z, belief->P, child->P)};
}

std::optional<VirtualMeasurement> TreeFilter::measure_marker(const Instant& instant,
                                                             int node) const {
  const auto& seen = instant.seen[node];
  if (!seen) return std::nullopt;
  // The part's belief without its own marker: that of an instant in which it was not seen.
  Instant without = instant;
  without.seen[node].reset();
  const Alternative as_it_is;
  Walk walk(*this, without, as_it_is);
  std::vector<int> path;
  for (int n = node; n >= 0; n = nodes_[n].parent) {
    if (walk.is_cut(n)) return std::nullopt;
    path.push_back(n);
  }
  std::ranges::reverse(path);
  Belief belief;
  for (std::size_t k = 0; k < path.size(); ++k) {
    belief = walk.descend(belief, path[k]);
    walk.subtree(path[k], &belief, k + 1 < path.size() ? path[k + 1] : -1);
  }
  const Pose z = belief.X.inverse() * seen->X_CB;
  return VirtualMeasurement{z, relative_covariance(z, belief.P, seen->covariance)};
}

}  // namespace bodyschema
