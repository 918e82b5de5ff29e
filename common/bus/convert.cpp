#include "common/bus/convert.h"

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>

#include "common/bus/triangle.h"

namespace bodyschema {
namespace {

/// Makes a covariance that rounding to float left nearly singular or indefinite invertible: raises
/// the eigenvalues of its correlations to several times the rounding error, so that the next
/// rounding leaves it unchanged. Other covariances, and rows with 0 on the diagonal, stay.
template <int Side>
Eigen::Matrix<double, Side, Side> invertible(const Eigen::Matrix<double, Side, Side>& covariance) {
  using Matrix = Eigen::Matrix<double, Side, Side>;
  if (covariance.diagonal().minCoeff() <= 0) return covariance;
  const Eigen::SelfAdjointEigenSolver<Matrix> solver(correlation_of(covariance));
  if (!(solver.eigenvalues()[0] < kTriangleRounding)) return covariance;
  const Eigen::Matrix<double, Side, 1> sd = covariance.diagonal().cwiseSqrt();
  const Matrix root = sd.asDiagonal() * solver.eigenvectors() *
                      solver.eigenvalues().cwiseMax(4 * kTriangleRounding).cwiseSqrt().asDiagonal();
  return root * root.transpose();
}

}  // namespace

pose_t to_message(const Pose& X_AB) {
  Eigen::Quaterniond q_AB(X_AB.linear());
  q_AB.normalize();
  // One sign for q and −q, so that equal poses make equal bytes.
  if (q_AB.w() < 0) q_AB.coeffs() = -q_AB.coeffs();
  pose_t message{};
  for (int i = 0; i < 3; ++i) message.position_m[i] = X_AB.translation()[i];
  message.rotation_wxyz[0] = q_AB.w();
  message.rotation_wxyz[1] = q_AB.x();
  message.rotation_wxyz[2] = q_AB.y();
  message.rotation_wxyz[3] = q_AB.z();
  return message;
}

Pose from_message(const pose_t& message) {
  const double* q = message.rotation_wxyz;
  return make_pose(
      Eigen::Quaterniond(q[0], q[1], q[2], q[3]),
      Eigen::Vector3d(message.position_m[0], message.position_m[1], message.position_m[2]));
}

void to_message(const Matrix6d& covariance, float (&message)[21]) {
  pack_triangle(covariance, message);
}

Matrix6d from_message(const float (&message)[21]) {
  return invertible(unpack_triangle<6>(message));
}

void to_message(const Matrix8d& covariance, float (&message)[36]) {
  pack_triangle(covariance, message);
}

Matrix8d from_message(const float (&message)[36]) {
  return invertible(unpack_triangle<8>(message));
}

namespace {

std::vector<PartObservation> from_messages(const std::vector<part_observation_t>& messages) {
  std::vector<PartObservation> observations;
  for (const part_observation_t& message : messages) {
    PartObservation& observation = observations.emplace_back();
    observation.part = message.part_id;
    observation.X_CB = from_message(message.X_CB);
    observation.has_rotation = message.has_rotation == 1;
    observation.covariance = from_message(message.covariance);
    if (message.has_other == 1) observation.X_CB_other = from_message(message.X_CB_other);
    observation.error_ratio = message.error_ratio;
    for (const tag_corners_t& tag : message.tags) observation.tags.push_back(tag.tag_id);
  }
  return observations;
}

std::vector<part_observation_t> to_messages(const std::vector<PartObservation>& observations) {
  std::vector<part_observation_t> messages;
  for (const PartObservation& observation : observations) {
    part_observation_t& part = messages.emplace_back();
    part.part_id = observation.part;
    part.X_CB = to_message(observation.X_CB);
    part.has_rotation = observation.has_rotation ? 1 : 0;
    to_message(observation.covariance, part.covariance);
    part.has_other = observation.X_CB_other ? 1 : 0;
    part.X_CB_other = to_message(observation.X_CB_other.value_or(observation.X_CB));
    part.error_ratio = observation.X_CB_other ? observation.error_ratio : 0;
    part.num_frames = 1;
    std::vector<tag_corners_t> tags;
    for (const int id : observation.tags) tags.emplace_back().tag_id = id;
    set_array(part.num_tags, part.tags, std::move(tags));
  }
  return messages;
}

}  // namespace

ActionPoseSample from_message(const sample_t& message) {
  ActionPoseSample sample;
  sample.utime = message.utime;
  sample.sample_index = message.sample_index;
  sample.purpose = static_cast<Purpose>(message.purpose);
  sample.action = Eigen::Map<const Eigen::VectorXd>(
      message.action.data(), static_cast<Eigen::Index>(message.action.size()));
  sample.calibration_id = message.calibration_id;
  sample.parts = from_messages(message.parts);
  sample.contradictions = from_messages(message.contradictions);
  return sample;
}

sample_t to_message(const ActionPoseSample& sample) {
  sample_t message{};
  message.utime = sample.utime;
  message.sample_index = sample.sample_index;
  message.calibration_id = sample.calibration_id;
  message.purpose = static_cast<std::int8_t>(sample.purpose);
  set_array(message.num_signals, message.action,
            std::vector<double>(sample.action.begin(), sample.action.end()));
  set_array(message.num_parts, message.parts, to_messages(sample.parts));
  set_array(message.num_contradictions, message.contradictions, to_messages(sample.contradictions));
  return message;
}

namespace {

static_assert(static_cast<int>(EdgeState::kOk) == schema_edge_t::EDGE_OK);
static_assert(static_cast<int>(EdgeState::kSuspect) == schema_edge_t::EDGE_SUSPECT);
static_assert(static_cast<int>(EdgeState::kInvalid) == schema_edge_t::EDGE_INVALID);
static_assert(static_cast<int>(EdgeState::kProvisional) == schema_edge_t::EDGE_PROVISIONAL);
static_assert(static_cast<int>(Unconnected::kNeverSeen) == unconnected_part_t::REASON_NEVER_SEEN);
static_assert(static_cast<int>(Unconnected::kNotEnoughData) ==
              unconnected_part_t::REASON_NOT_ENOUGH_DATA);
static_assert(static_cast<int>(Unconnected::kNoValidModel) ==
              unconnected_part_t::REASON_NO_VALID_MODEL);

// Columns one after the other, as Eigen keeps them.
std::vector<double> to_values(const Eigen::MatrixXd& matrix) {
  return {matrix.data(), matrix.data() + matrix.size()};
}

Eigen::MatrixXd to_matrix(const std::vector<double>& values, std::size_t num_rows,
                          std::size_t num_columns) {
  if (values.size() != num_rows * num_columns)
    throw std::invalid_argument("a Gaussian process does not go with its numbers of values");
  return Eigen::Map<const Eigen::MatrixXd>(values.data(), static_cast<Eigen::Index>(num_rows),
                                           static_cast<Eigen::Index>(num_columns));
}

residual_gp_t to_message(const ResidualGp& gp) {
  residual_gp_t message{};
  const ResidualGp::Prior& prior = gp.prior();
  message.gp_length_scales = to_values(prior.length_scales);
  set_array(message.num_gp_signals, message.gp_signals,
            std::vector<std::int32_t>(gp.signals().begin(), gp.signals().end()));
  std::copy(prior.variances.begin(), prior.variances.end(), message.gp_variances);
  std::copy(prior.noise_variances.begin(), prior.noise_variances.end(), message.gp_noise_variances);
  set_array(message.num_gp_samples, message.gp_noise_scales, to_values(gp.noise_scales()));
  set_array(message.num_gp_inputs, message.gp_inputs, to_values(gp.inputs()));
  set_array(message.num_gp_residuals, message.gp_residuals, to_values(gp.residuals()));
  return message;
}

std::shared_ptr<const ResidualGp> from_message(const residual_gp_t& message) {
  const std::size_t D = message.gp_signals.size(), N = message.gp_noise_scales.size();
  ResidualGp::Prior prior;
  prior.length_scales = to_matrix(message.gp_length_scales, D, 1);
  prior.variances = Eigen::Map<const Vector6d>(message.gp_variances);
  prior.noise_variances = Eigen::Map<const Vector6d>(message.gp_noise_variances);
  return std::make_shared<const ResidualGp>(
      std::vector<int>(message.gp_signals.begin(), message.gp_signals.end()),
      to_matrix(message.gp_inputs, D, N), to_matrix(message.gp_residuals, 6, N),
      to_matrix(message.gp_noise_scales, N, 1), std::move(prior));
}

matrix_gp_t to_message(const MatrixGp& gp) {
  if (gp.num_samples() > MatrixGp::kMaxSamples)
    throw std::invalid_argument("a matrix GP of " + std::to_string(gp.num_samples()) +
                                " samples cannot travel: a message holds " +
                                std::to_string(MatrixGp::kMaxSamples));
  matrix_gp_t message{};
  set_array(message.num_matrix_signals, message.matrix_signals,
            std::vector<std::int32_t>(gp.signals().begin(), gp.signals().end()));
  std::vector<double> lengths;
  for (int e = 0; e < MatrixGp::kNumEntries; ++e) {
    const GpPrior& prior = gp.prior(e);
    if (prior.mean || prior.kernel.terms().size() != 1)
      throw std::invalid_argument(
          "a matrix GP travels about unknown means, with one squared exponential an entry");
    const SquaredExponential& term = prior.kernel.terms().front();
    lengths.insert(lengths.end(), term.length_scales.begin(), term.length_scales.end());
    message.entry_variances[e] = term.variance;
    message.entry_noise_variances[e] = prior.noise_variance;
  }
  set_array(message.num_entry_lengths, message.entry_length_scales, std::move(lengths));
  std::vector<pose_t> poses;
  for (const Pose& z : gp.poses()) poses.push_back(bodyschema::to_message(z));
  set_array(message.num_matrix_poses, message.matrix_poses, std::move(poses));
  set_array(message.num_matrix_inputs, message.matrix_inputs, to_values(gp.inputs()));
  return message;
}

std::shared_ptr<const MatrixGp> from_message(const matrix_gp_t& message) {
  const std::size_t D = message.matrix_signals.size(), N = message.matrix_poses.size();
  const Eigen::MatrixXd lengths = to_matrix(message.entry_length_scales, D, MatrixGp::kNumEntries);
  std::vector<GpPrior> priors;
  for (int e = 0; e < MatrixGp::kNumEntries; ++e)
    priors.push_back({std::nullopt, SquaredExponential{message.entry_variances[e], lengths.col(e)},
                      message.entry_noise_variances[e]});
  std::vector<Pose> poses;
  for (const pose_t& z : message.matrix_poses) poses.push_back(bodyschema::from_message(z));
  return std::make_shared<const MatrixGp>(
      std::vector<int>(message.matrix_signals.begin(), message.matrix_signals.end()),
      to_matrix(message.matrix_inputs, D, N), std::move(poses), std::move(priors));
}

std::int8_t base_kind_of(const Edge& edge) {
  if (edge.matrix_gp) return schema_edge_t::EDGE_MATRIX_GP;
  if (edge.residual_gp) return schema_edge_t::EDGE_SCREW_GP;
  return edge.joints.empty() ? schema_edge_t::EDGE_RIGID : schema_edge_t::EDGE_SCREW;
}

schema_edge_t to_message(const Edge& edge) {
  schema_edge_t message{};
  message.from_part = edge.from;
  message.to_part = edge.to;
  message.base_kind = base_kind_of(edge);
  message.X_left = bodyschema::to_message(edge.left);
  std::vector<screw_joint_t> joints;
  for (const ScrewJoint& joint : edge.joints) {
    screw_joint_t& out = joints.emplace_back();
    out.signal_index = joint.signal;
    out.gain = joint.gain;
    out.offset = joint.offset;
    out.slide_m = joint.slide;
    out.turn_rad = joint.turn;
    out.order_group = joint.order_group;
    out.scatter = joint.scatter;
    out.X_after = bodyschema::to_message(joint.X_after);
  }
  set_array(message.num_joints, message.joints, std::move(joints));
  if (edge.residual_gp)
    set_array(message.num_residual_gp, message.residual_gp,
              std::vector{to_message(*edge.residual_gp)});
  if (edge.matrix_gp)
    set_array(message.num_matrix_gp, message.matrix_gp, std::vector{to_message(*edge.matrix_gp)});
  message.X_right = bodyschema::to_message(edge.right);
  const Eigen::MatrixXd& covariance = edge.parameter_covariance;
  const auto num_rows = static_cast<std::size_t>(covariance.rows());
  std::vector<float> packed(num_rows * (num_rows + 1) / 2);
  pack_triangle(covariance, packed);
  set_array(message.num_covariance, message.parameter_covariance, std::move(packed));
  message.position_rms_m = edge.position_rms_m;
  message.rotation_rms_rad = edge.rotation_rms_rad;
  message.num_samples_used = edge.num_samples;
  message.num_outliers = edge.num_outliers;
  message.valid_since_sample = edge.valid_since_sample;
  message.confidence = edge.confidence;
  message.state = static_cast<std::int8_t>(edge.state);
  return message;
}

Edge from_message(const schema_edge_t& message) {
  Edge edge;
  edge.from = message.from_part;
  edge.to = message.to_part;
  edge.left = bodyschema::from_message(message.X_left);
  for (const screw_joint_t& joint : message.joints) {
    ScrewJoint& out = edge.joints.emplace_back();
    out.signal = joint.signal_index;
    out.gain = joint.gain;
    out.offset = joint.offset;
    out.slide = joint.slide_m;
    out.turn = joint.turn_rad;
    out.order_group = joint.order_group;
    out.scatter = joint.scatter;
    out.X_after = bodyschema::from_message(joint.X_after);
  }
  if (!message.residual_gp.empty()) edge.residual_gp = from_message(message.residual_gp.front());
  if (!message.matrix_gp.empty()) edge.matrix_gp = from_message(message.matrix_gp.front());
  edge.right = bodyschema::from_message(message.X_right);
  if (!message.parameter_covariance.empty()) {
    const Eigen::Index side = edge.num_parameters();
    if (static_cast<Eigen::Index>(message.parameter_covariance.size()) != side * (side + 1) / 2) {
      throw std::invalid_argument("parameter_covariance does not go with the number of joints");
    }
    edge.parameter_covariance = unpack_triangle<Eigen::Dynamic>(message.parameter_covariance, side);
  }
  edge.position_rms_m = message.position_rms_m;
  edge.rotation_rms_rad = message.rotation_rms_rad;
  edge.num_samples = message.num_samples_used;
  edge.num_outliers = message.num_outliers;
  edge.valid_since_sample = message.valid_since_sample;
  edge.confidence = message.confidence;
  edge.state = static_cast<EdgeState>(message.state);
  return edge;
}

signal_t to_message(const Signal& signal) {
  signal_t message{};
  message.signal_name = signal.name;
  message.lower_limit = signal.lower;
  message.upper_limit = signal.upper;
  const Signal::Range covered = signal.known_range();
  message.covered_lower = std::clamp(covered.lower, signal.lower, signal.upper);
  message.covered_upper = std::clamp(covered.upper, signal.lower, signal.upper);
  set_array(message.num_warp, message.warp_weights, signal.warp);
  return message;
}

unconnected_part_t to_message(const UnconnectedPart& part) {
  unconnected_part_t message{};
  message.unconnected_part = part.part;
  message.reason = static_cast<std::int8_t>(part.reason);
  message.detail = part.detail;
  return message;
}

body_change_t to_message(const KnownChange& change) {
  body_change_t message{};
  message.found_sample = change.found;
  message.since_sample = change.since;
  return message;
}

moved_tag_t to_message(const MovedTag& tag) {
  moved_tag_t message{};
  message.moved_tag_id = tag.tag;
  message.moved_found_sample = tag.found;
  message.moved_since_sample = tag.since;
  message.moved_until_sample = tag.until;
  return message;
}

template <class T>
auto to_messages(const std::vector<T>& all) {
  std::vector<decltype(to_message(all[0]))> messages;
  for (const T& each : all) messages.push_back(to_message(each));
  return messages;
}

}  // namespace

body_schema_t to_message(const BodySchema& schema) {
  body_schema_t message{};
  message.utime = schema.utime;
  message.schema_version = schema.version;
  message.base_version = schema.base_version;
  message.last_sample_index = schema.last_sample_index;
  message.calibration_id = schema.calibration_id;
  message.num_samples_seen = schema.num_samples;
  message.is_complete = schema.complete ? 1 : 0;
  message.is_refined = schema.refined ? 1 : 0;
  set_array(message.num_parts, message.part_ids,
            std::vector<std::int32_t>(schema.parts.begin(), schema.parts.end()));
  set_array(message.num_position_parts, message.position_parts,
            std::vector<std::int32_t>(schema.position_parts.begin(), schema.position_parts.end()));
  message.root_part = schema.root;
  message.X_CR = to_message(schema.X_CR);
  to_message(schema.X_CR_covariance, message.X_CR_covariance);
  set_array(message.num_signals, message.signals, to_messages(schema.signals));
  set_array(message.num_edges, message.edges, to_messages(schema.edges));
  std::vector<part_frame_t> frames;
  for (const auto& [part, covariance] : schema.frame_covariances) {
    part_frame_t& out = frames.emplace_back();
    out.frame_part = part;
    to_message(covariance, out.frame_covariance);
  }
  set_array(message.num_frames, message.frames, std::move(frames));
  set_array(message.num_unconnected, message.unconnected, to_messages(schema.unconnected));
  set_array(
      message.num_undecided, message.undecided_signals,
      std::vector<std::int32_t>(schema.undecided_signals.begin(), schema.undecided_signals.end()));
  set_array(message.num_changes, message.changes, to_messages(schema.changes));
  set_array(message.num_moved_tags, message.moved_tags, to_messages(schema.moved_tags));
  message.noise_position_m = schema.noise.position_m;
  message.noise_rotation_rad = schema.noise.rotation_rad;
  return message;
}

BodySchema from_message(const body_schema_t& message) {
  BodySchema schema;
  schema.utime = message.utime;
  schema.version = message.schema_version;
  schema.base_version = message.base_version;
  schema.last_sample_index = message.last_sample_index;
  schema.calibration_id = message.calibration_id;
  schema.num_samples = message.num_samples_seen;
  schema.complete = message.is_complete == 1;
  schema.refined = message.is_refined == 1;
  schema.parts.assign(message.part_ids.begin(), message.part_ids.end());
  schema.position_parts.assign(message.position_parts.begin(), message.position_parts.end());
  schema.root = message.root_part;
  schema.X_CR = from_message(message.X_CR);
  schema.X_CR_covariance = from_message(message.X_CR_covariance);
  for (const signal_t& signal : message.signals) {
    schema.signals.push_back({signal.signal_name, signal.lower_limit, signal.upper_limit,
                              signal.warp_weights,
                              Signal::Range{signal.covered_lower, signal.covered_upper}});
  }
  for (const schema_edge_t& edge : message.edges) schema.edges.push_back(from_message(edge));
  for (const part_frame_t& frame : message.frames)
    schema.frame_covariances[frame.frame_part] = from_message(frame.frame_covariance);
  for (const unconnected_part_t& part : message.unconnected) {
    schema.unconnected.push_back(
        {part.unconnected_part, static_cast<Unconnected>(part.reason), part.detail});
  }
  schema.undecided_signals.assign(message.undecided_signals.begin(),
                                  message.undecided_signals.end());
  for (const body_change_t& change : message.changes)
    schema.changes.push_back({change.found_sample, change.since_sample});
  for (const moved_tag_t& tag : message.moved_tags)
    schema.moved_tags.push_back(
        {tag.moved_tag_id, tag.moved_found_sample, tag.moved_since_sample, tag.moved_until_sample});
  schema.noise = {message.noise_position_m, message.noise_rotation_rad};
  return schema;
}

}  // namespace bodyschema
