#include "processes/structure_learner/local_model.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>

#include "common/estimation/levenberg_marquardt.h"

namespace bodyschema {
namespace {

using Layout = ScrewChainLayout;

auto chain_of(const LocalModel& model, const NormalizedActions& actions, int sample) {
  return ScrewChain(model.first, model.num_joints(), [&model, &actions, sample](int d) {
    return ScrewLink{{model.joints[d].slide, model.joints[d].turn},
                     actions(sample, model.joints[d].signal),
                     model.joints[d].X_after};
  });
}

// The Jacobian of a prediction becomes that of its whitened residual.
void whitened_jacobian(const PairHypothesis& h, const Vector6d& error, const Pose& prediction,
                       ParameterJacobian* J) {
  const Matrix6d M = h.residual_jacobian(error, prediction);
  *J = M.lazyProduct(*J).eval();
}

// JᵀWJ and JᵀWr. Frames are stacked before they are multiplied: one product of a few hundred rows
// costs a fraction of many of six.
void normal_equations(const Fit& fit, const PairData& pair, const NormalizedActions& actions,
                      ParameterMatrix* H, ParameterVector* g) {
  constexpr int kBlock = 32;
  const int p = fit.model.num_parameters();
  H->setZero(p, p);
  g->setZero(p);
  Eigen::MatrixXd rows(6 * kBlock, p);
  Eigen::VectorXd residuals(6 * kBlock);
  ParameterJacobian J;
  for (int first = 0; first < pair.size(); first += kBlock) {
    const int count = std::min(kBlock, pair.size() - first);
    for (int n = 0; n < count; ++n) {
      const FrameFit& frame = fit.frames[first + n];
      const PairHypothesis& h = pair.hypotheses[frame.hypothesis];
      const Pose prediction =
          predict_with_jacobian(fit.model, actions, pair.frames[first + n].sample, &J);
      whitened_jacobian(h, frame.error, prediction, &J);
      const double root_w = std::sqrt(frame.weight());
      rows.middleRows<6>(6 * n) = root_w * J;
      residuals.segment<6>(6 * n) = root_w * frame.residual;
    }
    const auto block = rows.topRows(6 * count);
    H->selfadjointView<Eigen::Lower>().rankUpdate(block.transpose());
    g->noalias() += block.transpose() * residuals.head(6 * count);
  }
  *H = H->selfadjointView<Eigen::Lower>();
}

// Leave-one-out of whole blocks of time, `root` being that of (JᵀWJ)⁺. Without the block B the
// parameters' covariance is root A⁻¹ rootᵀ with A = I − Σ_B w (J root)ᵀ(J root), which is as small
// as the model; so r_B^T (I − H_BB)⁻¹ r_B never takes a matrix of the block's size.
void leave_blocks_out(const Fit& fit, const PairData& pair, const NormalizedActions& actions,
                      const ParameterMatrix& root, LeaveOneOut* result) {
  const int p = fit.model.num_parameters();
  const TimeBlocks& blocks = actions.blocks();
  std::vector<ParameterJacobian> JR;
  for (int first = 0, last = 0; first < pair.size(); first = last) {
    const int block = blocks.block_of(pair.frames[first].sample);
    Eigen::MatrixXd A = Eigen::MatrixXd::Identity(p, p);
    ParameterVector g = ParameterVector::Zero(p);
    JR.clear();
    for (; last < pair.size() && blocks.block_of(pair.frames[last].sample) == block; ++last) {
      const FrameFit& frame = fit.frames[last];
      const PairHypothesis& h = pair.hypotheses[frame.hypothesis];
      ParameterJacobian J;
      const Pose prediction =
          predict_with_jacobian(fit.model, actions, pair.frames[last].sample, &J);
      whitened_jacobian(h, h.error(prediction.inverse()), prediction, &J);
      JR.push_back(J * root);
      const double w = frame.weight();
      A.noalias() -= w * JR.back().transpose() * JR.back();
      g.noalias() += w * JR.back().transpose() * frame.residual;
    }
    // A block that alone decides a parameter has eigenvalue 0 here; the floor as for single frames.
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> e(A);
    const Eigen::MatrixXd inverse = e.eigenvectors() *
                                    e.eigenvalues().cwiseMax(1e-3).cwiseInverse().asDiagonal() *
                                    e.eigenvectors().transpose();
    const ParameterVector step = inverse * g;
    for (int t = first; t < last; ++t) {
      const ParameterJacobian& J = JR[t - first];
      const Vector6d left_out = fit.frames[t].residual + J * step;
      const Matrix6d S =
          Matrix6d::Identity() + fit.frames[t].weight() * J * inverse * J.transpose();
      result->squared_distance.push_back(left_out.dot(S.llt().solve(left_out)));
      result->residual.push_back(
          pair.hypotheses[fit.frames[t].hypothesis].whitening.triangularView<Eigen::Lower>().solve(
              left_out));
    }
  }
}

}  // namespace

bool LocalModel::uses(int s) const {
  return std::any_of(joints.begin(), joints.end(), [s](const Joint& j) { return j.signal == s; });
}

Pose LocalModel::predict(const NormalizedActions& actions, int sample) const {
  return chain_of(*this, actions, sample).predict();
}

LocalModel LocalModel::inverse() const {
  LocalModel result;
  const int k = num_joints();
  for (int d = k; d-- > 0;) {
    const Pose& X_before = d == 0 ? first : joints[d - 1].X_after;
    Joint joint = joints[d];
    joint.slide = -joint.slide;
    joint.turn = -joint.turn;
    joint.X_after = X_before.inverse();
    result.joints.push_back(joint);
  }
  result.first = (k == 0 ? first : joints.back().X_after).inverse();
  return result;
}

Pose predict_with_jacobian(const LocalModel& model, const NormalizedActions& actions, int sample,
                           ParameterJacobian* jacobian) {
  const Pose X = chain_of(model, actions, sample).predict_by_parameters(jacobian);
  for (int d = 0; d < model.num_joints(); ++d)
    if (model.joints[d].slides) jacobian->col(Layout::turn(d)).setZero();
  if (model.is_position)
    jacobian->middleCols<3>(Layout::transform(model.num_joints()) + 3).setZero();
  return X;
}

MotionJacobian motion_jacobian(const LocalModel& model, const NormalizedActions& actions,
                               int sample) {
  MotionJacobian J;
  chain_of(model, actions, sample).predict_by_displacements(&J);
  return J;
}

LocalModel perturbed(const LocalModel& model, const ParameterVector& step) {
  LocalModel result = model;
  result.first = model.first * exp(step.head<6>());
  for (int d = 0; d < model.num_joints(); ++d) {
    LocalModel::Joint& joint = result.joints[d];
    joint.slide += step(Layout::slide(d));
    joint.turn += step(Layout::turn(d));
    joint.X_after = joint.X_after * exp(step.segment<6>(Layout::transform(d + 1)));
  }
  return result;
}

FrameFit best_reading(const PairData& pair, int frame, const Pose& prediction) {
  const PairFrame& f = pair.frames[frame];
  const Pose inverse = prediction.inverse();
  FrameFit best;
  double best_score = std::numeric_limits<double>::infinity();
  for (int n = 0; n < f.num_hypotheses; ++n) {
    const PairHypothesis& h = pair.hypotheses[f.first_hypothesis + n];
    const Vector6d error = h.error(inverse);
    const Vector6d r = h.whitened(error, prediction);
    const double d2 = r.squaredNorm();
    // The readings' shares in a heavy-tailed likelihood: a reading far off by both hypotheses must
    // not be decided by their determinants.
    const double score = 2 * robust_cost(d2, h.num_residuals) + h.log_det + h.penalty;
    if (score < best_score) {
      best_score = score;
      best = {f.first_hypothesis + n, error, r, d2, h.num_residuals};
    }
  }
  return best;
}

Fit evaluate(const LocalModel& model, const PairData& pair, const NormalizedActions& actions) {
  Fit fit;
  fit.model = model;
  fit.frames.reserve(pair.size());
  for (int t = 0; t < pair.size(); ++t) {
    fit.frames.push_back(best_reading(pair, t, model.predict(actions, pair.frames[t].sample)));
    fit.cost += fit.frames.back().cost();
  }
  return fit;
}

Fit fit_local_model(const LocalModel& start, const PairData& pair, const NormalizedActions& actions,
                    int max_iterations, double tolerance) {
  Fit fit = evaluate(start, pair, actions);
  ParameterMatrix H;
  ParameterVector g;
  LevenbergMarquardt optimizer(1e-4, 1e-10, 8);
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    normal_equations(fit, pair, actions, &H, &g);
    double decrease = 0;
    const bool improved = optimizer.step(H, g, [&](const ParameterVector& step) {
      Fit candidate = evaluate(perturbed(fit.model, step), pair, actions);
      if (!(candidate.cost < fit.cost)) return false;
      decrease = fit.cost - candidate.cost;
      fit = std::move(candidate);
      return true;
    });
    // Residuals far below the noise go on to the end of the arithmetic: it costs a step or two.
    if (!improved || (decrease < tolerance && fit.cost > 1e-3 * pair.size())) break;
    // Stuck where no model is valid (a valid one costs about 5 a frame, outliers 30).
    if (iteration >= 8 && fit.cost > 16 * pair.size() && decrease < 0.01 * fit.cost) break;
  }
  return fit;
}

LeaveOneOut leave_one_out(const Fit& fit, const PairData& pair, const NormalizedActions& actions) {
  ParameterMatrix H;
  ParameterVector g;
  normal_equations(fit, pair, actions, &H, &g);
  const int p = fit.model.num_parameters();
  LeaveOneOut result;
  // Scaled to a unit diagonal, so that metres and radians count alike in the rank.
  ParameterVector scale(p);
  for (int n = 0; n < p; ++n) scale(n) = H(n, n) > 0 ? 1 / std::sqrt(H(n, n)) : 1;
  const Eigen::MatrixXd scaled = scale.asDiagonal() * H * scale.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(scaled);
  const double threshold = 1e-9 * std::max(eigen.eigenvalues()(p - 1), 1e-300);
  ParameterMatrix root(p, p);  // (JᵀWJ)⁺ = root · rootᵀ
  root.setZero();
  for (int n = 0; n < p; ++n) {
    if (eigen.eigenvalues()(n) <= threshold) continue;
    root.col(n) =
        scale.cwiseProduct(eigen.eigenvectors().col(n)) / std::sqrt(eigen.eigenvalues()(n));
    ++result.rank;
  }
  result.parameter_covariance = root * root.transpose();

  result.squared_distance.reserve(pair.size());
  result.residual.reserve(pair.size());
  if (actions.blocks().is_stream()) {
    leave_blocks_out(fit, pair, actions, root, &result);
    return result;
  }
  ParameterJacobian J;
  for (int t = 0; t < pair.size(); ++t) {
    const FrameFit& frame = fit.frames[t];
    const PairHypothesis& h = pair.hypotheses[frame.hypothesis];
    const Pose prediction = predict_with_jacobian(fit.model, actions, pair.frames[t].sample, &J);
    whitened_jacobian(h, frame.error, prediction, &J);
    const ParameterJacobian JR = J.lazyProduct(root);
    const Matrix6d I_minus_H =
        Matrix6d::Identity() - frame.weight() * JR.lazyProduct(JR.transpose()).eval();
    // A frame that alone decides a parameter has eigenvalue 0 here: it cannot be predicted from the
    // others, so its residual of 0 is no evidence. The floor keeps that finite; away from it a
    // Cholesky factor is enough.
    Vector6d left_out;
    const Eigen::LLT<Matrix6d> llt(I_minus_H);
    if (llt.info() == Eigen::Success && llt.matrixLLT().diagonal().minCoeff() > 0.2) {
      left_out = llt.solve(frame.residual);
    } else {
      const Eigen::SelfAdjointEigenSolver<Matrix6d> e(I_minus_H);
      left_out = e.eigenvectors() * (e.eigenvectors().transpose() * frame.residual)
                                        .cwiseQuotient(e.eigenvalues().cwiseMax(1e-3));
    }
    result.squared_distance.push_back(frame.residual.dot(left_out));
    result.residual.push_back(h.whitening.triangularView<Eigen::Lower>().solve(left_out));
  }
  return result;
}

Eigen::MatrixXd scores(const Fit& fit, const PairData& pair, const NormalizedActions& actions) {
  Eigen::MatrixXd result(fit.model.num_parameters(), pair.size());
  ParameterJacobian J;
  for (int t = 0; t < pair.size(); ++t) {
    const FrameFit& frame = fit.frames[t];
    const Pose prediction = predict_with_jacobian(fit.model, actions, pair.frames[t].sample, &J);
    whitened_jacobian(pair.hypotheses[frame.hypothesis], frame.error, prediction, &J);
    result.col(t) = frame.weight() * J.transpose() * frame.residual;
  }
  return result;
}

}  // namespace bodyschema
