#include "processes/structure_learner/joints/missing_joint_test.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

#include "common/estimation/chi_square.h"
#include "processes/structure_learner/serial_correlation.h"
#include "processes/structure_learner/tree_fit.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
namespace {

// 3 or 6 dimensions without a heap; one type, for the decompositions are long to compile.
using UpTo6x6 = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 6, 6>;
using UpTo6 = Eigen::Matrix<double, Eigen::Dynamic, 1, Eigen::ColMajor, 6, 1>;

// Directions of ξ that the tree's other parameters take over to this share are no evidence.
constexpr double kLeastShare = 1e-4;

// The score test of one more joint in one rigid cluster, for every moving signal.
class ClusterTest {
 public:
  // The same for all clusters.
  struct Context {
    const TreeFit::Normal& normal;
    const Eigen::MatrixXd& inverse;  // of H
    const Eigen::VectorXd newton;    // H⁻¹g
    const Eigen::MatrixXd q, q2;     // frames × moving signals
    const Matrix6d bias;             // covariance of a marker's own bias
    const double unknown_bias;       // beside it, in standard deviations of one sight
    const Eigen::VectorXd noise;     // by moving signal: variance of what it explains of noise
  };

  ClusterTest(const TreeFit& tree, const Context& context, int top)
      : tree_(tree), context_(context), top_(top), members_(cluster_of(tree.nodes(), top)) {
    find_items();
    find_related();
    stack_frames();
  }

  // The parting that explains most with the moving signal `s`; log_tail 0 if none does.
  MissingJoint best_joint(int s) {
    sum_over_frames(s);
    noise_ = context_.noise(s);
    MissingJoint best;
    for (int first = 0; first < num_items(); ++first) {
      std::vector<bool> moves(num_items(), false);
      moves[first] = true;
      MissingJoint joint = exchange(first, &moves);
      // A resting root does not move.
      if (top_ == 0 && !std::count(moves.begin(), moves.end(), false)) continue;
      if (first > 0 && joint.log_tail >= best.log_tail) continue;
      for (int i = 0; i < num_items(); ++i)
        if (moves[i])
          (items_[i].is_branch ? joint.branches : joint.members).push_back(items_[i].node);
      joint.signal = tree_.actions().moving()[s];
      joint.log_ways = num_items() * std::log(2.0);
      best = joint;
    }
    return best;
  }

 private:
  // Columns of B, which is zero apart from them, and where they are among those that are not.
  struct Columns {
    Eigen::Index first, packed, size;
  };
  // Anything that may move: a marker of the cluster, or a branch on it.
  struct Item {
    int node;
    bool is_branch;
    Matrix6d bias;  // covariance of a bias about where the item is, as a twist in the top's frame
    std::vector<int> related = {};      // nodes whose parameters share a marker with the item ...
    std::vector<Columns> columns = {};  // ... and where these are in the rows of B
    Eigen::Index num_columns = 0;
  };

  int num_items() const { return static_cast<int>(items_.size()); }
  int num_frames() const { return tree_.num_frames(); }
  int at(int frame, int node) const { return tree_.at(frame, node); }
  // The root's poses are free and eliminated: items share them.
  bool is_eliminated() const { return !tree_.root_rests(); }

  void add_item(int node, bool is_branch) {
    Pose at_item = Pose::Identity();
    for (int t = 0; t < num_frames(); ++t)
      at_item.translation() +=
          (tree_.pose(t, top_).inverse() * tree_.pose(t, node)).translation() / num_frames();
    const Matrix6d F = adjoint(at_item);
    items_.push_back({node, is_branch, F * context_.bias * F.transpose()});
  }

  void find_items() {
    for (const int k : members_)
      if (tree_.is_seen(k)) add_item(k, false);
    for (int k = top_ + 1; k < static_cast<int>(tree_.nodes().size()); ++k)
      if (tree_.nodes()[k].model.num_joints() > 0 &&
          std::count(members_.begin(), members_.end(), tree_.nodes()[k].parent))
        add_item(k, true);
  }

  // Parameters that share a marker with the cluster, and those with each item: most of a large tree
  // does not with most items.
  void find_related() {
    std::vector<int> columns;
    for (int k = is_eliminated() ? 1 : 0; k < static_cast<int>(tree_.nodes().size()); ++k) {
      if (!is_eliminated() && !tree_.is_below(k, top_) && !tree_.is_below(top_, k)) continue;
      const int p = k == 0 ? 6 : tree_.nodes()[k].model.num_parameters();
      for (Item& item : items_)
        if (is_eliminated() || tree_.is_below(item.node, k) ||
            (item.is_branch && tree_.is_below(k, item.node)))
          relate(k, static_cast<Eigen::Index>(columns.size()), p, &item);
      for (int c = 0; c < p; ++c) columns.push_back(context_.normal.offset[k] + c);
    }
    inverse_ = context_.inverse(columns, columns);
    newton_ = context_.newton(columns);
  }

  static void relate(int node, Eigen::Index first, Eigen::Index size, Item* item) {
    item->related.push_back(node);
    if (item->columns.empty() || item->columns.back().first + item->columns.back().size != first)
      item->columns.push_back({first, item->num_columns, 0});
    item->columns.back().size += size;
    item->num_columns += size;
  }

  // For q = 1 and F = Ad(X_top): F_tᵀJ_t, F_tᵀr_t, F_tᵀF_t of each item.
  void stack_frames() {
    const int T = num_frames(), n = num_items();
    FJ_.clear();
    for (const Item& item : items_) FJ_.emplace_back(6 * item.num_columns, T);
    Fr_.assign(n, Eigen::MatrixXd(6, T));
    FF_.resize(n * n);
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j)
        if (i == j || is_eliminated()) FF_[i * n + j] = Eigen::MatrixXd::Zero(36, T);
    std::vector<Matrix6d> FI(n);
    for (int t = 0; t < T; ++t) {
      for (int i = 0; i < n; ++i) FI[i] = stack_item(t, i);
      if (!is_eliminated()) continue;
      for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j)
          Eigen::Map<Matrix6d>(FF_[i * n + j].col(t).data()) -=
              FI[i] * context_.normal.inverse_total[t] * FI[j].transpose();
    }
    for (int i = 0; i < n; ++i) FJ_[i] = (FJ_[i] * context_.q).eval();
  }

  // FᵀI of the item in the frame.
  Matrix6d stack_item(int t, int i) {
    const TreeFit::Normal& normal = context_.normal;
    const int k = items_[i].node;
    const bool is_branch = items_[i].is_branch;
    const Matrix6d F = adjoint(tree_.pose(t, top_));
    // A marker counts with its own share, a branch with all beyond it.
    const Matrix6d FI = F.transpose() * (is_branch ? normal.I : normal.own_I)[at(t, k)];
    Vector6d r = F.transpose() * (is_branch ? normal.gradient : normal.own_gradient)[at(t, k)];
    if (is_eliminated()) r -= FI * (normal.inverse_total[t] * normal.gradient[at(t, 0)]);
    Fr_[i].col(t) = r;
    Eigen::Map<Matrix6d>(FF_[i * num_items() + i].col(t).data()) = FI * F;
    Eigen::Map<Eigen::MatrixXd> fj(FJ_[i].col(t).data(), 6, items_[i].num_columns);
    Eigen::Index column = 0;
    for (const int e : items_[i].related) {
      const ParameterJacobian& S = normal.S[at(t, e)];
      auto block = fj.middleCols(column, S.cols());
      if (is_branch && tree_.is_below(e, k))
        block = (F.transpose() * normal.I[at(t, e)]).lazyProduct(S);
      else if (tree_.is_below(k, e))
        block = FI.lazyProduct(S);
      else
        block.setZero();
      if (is_eliminated())
        block -= (FI * normal.inverse_total[t] * normal.I[at(t, e)]).lazyProduct(S);
      column += S.cols();
    }
    return FI;
  }

  void sum_over_frames(int s) {
    const int n = num_items();
    u_.resize(6 * n);
    C_.resize(6 * n, 6 * n);
    for (int i = 0; i < n; ++i) {
      Eigen::Matrix<double, 6, Eigen::Dynamic> BH(6, newton_.size());  // B_i H⁻¹
      BH.setZero();
      u_.segment<6>(6 * i) = Fr_[i] * context_.q.col(s);
      for (const Columns& c : items_[i].columns) {
        BH.noalias() += columns_of(i, s, c) * inverse_.middleRows(c.first, c.size);
        u_.segment<6>(6 * i) -= columns_of(i, s, c) * newton_.segment(c.first, c.size);
      }
      for (int j = 0; j <= i; ++j) {
        Matrix6d C = Matrix6d::Zero();
        for (const Columns& c : items_[j].columns)
          C.noalias() -= BH.middleCols(c.first, c.size) * columns_of(j, s, c).transpose();
        C_.block<6, 6>(6 * i, 6 * j) = C;
        C_.block<6, 6>(6 * j, 6 * i) = C.transpose();
      }
    }
    own_ = Eigen::MatrixXd::Zero(6, 6 * n);
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) {
        if (i != j && !is_eliminated()) continue;
        const Eigen::Matrix<double, 36, 1> sum = FF_[i * n + j] * context_.q2.col(s);
        C_.block<6, 6>(6 * i, 6 * j) += Eigen::Map<const Matrix6d>(sum.data());
        if (i == j) own_.middleCols<6>(6 * i) = Eigen::Map<const Matrix6d>(sum.data());
      }
    unknown_.clear();
    for (int i = 0; i < n; ++i) unknown_.push_back(unknown_bias(i, s));
  }

  // Of the rows of B of an item for one signal.
  Eigen::Map<const Eigen::Matrix<double, 6, Eigen::Dynamic>> columns_of(int i, int s,
                                                                        const Columns& c) const {
    return {FJ_[i].col(s).data() + 6 * c.packed, 6, c.size};
  }

  // Covariance of a bias that nobody told, as a twist in the top's frame.
  Matrix6d unknown_bias(int i, int s) const {
    double q2 = 0;
    for (int t = 0; t < num_frames(); ++t)
      if (!FF_[i * num_items() + i].col(t).isZero(0)) q2 += context_.q2(t, s);
    Matrix6d information = own_.middleCols<6>(6 * i) / std::max(q2, 1e-300);
    const Vector6d unit = information.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    information = unit.asDiagonal() * information * unit.asDiagonal();
    information.diagonal().array() += 1e-6;
    return context_.unknown_bias * context_.unknown_bias * context_.normal.noise_scale() *
           (unit.asDiagonal() * information.inverse() * unit.asDiagonal());
  }

  // Items change sides, `first` apart, while the joint gets less likely by chance.
  MissingJoint exchange(int first, std::vector<bool>* moves) const {
    MissingJoint joint = test(*moves);
    for (bool changed = true; changed;) {
      changed = false;
      for (int i = 0; i < num_items(); ++i) {
        if (i == first) continue;
        (*moves)[i] = !(*moves)[i];
        MissingJoint other = test(*moves);
        if (other.log_tail < joint.log_tail - 1e-9) {
          joint = other;
          changed = true;
        } else {
          (*moves)[i] = !(*moves)[i];
        }
      }
    }
    return joint;
  }

  MissingJoint test(const std::vector<bool>& moves) const {
    Matrix6d C = Matrix6d::Zero(), own = Matrix6d::Zero(), bias = Matrix6d::Zero();
    Vector6d u = Vector6d::Zero();
    for (int i = 0; i < num_items(); ++i) {
      if (!moves[i]) continue;
      u += u_.segment<6>(6 * i);
      own += own_.middleCols<6>(6 * i);
      bias += items_[i].bias + unknown_[i];
      for (int j = 0; j < num_items(); ++j)
        if (moves[j]) C += C_.block<6, 6>(6 * i, 6 * j);
    }
    bias /= static_cast<double>(std::count(moves.begin(), moves.end(), true));
    MissingJoint joint;
    joint.top = top_;
    // Scaled to units of the markers' own information, so that metres and radians count alike.
    const Vector6d unit = own.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    const Vector6d inverse = unit.cwiseInverse();
    const Vector6d unit_u = unit.cwiseProduct(u);
    const Matrix6d unit_C = unit.asDiagonal() * C * unit.asDiagonal();
    const Matrix6d unit_bias = inverse.asDiagonal() * bias * inverse.asDiagonal();
    for (const int dof : {3, 6}) explain(dof, unit_u, unit_C, unit_bias, unit, &joint);
    return joint;
  }

  // The joint becomes the one of so many degrees of freedom if that is less likely by chance.
  void explain(int dof, const Vector6d& u, const Matrix6d& C, const Matrix6d& bias,
               const Vector6d& unit, MissingJoint* joint) const {
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(
        Eigen::MatrixXd(C.topLeftCorner(dof, dof)));
    const UpTo6x6 V = eigen.eigenvectors();
    // ξ along the eigenvectors, and its covariance: of the noise and of the bias.
    UpTo6 xi = V.transpose() * u.head(dof);
    UpTo6x6 covariance = V.transpose() * bias.topLeftCorner(dof, dof) * V;
    for (int i = 0; i < dof; ++i) {
      if (eigen.eigenvalues()(i) < kLeastShare) {
        xi(i) = 0;
        covariance.row(i).setZero();
        covariance.col(i).setZero();
        covariance(i, i) = 1;
      } else {
        xi(i) /= eigen.eigenvalues()(i);
        covariance(i, i) += noise_ / eigen.eigenvalues()(i);
      }
    }
    const double sum = xi.dot(covariance.ldlt().solve(xi));
    const double log_tail = log_chi_square_tail(sum, dof);
    if (log_tail >= joint->log_tail) return;
    joint->log_tail = log_tail;
    joint->statistic = sum;
    joint->slides = dof == 3;
    joint->xi.setZero();
    joint->xi.head(dof) = -unit.head(dof).cwiseProduct(V * xi);
  }

  const TreeFit& tree_;
  const Context& context_;
  const int top_;
  const std::vector<int> members_;
  std::vector<Item> items_;
  Eigen::MatrixXd inverse_;  // share of H⁻¹ and of H⁻¹g of what is related to any item
  Eigen::VectorXd newton_;
  std::vector<Eigen::MatrixXd> FJ_, Fr_, FF_;  // by item (FF_: by two), a column a frame or signal
  // For one signal, stacked over the items: the score, its covariance, the items' own information.
  Eigen::VectorXd u_;
  Eigen::MatrixXd C_, own_;
  std::vector<Matrix6d> unknown_;
  double noise_ = 1;
};

// Frames × moving signals.
Eigen::MatrixXd moving_actions(const TreeFit& fit) {
  const auto& moving = fit.actions().moving();
  Eigen::MatrixXd q(fit.num_frames(), moving.size());
  for (int t = 0; t < fit.num_frames(); ++t)
    for (std::size_t s = 0; s < moving.size(); ++s)
      q(t, static_cast<Eigen::Index>(s)) = fit.actions()(fit.sample(t), moving[s]);
  return q;
}

// By moving signal: variance of what it explains of the noise, over what the weights say.
Eigen::VectorXd explained_noise(const TreeFit& fit, const TreeFit::Normal& normal,
                                const Eigen::MatrixXd& q) {
  const double correlation = fit.serial_correlation();
  std::vector<int> samples;
  for (int t = 0; t < fit.num_frames(); ++t) samples.push_back(fit.sample(t));
  Eigen::VectorXd result(q.cols());
  for (Eigen::Index s = 0; s < q.cols(); ++s)
    result(s) = normal.noise_scale() *
                variance_inflation({q.col(s).begin(), q.col(s).end()}, samples, correlation);
  return result;
}

// The edges whose parameters a node's motion has in common: where the root rests, those on its path
// and beyond it.
std::vector<int> edges_in_common(const TreeFit& fit, int node) {
  const bool rests = fit.root_rests();
  std::vector<int> edges;
  for (int e = rests ? 0 : 1; e < static_cast<int>(fit.nodes().size()); ++e)
    if (!rests || fit.is_below(e, node) || fit.is_below(node, e)) edges.push_back(e);
  return edges;
}

// Those of the edges' parameters.
std::vector<int> columns_of(const std::vector<int>& edges, const TreeFit& fit,
                            const TreeFit::Normal& normal) {
  std::vector<int> columns;
  for (const int e : edges) {
    const int p = e == 0 ? 6 : fit.nodes()[e].model.num_parameters();
    for (int c = 0; c < p; ++c) columns.push_back(normal.offset[e] + c);
  }
  return columns;
}

}  // namespace

std::vector<MissingJoint> missing_joints(const TreeFit& fit, const Noise& bias,
                                         double unknown_bias) {
  const TreeFit::Normal normal = fit.normal_equations();
  const std::optional<Eigen::MatrixXd> inverse = normal.inverse();
  if (!inverse) return {};
  const Eigen::MatrixXd q = moving_actions(fit);
  const ClusterTest::Context context{normal,
                                     *inverse,
                                     *inverse * normal.g,
                                     q,
                                     q.cwiseProduct(q),
                                     isotropic(bias),
                                     unknown_bias,
                                     explained_noise(fit, normal, q)};
  std::vector<MissingJoint> result;
  for (int top = 0; top < static_cast<int>(fit.nodes().size()); ++top) {
    if (top > 0 && fit.nodes()[top].model.num_joints() == 0) continue;
    ClusterTest test(fit, context, top);
    for (int s = 0; s < static_cast<int>(q.cols()); ++s)
      if (MissingJoint joint = test.best_joint(s); joint.log_tail < 0)
        result.push_back(std::move(joint));
  }
  std::stable_sort(result.begin(), result.end(),
                   [](const auto& x, const auto& y) { return x.log_tail < y.log_tail; });
  return result;
}

std::optional<MissingJoint> most_significant(const std::vector<MissingJoint>& joints,
                                             int num_frames, const std::set<int>& idle_signals) {
  constexpr double kErrorRates[2] = {0.002, 0.003};  // of a signal in use, of an idle one
  constexpr double kFewFrames = 20;
  const double log_frames = std::log(std::max(num_frames / kFewFrames, 1.0));
  double ways[2] = {0, 0};
  for (const MissingJoint& j : joints) ways[idle_signals.count(j.signal)] += std::exp(j.log_ways);
  const MissingJoint* best = nullptr;
  double best_margin = 0;
  for (const MissingJoint& j : joints) {
    const std::size_t idle = idle_signals.count(j.signal);
    const double margin = j.log_tail + std::log(2 * ways[idle] / kErrorRates[idle]) +
                          0.5 * (j.slides ? 3 : 6) * log_frames;
    if (margin < best_margin) {
      best = &j;
      best_margin = margin;
    }
  }
  return best ? std::optional(*best) : std::nullopt;
}

Eigen::MatrixXd missing_joint_information(const TreeFit& fit) {
  const int n = static_cast<int>(fit.nodes().size());
  const int T = fit.num_frames();
  const bool rests = fit.root_rests();
  const auto m = static_cast<Eigen::Index>(fit.actions().moving().size());
  Eigen::MatrixXd result = Eigen::MatrixXd::Zero(n, m);
  const TreeFit::Normal normal = fit.normal_equations();
  const std::optional<Eigen::MatrixXd> inverse = normal.inverse();
  if (!inverse) return result;
  const Eigen::MatrixXd q = moving_actions(fit);
  const Eigen::MatrixXd q2 = q.cwiseProduct(q);
  const Eigen::VectorXd noise = explained_noise(fit, normal, q);
  for (int k = 1; k < n; ++k) {
    const std::vector<int> edges = edges_in_common(fit, k);
    const std::vector<int> columns = columns_of(edges, fit, normal);
    const auto size = static_cast<Eigen::Index>(columns.size());
    // Stacked over the frames, for q = 1: what the three axes share with each other and with the
    // parameters of these edges.
    Eigen::MatrixXd own(9, T);
    Eigen::MatrixXd shared = Eigen::MatrixXd::Zero(3 * size, T);
    for (int t = 0; t < T; ++t) {
      const Eigen::Matrix<double, 6, 3> axes = adjoint(fit.pose(t, k)).rightCols<3>();
      const Eigen::Matrix<double, 3, 6> AI = axes.transpose() * normal.I[fit.at(t, k)];
      const Eigen::Matrix<double, 3, 6> AIT =
          rests ? Eigen::Matrix<double, 3, 6>::Zero() : (AI * normal.inverse_total[t]).eval();
      Eigen::Map<Eigen::Matrix3d>(own.col(t).data()) = AI * axes - AIT * AI.transpose();
      Eigen::Map<Eigen::MatrixXd> row(shared.col(t).data(), 3, size);
      Eigen::Index offset = 0;
      for (const int e : edges) {
        const ParameterJacobian& S = normal.S[fit.at(t, e)];
        auto block = row.middleCols(offset, S.cols());
        offset += S.cols();
        if (fit.is_below(e, k))
          block = (axes.transpose() * normal.I[fit.at(t, e)]).lazyProduct(S);
        else if (fit.is_below(k, e))
          block = AI.lazyProduct(S);
        if (!rests) block -= (AIT * normal.I[fit.at(t, e)]).lazyProduct(S);
      }
    }
    const Eigen::MatrixXd owns = own * q2, shares = shared * q;
    const Eigen::MatrixXd inverse_of_these = (*inverse)(columns, columns);
    // All signals' rows at once: a product with three rows alone is slow.
    const Eigen::Map<const Eigen::MatrixXd> by_signal(shares.data(), 3, size * m);
    Eigen::MatrixXd stacked(3 * m, size);
    for (Eigen::Index s = 0; s < m; ++s)
      stacked.middleRows<3>(3 * s) = by_signal.middleCols(s * size, size);
    const Eigen::MatrixXd solved = stacked * inverse_of_these;
    for (Eigen::Index s = 0; s < m; ++s) {
      const Eigen::Matrix3d C =
          Eigen::Map<const Eigen::Matrix3d>(owns.col(s).data()) -
          solved.middleRows<3>(3 * s) * stacked.middleRows<3>(3 * s).transpose();
      const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(C, Eigen::EigenvaluesOnly);
      result(k, s) = std::max(eigen.eigenvalues()(0), 0.0) / noise(s);
    }
  }
  return result;
}

}  // namespace bodyschema
