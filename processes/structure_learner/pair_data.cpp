#include "processes/structure_learner/pair_data.h"

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <map>
#include <optional>
#include <set>
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

// Covariance of R_iᵀ (p_j − p_i) in the frame of i, of a pose i and a position j in camera axes.
Matrix6d position_covariance(const Pose& X_Ci, const Eigen::Vector3d& p_ij, const Matrix6d& of_pose,
                             const Matrix6d& of_position) {
  Eigen::Matrix<double, 3, 6> J;
  J << -Eigen::Matrix3d::Identity(), skew(p_ij);
  Matrix6d result = Matrix6d::Zero();
  result.topLeftCorner<3, 3>() =
      J * of_pose * J.transpose() +
      X_Ci.linear().transpose() * of_position.topLeftCorner<3, 3>() * X_Ci.linear();
  return result;
}

int readings_of(const PartObservation& observation, const MeasurementModel& measurement,
                MarkerReading* readings) {
  const Matrix6d covariance = measurement.noise_covariance(observation);
  readings[0] = {observation.X_CB, covariance, 0};
  if (!observation.X_CB_other || observation.error_ratio > measurement.max_error_ratio) return 1;
  readings[1] = {*observation.X_CB_other, covariance_of_other(observation, covariance),
                 kOtherHypothesisPenalty};
  return 2;
}

// Visits at most `max_frames` of the samples that show all of `parts`, evenly chosen.
template <typename Visitor>
void for_thinned(const std::vector<ActionPoseSample>& samples, int max_frames,
                 std::initializer_list<int> parts, Visitor&& visit) {
  std::vector<int> common;
  for (std::size_t t = 0; t < samples.size(); ++t)
    if (std::all_of(parts.begin(), parts.end(), [&](int p) { return samples[t].find(p); }))
      common.push_back(static_cast<int>(t));
  const std::size_t count = std::min<std::size_t>(common.size(), std::max(max_frames, 0));
  for (std::size_t n = 0; n < count; ++n) visit(common[n * common.size() / count]);
}

// Collects the readings of one instant.
class FrameWriter {
 public:
  FrameWriter(int sample, PairData* pair, int tag_set = 0) : pair_(*pair) {
    frame_.sample = sample;
    frame_.tag_set = tag_set;
    frame_.first_hypothesis = static_cast<int>(pair_.hypotheses.size());
  }
  FrameWriter(const FrameWriter&) = delete;
  ~FrameWriter() {
    frame_.num_hypotheses = static_cast<int>(pair_.hypotheses.size()) - frame_.first_hypothesis;
    if (frame_.num_hypotheses > 0) pair_.frames.push_back(frame_);
  }

  void add(const Pose& z, const Matrix6d& noise, const Matrix6d& systematic, double penalty,
           bool has_rotation) {
    Matrix6d sum = noise + systematic;
    if (!has_rotation) sum.bottomRightCorner<3, 3>().setIdentity();
    const Eigen::LLT<Matrix6d> llt(sum);
    // A covariance that is not positive definite says nothing usable: leave the reading out.
    if (llt.info() != Eigen::Success || !(llt.matrixLLT().diagonal().minCoeff() > 0)) return;
    PairHypothesis h;
    h.z = z;
    h.num_residuals = has_rotation ? 6 : 3;
    h.penalty = penalty;
    h.whitening = llt.matrixL().solve(Matrix6d::Identity());
    h.log_det =
        h.num_residuals * std::log(2 * M_PI) + 2 * llt.matrixLLT().diagonal().array().log().sum();
    h.systematic = (h.whitening * systematic * h.whitening.transpose()).trace();
    pair_.hypotheses.push_back(h);
  }

 private:
  PairData& pair_;
  PairFrame frame_;
};

}  // namespace

Vector6d PairHypothesis::error(const Pose& inverse) const {
  if (num_residuals == 6) return log(inverse * z);
  Vector6d error = Vector6d::Zero();
  error.head<3>() = inverse * z.translation();
  return error;
}

Vector6d PairHypothesis::whitened(const Vector6d& error, const Pose& prediction) const {
  if (num_residuals == 6) return whitening * error;
  Vector6d result = Vector6d::Zero();
  result.head<3>() = whitening.topLeftCorner<3, 3>() * (prediction.linear() * error.head<3>());
  return result;
}

// log((Δ̂ exp δ)⁻¹ z) = r − J_l⁻¹(r) δ + O(δ²); Δ̂ exp δ has its origin at Δ̂ δ_translation.
Matrix6d PairHypothesis::residual_jacobian(const Vector6d& error, const Pose& prediction) const {
  if (num_residuals == 6) return -whitening * right_jacobian_inverse(-error);
  Matrix6d result = Matrix6d::Zero();
  result.topLeftCorner<3, 3>() = -whitening.topLeftCorner<3, 3>() * prediction.linear();
  return result;
}

std::optional<double> usual_value(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const std::size_t half = values.size() / 2;
  for (std::size_t first = 0; first + half < values.size(); ++first)
    if (values[first + half] - values[first] <= kResting) return values[first + half / 2];
  return std::nullopt;
}

bool is_jitter(double lower, double upper, double farthest) {
  // Held joints of a KUKA iiwa had 10⁻⁶ to 2.4 · 10⁻⁴ of the farthest, which moved by a radian.
  constexpr double kOfTheFarthest = 3e-4, kSmall = 1e-3, kOfTheValue = 1e-2;
  const double range = upper - lower;
  return range <= kOfTheFarthest * farthest &&
         (range < kSmall || range < kOfTheValue * std::abs(upper + lower) / 2);
}

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
  if (samples.empty() || num_signals == 0) return;
  const double farthest = (values_.rowwise().maxCoeff() - values_.rowwise().minCoeff()).maxCoeff();
  for (int s = 0; s < num_signals; ++s) {
    const double lower = values_.row(s).minCoeff();
    const double upper = values_.row(s).maxCoeff();
    centre_(s) = (lower + upper) / 2;
    // The rounding of a constant is not a motion.
    const double rounding = 1e-9 * std::max(std::abs(lower), std::abs(upper));
    if (upper - lower > rounding && !is_jitter(lower, upper, farthest)) {
      half_range_(s) = (upper - lower) / 2;
      moving_.push_back(s);
    }
    values_.row(s).array() = (values_.row(s).array() - centre_(s)) / half_range_(s);
  }
  std::vector<std::int64_t> utimes;
  for (const ActionPoseSample& sample : samples) utimes.push_back(sample.utime);
  blocks_ = TimeBlocks(utimes, moving_values());
}

double NormalizedActions::correlation(int a, int b) const {
  const Eigen::ArrayXd x = values_.row(a).array() - values_.row(a).mean();
  const Eigen::ArrayXd y = values_.row(b).array() - values_.row(b).mean();
  return (x * y).sum() / std::sqrt(x.square().sum() * y.square().sum());
}

NormalizedActions NormalizedActions::reordered(const std::vector<int>& order) const {
  NormalizedActions result = *this;
  result.values_ = values_(Eigen::all, order).eval();
  return result;
}

std::vector<int> seen_parts(const std::vector<ActionPoseSample>& samples) {
  std::set<int> parts;
  for (const ActionPoseSample& sample : samples)
    for (const PartObservation& o : sample.parts) parts.insert(o.part);
  return {parts.begin(), parts.end()};
}

std::vector<int> parts_without_rotation(const std::vector<ActionPoseSample>& samples) {
  std::map<int, int> majority;  // positions alone over poses
  for (const ActionPoseSample& sample : samples)
    for (const PartObservation& o : sample.parts) majority[o.part] += o.has_rotation ? -1 : 1;
  std::vector<int> parts;
  for (const auto& [part, more] : majority)
    if (more > 0) parts.push_back(part);
  return parts;
}

std::vector<ActionPoseSample> with_uniform_parts(std::vector<ActionPoseSample> samples,
                                                 const std::vector<int>& alone) {
  const auto is_alone = [&](int part) {
    return std::binary_search(alone.begin(), alone.end(), part);
  };
  for (ActionPoseSample& sample : samples)
    for (auto* observations : {&sample.parts, &sample.contradictions})
      std::erase_if(*observations,
                    [&](const PartObservation& o) { return o.has_rotation == is_alone(o.part); });
  return samples;
}

int count_common(const std::vector<ActionPoseSample>& samples, int part_i, int part_j) {
  int count = 0;
  for (const ActionPoseSample& sample : samples)
    if (sample.find(part_i) && sample.find(part_j)) ++count;
  return count;
}

PairData make_pair_data(const std::vector<ActionPoseSample>& samples, int part_i, int part_j,
                        const MeasurementModel& measurement, int max_frames) {
  PairData pair;
  pair.part_i = part_i;
  pair.part_j = part_j;
  const Matrix6d systematic = measurement.systematic_covariance();
  MarkerReading readings_i[2], readings_j[2];
  for_thinned(samples, max_frames, {part_i, part_j}, [&](int sample) {
    const PartObservation& seen_i = *samples[sample].find(part_i);
    const PartObservation& seen_j = *samples[sample].find(part_j);
    if (!seen_i.has_rotation) return;
    const int num_i = readings_of(seen_i, measurement, readings_i);
    const int num_j = readings_of(seen_j, measurement, readings_j);
    FrameWriter frame(sample, &pair);
    for (int a = 0; a < num_i; ++a) {
      for (int b = 0; b < num_j; ++b) {
        Pose z = readings_i[a].X_CB.inverse() * readings_j[b].X_CB;
        const double penalty = readings_i[a].penalty + readings_j[b].penalty;
        if (!seen_j.has_rotation) {
          z.linear().setIdentity();
          const auto covariance = [&](const Matrix6d& of_i, const Matrix6d& of_j) {
            return position_covariance(readings_i[a].X_CB, z.translation(), of_i, of_j);
          };
          frame.add(z, covariance(readings_i[a].covariance, readings_j[b].covariance),
                    covariance(systematic, systematic), penalty, false);
          continue;
        }
        frame.add(z, relative_covariance(z, readings_i[a].covariance, readings_j[b].covariance),
                  relative_covariance(z, systematic, systematic), penalty, true);
      }
    }
  });
  return pair;
}

PairData make_part_data(const std::vector<ActionPoseSample>& samples, int part,
                        const MeasurementModel& measurement, int max_frames) {
  PairData pair;
  pair.part_i = pair.part_j = part;
  const Matrix6d systematic = measurement.systematic_covariance();
  MarkerReading readings[2];
  std::map<std::vector<int>, int> tag_sets;
  for_thinned(samples, max_frames, {part}, [&](int sample) {
    const PartObservation& seen = *samples[sample].find(part);
    const int num = readings_of(seen, measurement, readings);
    const auto [tags, is_new] = tag_sets.try_emplace(seen.tags, static_cast<int>(tag_sets.size()));
    if (is_new) pair.tag_sets.push_back(seen.tags);
    FrameWriter frame(sample, &pair, tags->second);
    for (int a = 0; a < num; ++a)
      frame.add(readings[a].X_CB, readings[a].covariance,
                seen.has_rotation ? systematic : without_rotation(systematic), readings[a].penalty,
                seen.has_rotation);
  });
  return pair;
}

}  // namespace bodyschema
