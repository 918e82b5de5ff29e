#include "common/estimation/evaluation.h"

#include <fmt/format.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>
#include <string>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

struct Errors {
  std::vector<double> position_m, rotation_rad;
};

double rms(const std::vector<double>& values) {
  double sum = 0;
  for (const double value : values) sum += value * value;
  return std::sqrt(sum / static_cast<double>(values.size()));
}

void check_signals(const BodySchema& schema, const ActionPoseSample& sample) {
  if (sample.action.size() == static_cast<int>(schema.signals.size())) return;
  throw std::invalid_argument(fmt::format("the samples have {} action signals, the schema {}",
                                          sample.action.size(), schema.signals.size()));
}

constexpr double kPositionUnit_m = 0.001;
constexpr double kRotationUnit_rad = 0.1 * kDegree;
constexpr int kShared = 7;  // unknowns that all parts share: X_RS, log scale

// Unknowns that no sample decides (the scale where all axes meet, one of two frames of a rigid
// part) stays where it is: a prior, chosen ten times a lab's calibration errors, so that it weighs
// nothing else.
constexpr double kPriorPosition_m = 0.01;
constexpr double kPriorRotation_rad = 5 * kDegree;
constexpr double kPriorScale = 0.02;

Vector6d per_axis(double translation, double rotation) {
  Vector6d result;
  result << Eigen::Vector3d::Constant(translation), Eigen::Vector3d::Constant(rotation);
  return result;
}

/// One Gauss-Newton step: unknowns are right perturbations of X_RS and each X_PB, and log scale.
class AlignmentStep {
 public:
  explicit AlignmentStep(const Alignment& start) : alignment_(start) {
    const auto n = kShared + 6 * static_cast<Eigen::Index>(start.X_PB.size());
    H_ = Eigen::MatrixXd::Zero(n, n);
    g_ = Eigen::VectorXd::Zero(n);
    add_prior(0, start.X_RS);
    Eigen::Index at = kShared;
    for (const auto& [part, X_PB] : start.X_PB) {
      add_prior(at, X_PB);
      at += 6;
    }
    H_(6, 6) += 1 / (kPriorScale * kPriorScale);
    g_[6] -= std::log(start.scale) / (kPriorScale * kPriorScale);
  }

  void add(int part, const Pose& predicted, const Pose& truth, bool has_rotation) {
    const auto of_part = alignment_.X_PB.find(part);
    const Pose aligned = alignment_.aligned(part, predicted);
    const Vector6d weight = per_axis(1 / kPositionUnit_m, has_rotation ? 1 / kRotationUnit_rad : 0);
    Pose turned = truth;
    if (!has_rotation) turned.linear() = aligned.linear();
    const Vector6d residual = weight.cwiseProduct(log(Pose(aligned.inverse() * turned)));
    Eigen::Matrix<double, 6, kShared> shared;
    shared.leftCols<6>() = adjoint(Pose(aligned.inverse() * alignment_.X_RS));
    shared.col(6).head<3>() = (alignment_.X_RS.inverse() * aligned).linear().transpose() *
                              (alignment_.scale * predicted.translation());
    shared.col(6).tail<3>().setZero();
    shared = weight.asDiagonal() * shared;
    const Matrix6d own = weight.asDiagonal();
    const Eigen::Index at = kShared + 6 * std::distance(alignment_.X_PB.begin(), of_part);
    H_.topLeftCorner<kShared, kShared>() += shared.transpose() * shared;
    H_.block<kShared, 6>(0, at) += shared.transpose() * own;
    H_.block<6, kShared>(at, 0) += own * shared;
    H_.block<6, 6>(at, at) += own * own;
    g_.head<kShared>() += shared.transpose() * residual;
    g_.segment<6>(at) += own * residual;
  }

  Alignment solved() const {
    const Eigen::VectorXd step = H_.ldlt().solve(g_);
    if (!step.allFinite()) return alignment_;
    Alignment result = alignment_;
    result.X_RS = alignment_.X_RS * exp(Vector6d(step.head<6>()));
    result.scale *= std::exp(step[6]);
    Eigen::Index at = kShared;
    for (auto& [part, X_PB] : result.X_PB) {
      X_PB = X_PB * exp(Vector6d(step.segment<6>(at)));
      at += 6;
    }
    return result;
  }

 private:
  void add_prior(Eigen::Index at, const Pose& X) {
    const Vector6d weight =
        per_axis(std::pow(kPriorPosition_m, -2), std::pow(kPriorRotation_rad, -2));
    H_.diagonal().segment<6>(at) += weight;
    g_.segment<6>(at) -= weight.cwiseProduct(log(X));
  }

  const Alignment& alignment_;
  Eigen::MatrixXd H_;
  Eigen::VectorXd g_;
};

}  // namespace

Pose Alignment::aligned(int part, const Pose& X_SP) const {
  Pose scaled = X_SP;
  scaled.translation() *= scale;
  const auto of_part = X_PB.find(part);
  return of_part == X_PB.end() ? Pose(X_RS * scaled) : Pose(X_RS * scaled * of_part->second);
}

std::optional<Alignment> align(const BodySchema& schema,
                               const std::vector<ActionPoseSample>& samples) {
  struct Pair {
    int part;
    Pose predicted, truth;
    bool has_rotation;
  };
  std::vector<Pair> pairs;
  Alignment result;
  int num_samples = 0;
  for (const ActionPoseSample& sample : samples) {
    check_signals(schema, sample);
    const PartObservation* root = sample.find(schema.root);
    if (!root || !root->has_rotation) continue;
    ++num_samples;
    for (const auto& [part, predicted] : schema.predict_all(sample.action)) {
      const PartObservation* seen = sample.find(part);
      if (!seen || part == schema.root) continue;
      pairs.push_back({part, predicted, root->X_CB.inverse() * seen->X_CB,
                       seen->has_rotation && schema.has_rotation(part)});
      result.X_PB[part] = Pose::Identity();
    }
  }
  if (num_samples < kMinAligned || pairs.empty()) return std::nullopt;
  constexpr int kSteps = 10;  // from some millimetres and degrees off; quadratic
  for (int i = 0; i < kSteps; ++i) {
    AlignmentStep step(result);
    for (const Pair& pair : pairs)
      step.add(pair.part, pair.predicted, pair.truth, pair.has_rotation);
    result = Alignment(step.solved());
  }
  return result;
}

JudgedErrors judge(const BodySchema& schema, const std::vector<ActionPoseSample>& held_out,
                   const std::vector<ActionPoseSample>& truth) {
  JudgedErrors result;
  result.parts = evaluate(schema, held_out);
  result.alignment = align(schema, truth);
  if (result.alignment) result.aligned_parts = evaluate(schema, held_out, *result.alignment);
  return result;
}

std::vector<PartErrors> evaluate(const BodySchema& schema,
                                 const std::vector<ActionPoseSample>& samples,
                                 const Alignment& alignment) {
  std::map<int, Errors> errors;
  for (const int part : schema.parts) {
    const Eigen::VectorXd zero = Eigen::VectorXd::Zero(schema.signals.size());
    if (part != schema.root && schema.predict(schema.root, part, zero)) errors[part];
  }
  for (const ActionPoseSample& sample : samples) {
    check_signals(schema, sample);
    const PartObservation* root = sample.find(schema.root);
    if (!root || !root->has_rotation) continue;
    const std::map<int, Pose> predicted = schema.predict_all(sample.action);
    for (auto& [part, of_part] : errors) {
      const PartObservation* seen = sample.find(part);
      if (!seen) continue;
      const Pose error =
          alignment.aligned(part, predicted.at(part)).inverse() * root->X_CB.inverse() * seen->X_CB;
      of_part.position_m.push_back(error.translation().norm());
      if (seen->has_rotation && schema.has_rotation(part))
        of_part.rotation_rad.push_back(rotation_angle(error));
    }
  }
  std::vector<PartErrors> result;
  for (const auto& [part, of_part] : errors) {
    PartErrors summary;
    summary.part = part;
    summary.count = static_cast<int>(of_part.position_m.size());
    if (summary.count > 0) {
      summary.position_median_m = median(of_part.position_m);
      summary.position_rms_m = rms(of_part.position_m);
      summary.position_max_m =
          *std::max_element(of_part.position_m.begin(), of_part.position_m.end());
    }
    summary.has_rotation = summary.count == 0 || !of_part.rotation_rad.empty();
    if (!of_part.rotation_rad.empty()) {
      summary.rotation_median_rad = median(of_part.rotation_rad);
      summary.rotation_rms_rad = rms(of_part.rotation_rad);
    }
    result.push_back(summary);
  }
  return result;
}

}  // namespace bodyschema
