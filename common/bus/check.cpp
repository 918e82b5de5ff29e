#include "common/bus/check.h"

#include <spdlog/fmt/fmt.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <initializer_list>
#include <set>
#include <string_view>
#include <utility>
#include <vector>

#include "common/bus/triangle.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kMaxParts = 10'000;
constexpr std::int64_t kMaxId = 1'000'000;
constexpr double kMaxReach_m = 1'000;
constexpr std::int64_t kMaxTags = 10'000;
/// One sample per millisecond for thirty years; arithmetic on indices does not overflow.
constexpr std::int64_t kMaxSampleIndex = 1'000'000'000'000;
constexpr std::int64_t kMaxSignals = 1'000;
constexpr std::int64_t kMaxChanges = 1'000;
constexpr std::int64_t kMaxJoints = 100;
constexpr std::int64_t kMaxGpSamples = 64;
/// Variances, length scales and weights of Gaussian processes: wide enough for any unit, and their
/// products stay within the range of doubles.
constexpr double kLeastHyperParameter = 1e-60;
constexpr double kLargestHyperParameter = 1e60;
constexpr std::int64_t kMaxGeoms = 100'000;
constexpr std::int64_t kMaxCounters = 10'000;
constexpr std::int64_t kMaxEvents = 32;
constexpr std::int64_t kMaxFindings = 64;
constexpr std::int64_t kMaxImageBytes = std::int64_t{1} << 28;
constexpr std::size_t kMaxName = 1'000;
constexpr std::size_t kMaxText = 1'000'000;
constexpr double kUnitTolerance = 1e-3;
/// parameter_covariance is float.
constexpr double kCorrelationTolerance = 1e-3;

/// Looks at one message field by field and keeps the first complaint.
class Checker {
 public:
  const std::string& problem() const { return problem_; }

  /// A complaint about `field` unless `holds`.
  void require(bool holds, const char* field, const char* what) {
    if (!holds) complain(field, what);
  }

  void finite(const char* field, double value) {
    if (!std::isfinite(value)) complain(field, fmt::format("is {}, not finite", value));
  }
  /// Finite and lower ≤ value ≤ upper.
  void within(const char* field, double value, double lower, double upper) {
    finite(field, value);
    if (value < lower || value > upper) {
      complain(field, fmt::format("is {}, outside {} … {}", value, lower, upper));
    }
  }
  void at_least(const char* field, double value, double lower) {
    finite(field, value);
    if (value < lower) complain(field, fmt::format("is {}, below {}", value, lower));
  }
  void positive(const char* field, double value) {
    finite(field, value);
    if (!(value > 0)) complain(field, fmt::format("is {}, not positive", value));
  }
  /// ≥ 0, or −1: not measured.
  void measured(const char* field, double value) {
    finite(field, value);
    if (value < 0 && value != -1) {
      complain(field, fmt::format("is {}, neither ≥ 0 nor −1", value));
    }
  }
  template <std::size_t N>
  void finite(const char* field, const double (&values)[N]) {
    for (const double value : values) finite(field, value);
  }
  template <std::size_t N, std::size_t M>
  void finite(const char* field, const double (&values)[N][M]) {
    for (const auto& row : values) finite(field, row);
  }

  void integer_at_least(const char* field, std::int64_t value, std::int64_t lower) {
    if (value < lower) complain(field, fmt::format("is {}, below {}", value, lower));
  }
  void integer_within(const char* field, std::int64_t value, std::int64_t lower,
                      std::int64_t upper) {
    if (value < lower || value > upper) {
      complain(field, fmt::format("is {}, outside {} … {}", value, lower, upper));
    }
  }
  void time(const char* field, std::int64_t utime) { integer_at_least(field, utime, 0); }
  void flag(const char* field, std::int8_t value) { integer_within(field, value, 0, 1); }
  /// A constant of a type whose constants count from 0 to `last`.
  void constant(const char* field, std::int8_t value, std::int8_t last) {
    if (value < 0 || value > last) {
      complain(field, fmt::format("is {}, no known constant", static_cast<int>(value)));
    }
  }
  void text(const char* field, const std::string& value, std::size_t longest) {
    if (value.size() > longest) {
      complain(field, fmt::format("has {} bytes, more than {}", value.size(), longest));
    } else if (!is_text(value)) {
      complain(field, "is not UTF-8 text without zero bytes");
    }
  }
  void name(const char* field, const std::string& value) {
    text(field, value, kMaxName);
    if (value.empty()) complain(field, "is empty");
  }

  /// The count of an array is its length and not beyond reason. False if it must not be visited.
  template <class Element>
  bool counted(const char* field, std::int64_t count, const std::vector<Element>& array,
               std::int64_t most) {
    if (count < 0 || count > most) {
      complain(field, fmt::format("has {} elements, outside 0 … {}", count, most));
    } else if (count != static_cast<std::int64_t>(array.size())) {
      complain(field, fmt::format("has {} elements but a count of {}", array.size(), count));
    }
    return problem_.empty();
  }
  template <class Number>
  void numbers(const char* field, std::int64_t count, const std::vector<Number>& array,
               std::int64_t most) {
    if (!counted(field, count, array, most)) return;
    for (const Number value : array) finite(field, value);
  }
  /// Calls `visit(element)`; complaints in there name the element.
  template <class Element, class Visit>
  void each(const char* field, std::int64_t count, const std::vector<Element>& array,
            std::int64_t most, Visit visit) {
    if (!counted(field, count, array, most)) return;
    for (std::size_t i = 0; i < array.size() && problem_.empty(); ++i) {
      path_.emplace_back(field, static_cast<std::int64_t>(i));
      visit(array[i]);
      path_.pop_back();
    }
  }
  /// Ids are ≥ 0 and ascend strictly, so that none repeats. `previous` starts at −1.
  void ascending(const char* field, std::int64_t id, std::int64_t& previous) {
    if (id < 0) {
      complain(field, fmt::format("is {}, below 0", id));
    } else if (id <= previous) {
      complain(field, fmt::format("is {} after {}: not ascending", id, previous));
    }
    previous = id;
  }

  void pose(const char* field, const pose_t& X) {
    path_.emplace_back(field, -1);
    finite("position_m", X.position_m);
    finite("rotation_wxyz", X.rotation_wxyz);
    const double* q = X.rotation_wxyz;
    const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (std::abs(norm - 1) > kUnitTolerance) {
      complain("rotation_wxyz", fmt::format("has norm {}, not 1", norm));
    }
    path_.pop_back();
  }

  /// Finite and positive semidefinite, up to rounding to float. `is_required`: with a positive
  /// diagonal.
  template <int Side, std::size_t N>
  void covariance(const char* field, const float (&triangle)[N], bool is_required) {
    static_assert(N == Side * (Side + 1) / 2);
    for (const float value : triangle) finite(field, double{value});
    if (!problem_.empty()) return;
    const Eigen::Matrix<double, Side, Side> covariance = unpack_triangle<Side>(triangle);
    const auto& variances = covariance.diagonal();
    if (variances.minCoeff() < 0 || (is_required && variances.minCoeff() == 0))
      return complain(field, fmt::format("has {} on its diagonal", variances.minCoeff()));
    for (int i = 0; i < Side; ++i) {
      if (variances[i] == 0 && !covariance.row(i).isZero(0))
        return complain(field, "is not positive semidefinite");
    }
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, Side, Side>> solver(
        correlation_of(covariance), Eigen::EigenvaluesOnly);
    // Written so that a NaN (from values near the ends of the range) fails as well.
    if (!(solver.eigenvalues()[0] >= -kTriangleRounding))
      complain(field, "is not positive semidefinite");
  }

  void complain(const char* field, const std::string& what) {
    if (!problem_.empty()) return;
    for (const auto& [name, index] : path_) {
      problem_ += name;
      if (index >= 0) problem_ += fmt::format("[{}]", index);
      problem_ += '.';
    }
    problem_ += fmt::format("{} {}", field, what);
  }

 private:
  std::string problem_;
  std::vector<std::pair<const char*, std::int64_t>> path_;
};

/// A GP that passes can be factorised again.
class GpChecker {
 public:
  explicit GpChecker(Checker& check) : check_(check) {}

  void signals(const char* field, std::int64_t count, const std::vector<std::int32_t>& array,
               std::int64_t least, const body_schema_t& schema) {
    if (!check_.counted(field, count, array, kMaxSignals)) return;
    check_.integer_at_least(field, count, least);
    for (const std::int32_t signal : array)
      check_.integer_within(field, signal, 0, schema.num_signals - 1);
  }
  void samples(const char* field, std::int64_t count) {
    check_.integer_within(field, count, 1, kMaxGpSamples);
  }
  template <class Values>
  void hyper_parameters(const char* field, const Values& values, double least) {
    for (const double value : values) check_.within(field, value, least, kLargestHyperParameter);
  }
  void values(const char* field, std::int64_t count, const std::vector<double>& array,
              std::int64_t expected, double largest = kLargestHyperParameter) {
    if (!check_.counted(field, count, array, expected)) return;
    check_.integer_at_least(field, count, expected);
    for (const double value : array) check_.within(field, value, -largest, largest);
  }

 private:
  Checker& check_;
};

void check_residual_gp(Checker& check, const residual_gp_t& gp, const body_schema_t& schema) {
  GpChecker gp_check(check);
  const std::int64_t D = gp.num_gp_signals, N = gp.num_gp_samples;
  gp_check.signals("gp_signals", D, gp.gp_signals, 1, schema);
  gp_check.samples("num_gp_samples", N);
  if (!check.problem().empty()) return;
  gp_check.values("gp_length_scales", D, gp.gp_length_scales, D);
  gp_check.values("gp_noise_scales", N, gp.gp_noise_scales, N);
  gp_check.values("gp_inputs", gp.num_gp_inputs, gp.gp_inputs, N * D);
  gp_check.values("gp_residuals", gp.num_gp_residuals, gp.gp_residuals, 6 * N, kMaxReach_m);
  gp_check.hyper_parameters("gp_length_scales", gp.gp_length_scales, kLeastHyperParameter);
  gp_check.hyper_parameters("gp_variances", gp.gp_variances, kLeastHyperParameter);
  gp_check.hyper_parameters("gp_noise_variances", gp.gp_noise_variances, kLeastHyperParameter);
  gp_check.hyper_parameters("gp_noise_scales", gp.gp_noise_scales, kLeastHyperParameter);
}

void check_matrix_gp(Checker& check, const matrix_gp_t& gp, const body_schema_t& schema) {
  GpChecker gp_check(check);
  const std::int64_t D = gp.num_matrix_signals, N = gp.num_matrix_poses;
  gp_check.signals("matrix_signals", D, gp.matrix_signals, 0, schema);
  gp_check.samples("num_matrix_poses", N);
  if (!check.problem().empty()) return;
  gp_check.values("entry_length_scales", gp.num_entry_lengths, gp.entry_length_scales, 12 * D);
  gp_check.values("matrix_inputs", gp.num_matrix_inputs, gp.matrix_inputs, N * D);
  gp_check.hyper_parameters("entry_length_scales", gp.entry_length_scales, kLeastHyperParameter);
  gp_check.hyper_parameters("entry_variances", gp.entry_variances, kLeastHyperParameter);
  gp_check.hyper_parameters("entry_noise_variances", gp.entry_noise_variances, 0);
  check.each("matrix_poses", N, gp.matrix_poses, kMaxGpSamples,
             [&](const pose_t& z) { check.pose("z", z); });
}

/// The covariance of a position alone has no rotation rows.
void check_rotation(Checker& check, const part_observation_t& part) {
  check.flag("has_rotation", part.has_rotation);
  check.covariance<6>("covariance", part.covariance, part.has_rotation == 1);
  if (part.has_rotation == 1 || !check.problem().empty()) return;
  const auto no_rotation = [&](const char* field, const pose_t& X) {
    const double* q = X.rotation_wxyz;
    check.require(q[0] == 1 && q[1] == 0 && q[2] == 0 && q[3] == 0, field,
                  "has a rotation, but has_rotation is 0");
  };
  no_rotation("X_CB", part.X_CB);
  no_rotation("X_CB_other", part.X_CB_other);
  const Eigen::Matrix<double, 6, 6> covariance = unpack_triangle<6>(part.covariance);
  check.require(covariance.bottomRows<3>().isZero(0), "covariance",
                "has rotation rows, but has_rotation is 0");
  check.require(covariance.diagonal().head<3>().minCoeff() > 0, "covariance",
                "has 0 on the position's diagonal");
  check.require(part.has_other == 0, "has_other", "is 1, but has_rotation is 0");
}

void check_edge(Checker& check, const schema_edge_t& edge, const body_schema_t& schema,
                const std::set<std::int32_t>& parts, std::set<std::int32_t>& placed) {
  check.require(parts.count(edge.from_part) == 1, "from_part", "is not in part_ids");
  check.require(parts.count(edge.to_part) == 1, "to_part", "is not in part_ids");
  check.require(edge.from_part != edge.to_part, "to_part", "is from_part");
  check.require(edge.to_part != schema.root_part, "to_part", "is the root");
  // Ordered from the root outwards: an edge leads to a part that no edge before it touched. So
  // there is no cycle, and one pass over the edges places every part.
  check.require(placed.count(edge.to_part) == 0, "to_part",
                "was reached before: the edges are no tree ordered from the root outwards");
  placed.insert(edge.from_part);
  placed.insert(edge.to_part);

  check.constant("base_kind", edge.base_kind, schema_edge_t::EDGE_MATRIX_GP);
  check.pose("X_left", edge.X_left);
  check.each("joints", edge.num_joints, edge.joints, kMaxJoints, [&](const screw_joint_t& joint) {
    check.integer_within("signal_index", joint.signal_index, 0, schema.num_signals - 1);
    check.finite("gain", joint.gain);
    check.finite("offset", joint.offset);
    check.finite("slide_m", joint.slide_m);
    check.finite("turn_rad", joint.turn_rad);
    check.integer_at_least("order_group", joint.order_group, -1);
    check.pose("X_after", joint.X_after);
  });
  const bool has_joints = edge.num_joints > 0;
  const bool may_have_joints =
      edge.base_kind == schema_edge_t::EDGE_SCREW || edge.base_kind == schema_edge_t::EDGE_SCREW_GP;
  check.require(has_joints ? may_have_joints : edge.base_kind != schema_edge_t::EDGE_SCREW,
                "base_kind", "does not go with num_joints");
  check.integer_within("num_residual_gp", edge.num_residual_gp,
                       edge.base_kind == schema_edge_t::EDGE_SCREW_GP,
                       edge.base_kind == schema_edge_t::EDGE_SCREW_GP);
  check.each("residual_gp", edge.num_residual_gp, edge.residual_gp, 1,
             [&](const residual_gp_t& gp) { check_residual_gp(check, gp, schema); });
  check.integer_within("num_matrix_gp", edge.num_matrix_gp,
                       edge.base_kind == schema_edge_t::EDGE_MATRIX_GP,
                       edge.base_kind == schema_edge_t::EDGE_MATRIX_GP);
  check.each("matrix_gp", edge.num_matrix_gp, edge.matrix_gp, 1,
             [&](const matrix_gp_t& gp) { check_matrix_gp(check, gp, schema); });
  check.pose("X_right", edge.X_right);

  const std::int64_t side = 6 + 8 * std::int64_t{edge.num_joints};
  check.numbers("parameter_covariance", edge.num_covariance, edge.parameter_covariance,
                side * (side + 1) / 2);
  if (!check.problem().empty()) return;
  if (edge.num_covariance != 0 && edge.num_covariance != side * (side + 1) / 2) {
    return check.complain(
        "num_covariance",
        fmt::format("is {}, neither 0 nor {}", edge.num_covariance, side * (side + 1) / 2));
  }
  // Positive semidefinite only up to pairs: the screw frames' gauge makes the matrix singular, and
  // in float its smallest eigenvalues are noise of either sign.
  const auto& packed = edge.parameter_covariance;
  const auto variance = [&](std::size_t i) { return double{packed[i * (i + 3) / 2]}; };
  for (std::size_t i = 0, k = 0; k < packed.size(); ++i) {
    check.require(variance(i) >= 0, "parameter_covariance", "has a negative variance");
    for (std::size_t j = 0; j <= i; ++j, ++k) {
      check.require(std::abs(packed[k]) <= (1 + kCorrelationTolerance) * std::sqrt(variance(i)) *
                                               std::sqrt(variance(j)),
                    "parameter_covariance", "is not positive semidefinite");
    }
  }

  check.at_least("position_rms_m", edge.position_rms_m, 0);
  check.at_least("rotation_rms_rad", edge.rotation_rms_rad, 0);
  check.integer_at_least("num_samples_used", edge.num_samples_used, 0);
  check.integer_within("num_outliers", edge.num_outliers, 0, edge.num_samples_used);
  check.integer_at_least("valid_since_sample", edge.valid_since_sample, 0);
  check.within("confidence", edge.confidence, 0, 1);
  check.constant("state", edge.state, schema_edge_t::EDGE_PROVISIONAL);
}

}  // namespace

std::string check(const action_command_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.name("source", message.source);
  check.time("epoch", message.epoch);
  check.integer_at_least("action_id", message.action_id, 0);
  check.constant("kind", message.kind, action_command_t::KIND_RESUME);
  check.constant("purpose", message.purpose, action_command_t::PURPOSE_CONTROL);
  check.time("expiry_utime", message.expiry_utime);
  check.numbers("action", message.num_signals, message.action, kMaxSignals);
  check.require((message.kind == action_command_t::KIND_MOVE) == (message.num_signals > 0),
                "num_signals", "does not go with kind: only KIND_MOVE has an action");
  return check.problem();
}

std::string check(const motion_status_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.text("source", message.source, kMaxName);
  check.time("epoch", message.epoch);
  check.integer_at_least("action_id", message.action_id, -1);
  check.constant("kind", message.kind, action_command_t::KIND_RESUME);
  check.constant("purpose", message.purpose, action_command_t::PURPOSE_CONTROL);
  check.constant("state", message.state, motion_status_t::STATE_HOLDING);
  check.text("reason", message.reason, kMaxText);
  check.integer_at_least("rest_since_utime", message.rest_since_utime, -1);
  check.flag("stop_latched", message.stop_latched);
  check.numbers("commanded", message.num_signals, message.commanded, kMaxSignals);
  return check.problem();
}

std::string check(const sim_state_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.integer_at_least("action_id", message.action_id, -1);
  check.flag("is_ideal", message.is_ideal);
  check.time("fault_epoch", message.fault_epoch);
  check.integer_at_least("fault_id", message.fault_id, -1);
  check.text("fault_answer", message.fault_answer, kMaxText);
  check.each("faults", message.num_faults, message.faults, kMaxGeoms,
             [&](const std::string& fault) { check.name("fault", fault); });
  check.pose("X_WC", message.X_WC);
  check.each("X_WG", message.num_geoms, message.X_WG, kMaxGeoms,
             [&](const pose_t& X_WG) { check.pose("pose", X_WG); });
  if (check.counted("geom_alpha", message.num_geoms, message.geom_alpha, kMaxGeoms)) {
    for (const float alpha : message.geom_alpha) check.within("geom_alpha", alpha, 0, 1);
  }
  if (check.counted("true_part", message.num_parts, message.true_part, kMaxParts)) {
    std::int64_t previous = -1;
    for (const std::int32_t part : message.true_part) check.ascending("true_part", part, previous);
  }
  check.each("X_WB", message.num_parts, message.X_WB, kMaxParts,
             [&](const pose_t& X_WB) { check.pose("pose", X_WB); });
  return check.problem();
}

std::string check(const camera_image_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.integer_at_least("image_seq", message.image_seq, 0);
  check.text("camera_name", message.camera_name, kMaxName);
  // AprilTag crashes on images below 32 px.
  check.integer_within("width", message.width, 32, 16'384);
  check.integer_within("height", message.height, 32, 16'384);
  check.constant("encoding", message.encoding, camera_image_t::ENCODING_PNG);
  check.counted("data", message.num_bytes, message.data, kMaxImageBytes);
  check.integer_at_least("num_bytes", message.num_bytes, 1);
  check.require(message.encoding != camera_image_t::ENCODING_GREY ||
                    message.num_bytes == std::int64_t{message.width} * message.height,
                "num_bytes", "is not width * height");
  return check.problem();
}

std::string check(const camera_info_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.text("camera_name", message.camera_name, kMaxName);
  check.integer_within("image_width", message.image_width, 32, 16'384);
  check.integer_within("image_height", message.image_height, 32, 16'384);
  check.positive("fx", message.fx);
  check.positive("fy", message.fy);
  check.finite("cx", message.cx);
  check.finite("cy", message.cy);
  check.constant("distortion_model", message.distortion_model, camera_info_t::MODEL_FISHEYE);
  check.numbers("distortion", message.num_coefficients, message.distortion, 8);
  const std::int32_t count = message.num_coefficients;
  const bool fits =
      count == 0 ||
      (message.distortion_model == camera_info_t::MODEL_PLUMB_BOB  ? count == 4 || count == 5
       : message.distortion_model == camera_info_t::MODEL_RATIONAL ? count == 8
                                                                   : count == 4);
  check.require(fits, "num_coefficients", "does not go with distortion_model");
  return check.problem();
}

std::string check(const marker_poses_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.integer_at_least("image_seq", message.image_seq, 0);
  check.text("camera_name", message.camera_name, kMaxName);
  std::int64_t previous = -1;
  check.each("markers", message.num_markers, message.markers, kMaxTags,
             [&](const marker_pose_t& marker) {
               check.ascending("marker_id", marker.marker_id, previous);
               check.positive("size_m", marker.size_m);
               check.finite("corner_px", marker.corner_px);
               check.covariance<8>("corner_covariance", marker.corner_covariance, true);
               check.integer_within("num_hypotheses", marker.num_hypotheses, 1, 2);
               check.pose("X_CM[0]", marker.X_CM[0]);
               check.pose("X_CM[1]", marker.X_CM[1]);
               check.at_least("reprojection_error_px", marker.reprojection_error_px[0], 0);
               check.at_least("reprojection_error_px", marker.reprojection_error_px[1], 0);
               check.require(marker.num_hypotheses == 1 ||
                                 marker.reprojection_error_px[0] <= marker.reprojection_error_px[1],
                             "reprojection_error_px", "is not ascending");
               check.covariance<6>("covariance", marker.covariance, true);
               check.finite("decision_margin", marker.decision_margin);
               check.integer_at_least("hamming", marker.hamming, 0);
             });
  return check.problem();
}

std::string check(const sample_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.integer_within("sample_index", message.sample_index, 0, kMaxSampleIndex);
  check.text("source", message.source, kMaxName);
  check.time("epoch", message.epoch);
  check.integer_at_least("action_id", message.action_id, -1);
  check.constant("purpose", message.purpose, action_command_t::PURPOSE_CONTROL);
  check.time("rest_begin_utime", message.rest_begin_utime);
  check.time("rest_end_utime", message.rest_end_utime);
  check.require(message.rest_begin_utime <= message.rest_end_utime, "rest_end_utime",
                "is before rest_begin_utime");
  check.numbers("action", message.num_signals, message.action, kMaxSignals);
  std::int64_t previous = -1;
  check.each(
      "parts", message.num_parts, message.parts, kMaxParts, [&](const part_observation_t& part) {
        check.ascending("part_id", part.part_id, previous);
        check.pose("X_CB", part.X_CB);
        check_rotation(check, part);
        check.flag("has_other", part.has_other);
        check.pose("X_CB_other", part.X_CB_other);
        check.finite("error_ratio", part.error_ratio);
        check.require(part.has_other == 1 ? part.error_ratio >= 1 : part.error_ratio == 0,
                      "error_ratio", "does not go with has_other");
        check.integer_at_least("num_frames", part.num_frames, 0);
        std::int64_t previous_tag = -1;
        check.each("tags", part.num_tags, part.tags, kMaxTags, [&](const tag_corners_t& tag) {
          check.ascending("tag_id", tag.tag_id, previous_tag);
          check.finite("mean_corner_px", tag.mean_corner_px);
          check.covariance<8>("corner_covariance", tag.corner_covariance, false);
        });
      });
  return check.problem();
}

std::string check(const body_schema_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.integer_at_least("schema_version", message.schema_version, 0);
  check.integer_at_least("base_version", message.base_version, 0);
  check.integer_at_least("last_sample_index", message.last_sample_index, -1);
  check.integer_at_least("num_samples_seen", message.num_samples_seen, 0);
  check.flag("is_complete", message.is_complete);
  std::set<std::int32_t> parts;
  if (check.counted("part_ids", message.num_parts, message.part_ids, kMaxParts)) {
    std::int64_t previous = -1;
    for (const std::int32_t part : message.part_ids) check.ascending("part_ids", part, previous);
    parts.insert(message.part_ids.begin(), message.part_ids.end());
  }
  check.require(parts.empty() ? message.root_part == -1 : parts.count(message.root_part) == 1,
                "root_part", "is not in part_ids (-1 where those are empty)");
  check.pose("X_CR", message.X_CR);
  check.covariance<6>("X_CR_covariance", message.X_CR_covariance, false);
  check.each("signals", message.num_signals, message.signals, kMaxSignals,
             [&](const signal_t& signal) {
               check.name("signal_name", signal.signal_name);
               check.finite("lower_limit", signal.lower_limit);
               check.finite("upper_limit", signal.upper_limit);
               check.require(signal.lower_limit <= signal.upper_limit, "upper_limit",
                             "is below lower_limit");
               check.numbers("warp_weights", signal.num_warp, signal.warp_weights, kMaxSignals);
             });
  std::set<std::int32_t> placed;
  check.each("edges", message.num_edges, message.edges, kMaxParts,
             [&](const schema_edge_t& edge) { check_edge(check, edge, message, parts, placed); });
  check.require(message.is_complete == 0 || message.num_edges == message.num_parts - 1,
                "is_complete", "is 1 but the edges do not span the parts");
  std::int64_t previous_frame = -1;
  check.each(
      "frames", message.num_frames, message.frames, kMaxParts, [&](const part_frame_t& frame) {
        check.ascending("frame_part", frame.frame_part, previous_frame);
        check.require(parts.count(frame.frame_part) == 1, "frame_part", "is not in part_ids");
        check.covariance<6>("frame_covariance", frame.frame_covariance, false);
      });
  std::set<std::int32_t> unconnected;
  check.each("unconnected", message.num_unconnected, message.unconnected, kMaxParts,
             [&](const unconnected_part_t& part) {
               check.integer_at_least("unconnected_part", part.unconnected_part, 0);
               check.require(unconnected.insert(part.unconnected_part).second, "unconnected_part",
                             "repeats");
               check.constant("reason", part.reason, unconnected_part_t::REASON_NO_VALID_MODEL);
               check.text("detail", part.detail, kMaxText);
             });
  if (check.counted("undecided_signals", message.num_undecided, message.undecided_signals,
                    kMaxSignals)) {
    std::int64_t previous = -1;
    for (const std::int32_t signal : message.undecided_signals) {
      check.ascending("undecided_signals", signal, previous);
      check.require(signal < message.num_signals, "undecided_signals", "is no index of signals");
    }
  }
  std::int64_t found = -1;
  check.each("changes", message.num_changes, message.changes, kMaxChanges,
             [&](const body_change_t& change) {
               check.ascending("found_sample", change.found_sample, found);
               check.integer_at_least("since_sample", change.since_sample, 0);
               check.require(change.since_sample <= change.found_sample, "since_sample",
                             "is after found_sample");
             });
  std::int64_t tag_found = -1;
  check.each("moved_tags", message.num_moved_tags, message.moved_tags, kMaxTags,
             [&](const moved_tag_t& tag) {
               check.integer_within("moved_tag_id", tag.moved_tag_id, 0, kMaxId);
               check.require(tag.moved_found_sample >= tag_found, "moved_found_sample", "descends");
               tag_found = tag.moved_found_sample;
               check.integer_at_least("moved_since_sample", tag.moved_since_sample, 0);
               check.require(tag.moved_since_sample <= tag.moved_found_sample, "moved_since_sample",
                             "is after moved_found_sample");
               check.require(
                   tag.moved_until_sample == -1 || tag.moved_until_sample > tag.moved_found_sample,
                   "moved_until_sample", "is not after moved_found_sample");
             });
  check.at_least("noise_position_m", message.noise_position_m, 0);
  check.at_least("noise_rotation_rad", message.noise_rotation_rad, 0);
  return check.problem();
}

std::string check(const model_health_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.integer_at_least("schema_version", message.schema_version, 0);
  check.integer_at_least("judged_sample", message.judged_sample, -1);
  check.flag("schema_complete", message.schema_complete);
  check.integer_at_least("num_test_samples", message.num_test_samples, 0);
  check.measured("worst_position_m", message.worst_position_m);
  check.measured("worst_rotation_rad", message.worst_rotation_rad);
  check.measured("noise_scale", message.noise_scale);
  check.integer_at_least("probe_sample", message.probe_sample, -1);
  check.numbers("probe_action", message.num_probe, message.probe_action, kMaxSignals);
  check.require(message.probe_sample < 0 || message.num_probe > 0, "probe_sample",
                "wants a probe without an action");
  check.each("edge_health", message.num_edges, message.edge_health, kMaxParts,
             [&](const edge_health_t& edge) {
               check.integer_at_least("health_from", edge.health_from, 0);
               check.integer_at_least("health_to", edge.health_to, 0);
               check.constant("edge_state", edge.edge_state, schema_edge_t::EDGE_PROVISIONAL);
               check.flag("edge_is_drifting", edge.edge_is_drifting);
               check.measured("edge_cusum", edge.edge_cusum);
               check.integer_at_least("num_tests", edge.num_tests, 0);
               check.measured("median_mahalanobis2", edge.median_mahalanobis2);
             });
  std::int64_t previous_part = -1;
  check.each("part_health", message.num_parts, message.part_health, kMaxParts,
             [&](const part_health_t& part) {
               check.ascending("health_part", part.health_part, previous_part);
               check.constant("part_state", part.part_state, schema_edge_t::EDGE_PROVISIONAL);
               check.flag("is_unseen", part.is_unseen);
               check.flag("is_flipping", part.is_flipping);
               check.measured("marker_cusum", part.marker_cusum);
               check.measured("camera_cusum", part.camera_cusum);
               check.integer_at_least("num_predicted", part.num_predicted, 0);
               check.within("visibility", part.visibility, 0, 1);
               check.measured("position_median_m", part.position_median_m);
               check.measured("rotation_median_rad", part.rotation_median_rad);
             });
  const auto check_size = [&](const change_size_t& size) {
    check.constant("size_kind", size.size_kind, change_size_t::SIZE_RATE);
    check.integer_within("size_signal", size.size_signal, -1, kMaxSignals - 1);
    const bool is_pose = size.size_kind >= change_size_t::SIZE_POSE;
    check.require(size.num_amounts == (size.size_kind == 0 ? 0
                                       : is_pose           ? 2
                                                           : 1),
                  "num_amounts", "does not fit size_kind");
    check.numbers("amount", size.num_amounts, size.amount, 2);
    check.each("amount_sd", size.num_amounts, size.amount_sd, 2,
               [&](double sd) { check.measured("amount_sd", sd); });
  };
  check.each("findings", message.num_findings, message.findings, kMaxFindings,
             [&](const finding_t& finding) {
               check.constant("finding_state", finding.finding_state, finding_t::FINDING_ASIDE);
               check.integer_within("finding_from", finding.finding_from, -1, kMaxId);
               check.integer_within("finding_to", finding.finding_to, -1, kMaxId);
               check.integer_within("finding_part", finding.finding_part, -1, kMaxId);
               check.integer_within("finding_tag", finding.finding_tag, -1, kMaxId);
               check.text("finding_cause", finding.finding_cause, kMaxText);
               check_size(finding.finding_size);
               check.integer_at_least("finding_since", finding.finding_since, 0);
               check.integer_at_least("finding_found", finding.finding_found, 0);
               check.integer_at_least("finding_adopted", finding.finding_adopted, -1);
               check.integer_at_least("num_confirming", finding.num_confirming, 0);
               check.text("finding_text", finding.finding_text, kMaxText);
             });
  std::int64_t previous_event = -1;
  check.each("events", message.num_events, message.events, kMaxEvents,
             [&](const health_event_t& event) {
               check.ascending("event_number", event.event_number, previous_event);
               check.time("utime", event.utime);
               check.integer_at_least("event_sample", event.event_sample, -1);
               check.constant("event_kind", event.event_kind, health_event_t::EVENT_PROBE_WANTED);
               check.integer_within("event_from", event.event_from, -1, kMaxId);
               check.integer_within("event_to", event.event_to, -1, kMaxId);
               check.integer_within("event_part", event.event_part, -1, kMaxId);
               check.integer_within("event_tag", event.event_tag, -1, kMaxId);
               check.text("event_cause", event.event_cause, kMaxText);
               check.integer_at_least("event_since", event.event_since, -1);
               check_size(event.event_size);
               check.finite("event_margin", event.event_margin);
               check.integer_at_least("samples_used", event.samples_used, 0);
               check.text("event_text", event.event_text, kMaxText);
             });
  return check.problem();
}

std::string check(const sample_request_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.name("process_name", message.process_name);
  check.integer_at_least("first_missing", message.first_missing, 0);
  check.integer_at_least("last_missing", message.last_missing, message.first_missing);
  return check.problem();
}

std::string check(const pose_target_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.name("sender", message.sender);
  check.time("epoch", message.epoch);
  check.integer_at_least("target_id", message.target_id, 0);
  check.constant("target_kind", message.target_kind, pose_target_t::KIND_RELEASE);
  const bool has_position = message.target_kind == pose_target_t::KIND_POSITION;
  check.integer_within("target_part", message.target_part, has_position ? 0 : -1,
                       has_position ? kMaxId : -1);
  for (const double coordinate : message.position_m) {
    check.within("position_m", coordinate, -kMaxReach_m, kMaxReach_m);
  }
  check.finite("keep_s", message.keep_s);
  check.require(message.keep_s >= 0 || message.keep_s == -1, "keep_s", "is neither ≥ 0 nor −1");
  return check.problem();
}

std::string check(const control_status_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.text("sender", message.sender, kMaxName);
  check.time("target_epoch", message.target_epoch);
  check.integer_at_least("target_id", message.target_id, -1);
  check.constant("control_state", message.control_state, control_status_t::CONTROL_RELEASED);
  check.flag("owns_arm", message.owns_arm);
  check.text("why", message.why, kMaxText);
  check.integer_at_least("schema_version", message.schema_version, -1);
  check.integer_at_least("target_part", message.target_part, -1);
  check.finite("target_position_m", message.target_position_m);
  check.measured("predicted_error_m", message.predicted_error_m);
  check.measured("observed_error_m", message.observed_error_m);
  check.integer_at_least("num_moves", message.num_moves, 0);
  return check.problem();
}

std::string check(const fault_command_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.name("sender", message.sender);
  check.time("epoch", message.epoch);
  check.integer_at_least("fault_id", message.fault_id, 0);
  check.constant("fault", message.fault, fault_command_t::FAULT_REPAIR);
  check.text("place", message.place, kMaxName);
  check.integer_at_least("number", message.number, -1);
  check.within("amount_deg", message.amount_deg, -180, 180);
  return check.problem();
}

std::string check(const process_info_t& message) {
  Checker check;
  check.time("utime", message.utime);
  check.name("process_name", message.process_name);
  check.text("host", message.host, kMaxName);
  check.integer_at_least("pid", message.pid, 1);
  check.time("start_utime", message.start_utime);
  check.text("program_version", message.program_version, kMaxName);
  check.integer_at_least("seed", message.seed, -1);
  check.constant("phase", message.phase, process_info_t::PHASE_ENDED);
  check.text("activity", message.activity, kMaxText);
  check.text("configuration", message.configuration, kMaxText);
  check.integer_at_least("cpu_us", message.cpu_us, 0);
  check.integer_at_least("resident_bytes", message.resident_bytes, 0);
  const std::string* previous = nullptr;
  check.each("counters", message.num_counters, message.counters, kMaxCounters,
             [&](const counter_t& counter) {
               check.name("counter_name", counter.counter_name);
               check.require(previous == nullptr || *previous < counter.counter_name,
                             "counter_name", "is not ascending");
               previous = &counter.counter_name;
               check.integer_at_least("count", counter.count, 0);
             });
  return check.problem();
}

}  // namespace bodyschema
