#include "processes/structure_learner/pair_data.h"

#include <cmath>
#include <stdexcept>

namespace bodyschema {
namespace {

// Against reading a marker by its second hypothesis: one in ten.
constexpr double kOtherHypothesisPenalty = 4.6;

// One reading of one marker: its pose and the covariance in its own frame.
struct MarkerReading {
  Pose X_CB;
  Matrix6d covariance;
  double penalty;
};

Matrix6d isotropic(const Noise& noise) {
  Vector6d variances;
  variances.head<3>().setConstant(noise.position_m * noise.position_m);
  variances.tail<3>().setConstant(noise.rotation_rad * noise.rotation_rad);
  return variances.asDiagonal();
}

int readings_of(const PartObservation& observation, const MeasurementModel& measurement,
                MarkerReading* readings) {
  const Matrix6d covariance =
      measurement.noise ? isotropic(*measurement.noise) : observation.covariance;
  readings[0] = {observation.X_CB, covariance, 0};
  if (!observation.X_CB_other || observation.error_ratio > measurement.max_error_ratio) return 1;
  // The position's covariance is a fact of the camera (depth is not lateral): carry it over into
  // the other frame. Tilt and in-plane rotation belong to the marker's axes in both readings.
  Matrix6d T = Matrix6d::Identity();
  T.topLeftCorner<3, 3>() =
      observation.X_CB_other->linear().transpose() * observation.X_CB.linear();
  readings[1] = {*observation.X_CB_other, T * covariance * T.transpose(), kOtherHypothesisPenalty};
  return 2;
}

}  // namespace

NormalizedActions::NormalizedActions(const std::vector<ActionPoseSample>& samples, int num_signals)
    : values_(num_signals, samples.size()),
      centre_(Eigen::VectorXd::Zero(num_signals)),
      half_range_(Eigen::VectorXd::Ones(num_signals)) {
  for (std::size_t t = 0; t < samples.size(); ++t) {
    if (samples[t].action.size() != num_signals)
      throw std::invalid_argument("sample " + std::to_string(samples[t].sample_index) + " has " +
                                  std::to_string(samples[t].action.size()) +
                                  " action values, not " + std::to_string(num_signals));
    values_.col(t) = samples[t].action;
  }
  if (samples.empty()) return;
  for (int s = 0; s < num_signals; ++s) {
    const double lower = values_.row(s).minCoeff();
    const double upper = values_.row(s).maxCoeff();
    centre_(s) = (lower + upper) / 2;
    // The rounding of a constant is not a motion.
    if (upper - lower > 1e-9 * std::max(std::abs(lower), std::abs(upper))) {
      half_range_(s) = (upper - lower) / 2;
      moving_.push_back(s);
    }
    values_.row(s).array() = (values_.row(s).array() - centre_(s)) / half_range_(s);
  }
  std::vector<std::int64_t> utimes;
  for (const ActionPoseSample& sample : samples) utimes.push_back(sample.utime);
  blocks_ = TimeBlocks(utimes, values_(moving_, Eigen::all));
}

int count_common(const std::vector<ActionPoseSample>& samples, int part_i, int part_j) {
  int count = 0;
  for (const ActionPoseSample& sample : samples)
    if (sample.find(part_i) && sample.find(part_j)) ++count;
  return count;
}

PairData make_pair_data(const std::vector<ActionPoseSample>& samples, int part_i, int part_j,
                        const MeasurementModel& measurement, int max_frames) {
  std::vector<int> common;
  for (std::size_t t = 0; t < samples.size(); ++t)
    if (samples[t].find(part_i) && samples[t].find(part_j)) common.push_back(static_cast<int>(t));

  PairData pair;
  pair.part_i = part_i;
  pair.part_j = part_j;
  const std::size_t num_frames = std::min<std::size_t>(common.size(), std::max(max_frames, 0));
  pair.frames.reserve(num_frames);
  pair.hypotheses.reserve(num_frames);
  // The last term keeps exact measurements factorisable.
  const Matrix6d extra = isotropic(measurement.model_error) + 1e-10 * Matrix6d::Identity();
  const double kLog2Pi = std::log(2 * M_PI);
  MarkerReading readings_i[2], readings_j[2];
  for (std::size_t n = 0; n < num_frames; ++n) {
    PairFrame frame;
    frame.sample = common[n * common.size() / num_frames];
    frame.first_hypothesis = static_cast<int>(pair.hypotheses.size());
    const ActionPoseSample& sample = samples[frame.sample];
    const int num_i = readings_of(*sample.find(part_i), measurement, readings_i);
    const int num_j = readings_of(*sample.find(part_j), measurement, readings_j);
    for (int a = 0; a < num_i; ++a) {
      for (int b = 0; b < num_j; ++b) {
        PairHypothesis h;
        h.z = readings_i[a].X_CB.inverse() * readings_j[b].X_CB;
        h.penalty = readings_i[a].penalty + readings_j[b].penalty;
        const Matrix6d covariance =
            relative_covariance(h.z, readings_i[a].covariance, readings_j[b].covariance) + extra;
        const Eigen::LLT<Matrix6d> llt(covariance);
        // A covariance that is not positive definite says nothing usable: leave the instant out.
        if (llt.info() != Eigen::Success || !(llt.matrixLLT().diagonal().minCoeff() > 0)) continue;
        h.whitening = llt.matrixL().solve(Matrix6d::Identity());
        h.log_det = 6 * kLog2Pi + 2 * llt.matrixLLT().diagonal().array().log().sum();
        pair.hypotheses.push_back(h);
      }
    }
    frame.num_hypotheses = static_cast<int>(pair.hypotheses.size()) - frame.first_hypothesis;
    if (frame.num_hypotheses > 0) pair.frames.push_back(frame);
  }
  return pair;
}

}  // namespace bodyschema
