#include "common/bus/check.h"

#include <spdlog/fmt/fmt.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <set>
#include <span>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

#include "bodyschema/message_fields.h"
#include "common/bus/triangle.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

constexpr double kUnitTolerance = 1e-3;
/// parameter_covariance is float.
constexpr double kCorrelationTolerance = 1e-3;

// Problem of a value of that kind; "" if there is none.

template <class Number>
[[gnu::noinline]] std::string range_problem(Number value, const Range& range) {
  if (!std::isfinite(static_cast<double>(value))) return fmt::format("is {}, not finite", value);
  return std::isinf(range.upper)
             ? fmt::format("is {}, below {}", +value, range.lower)
             : fmt::format("is {}, outside {} … {}", +value, range.lower, range.upper);
}

template <class Number>
requires std::is_arithmetic_v<Number> std::string problem_of(Number value, const Range& range) {
  const auto number = static_cast<double>(value);
  const bool is_good = number >= range.lower && number <= range.upper && std::isfinite(number);
  return is_good ? std::string() : range_problem(value, range);
}

std::string problem_of(double value, Positive) {
  return value <= 0 ? fmt::format("is {}, not positive", value) : problem_of(value, Any{});
}

std::string problem_of(double value, Measured) {
  return value < 0 && value != -1 ? fmt::format("is {}, neither ≥ 0 nor −1", value)
                                  : problem_of(value, Any{});
}

std::string problem_of(std::int8_t value, Constant kind) {
  if (value >= 0 && value <= kind.last) return {};
  return fmt::format("is {}, no known constant", +value);
}

std::string problem_of(const std::string& value, const Range& bytes) {
  const auto size = static_cast<double>(value.size());
  if (size > bytes.upper) return fmt::format("has {} bytes, more than {}", size, bytes.upper);
  if (!is_text(value)) return "is not UTF-8 text without zero bytes";
  return size < bytes.lower ? "is empty" : "";
}

std::string problem_of(const double (&q)[4], Quaternion) {
  const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  // Written so that a NaN fails as well.
  if (std::abs(norm - 1) <= kUnitTolerance) return {};
  return fmt::format("has norm {}, not 1", norm);
}

template <std::size_t N>
std::string problem_of(const float (&triangle)[N], Covariance) {
  constexpr int kSide = N == 21 ? 6 : 8;
  static_assert(N == kSide * (kSide + 1) / 2);
  for (const float value : triangle)
    if (!std::isfinite(value)) return problem_of(value, Any{});
  const Eigen::Matrix<double, kSide, kSide> covariance = unpack_triangle<kSide>(triangle);
  const auto& variances = covariance.diagonal();
  if (variances.minCoeff() < 0) return fmt::format("has {} on its diagonal", variances.minCoeff());
  for (int i = 0; i < kSide; ++i)
    if (variances[i] == 0 && !covariance.row(i).isZero(0)) return "is not positive semidefinite";
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, kSide, kSide>> solver(
      correlation_of(covariance), Eigen::EigenvaluesOnly);
  // Written so that a NaN (from values near the ends of the range) fails as well.
  return solver.eigenvalues()[0] >= -kTriangleRounding ? "" : "is not positive semidefinite";
}

/// Visitor of describe() that keeps the first complaint about a message.
class Checker {
 public:
  const std::string& problem() const { return problem_; }

  /// The fields of the message and, if they are good, the conditions on several of them.
  template <class Message>
  void check(const Message& message) {
    describe(*this, message);
    if constexpr (requires { check_together(*this, message); }) {
      if (problem_.empty()) check_together(*this, message);
    }
  }

  /// Inline, because a call would cost more than what most kinds compare.
  template <class Value, class Kind>
  [[gnu::always_inline]] void operator()(const char* field, const Value& value, const Kind& kind) {
    if constexpr (std::is_same_v<Kind, Ascending>) {
      ascending(field, value);
    } else if constexpr (requires { problem_of(value, kind); }) {
      const std::string problem = problem_of(value, kind);
      if (!problem.empty()) complain(field, problem);
    } else {
      for (const auto& element : value) (*this)(field, element, kind);
    }
  }
  template <class Message>
  void operator()(const char* field, const Message& message) {
    if constexpr (std::is_array_v<Message>) {
      each(field, message, [&](const auto& element) { check(element); });
    } else {
      path_.push_back({field, -1});
      check(message);
      path_.pop_back();
    }
  }
  template <class Element, class Kind>
  void array(const char* field, std::int64_t count, const std::vector<Element>& elements,
             const Kind& kind) {
    if (!is_counted(field, count, std::ssize(elements))) return;
    if constexpr (std::is_same_v<Element, std::uint8_t>) return;  // every byte makes sense
    const std::int64_t outer_id = std::exchange(previous_id_, -1);
    for (const Element& element : elements) (*this)(field, element, kind);
    previous_id_ = outer_id;
  }
  template <class Message>
  void array(const char* field, std::int64_t count, const std::vector<Message>& messages) {
    if (is_counted(field, count, std::ssize(messages)))
      each(field, messages, [&](const Message& message) { check(message); });
  }

  /// Calls visit(message) for the messages of an array; complaints in there name the message.
  template <class Messages, class Visit>
  void each(const char* field, const Messages& messages, Visit visit) {
    const std::int64_t outer_id = std::exchange(previous_id_, -1);
    path_.push_back({field, 0});
    for (const auto& message : messages) {
      if (!problem_.empty()) break;
      visit(message);
      ++path_.back().index;
    }
    path_.pop_back();
    previous_id_ = outer_id;
  }

  /// A complaint about `field` unless `holds`.
  void require(bool holds, const char* field, const char* what) {
    if (!holds) complain(field, what);
  }
  void require_count(const char* field, std::int64_t count, std::int64_t expected) {
    if (count != expected) complain(field, fmt::format("has {} elements, not {}", count, expected));
  }

 private:
  struct Step {
    const char* field;
    std::int64_t index;  ///< −1: not in an array
  };

  /// False if the array must not be visited.
  bool is_counted(const char* field, std::int64_t count, std::int64_t size) {
    if (count != size)
      complain(field, fmt::format("has {} elements but a count of {}", size, count));
    return problem_.empty();
  }

  void ascending(const char* field, std::int64_t id) {
    if (id < 0) complain(field, fmt::format("is {}, below 0", id));
    if (id <= previous_id_)
      complain(field, fmt::format("is {} after {}: not ascending", id, previous_id_));
    previous_id_ = id;
  }

  [[gnu::noinline]] void complain(const char* field, std::string_view what) {
    if (!problem_.empty()) return;
    for (const auto& [name, index] : path_)
      problem_ += index < 0 ? fmt::format("{}.", name) : fmt::format("{}[{}].", name, index);
    problem_ += fmt::format("{} {}", field, what);
  }

  std::string problem_;
  std::vector<Step> path_;
  std::int64_t previous_id_ = -1;
};

// Conditions on several fields of a message, each of which is good by itself.

void check_together(Checker& check, const action_command_t& m) {
  check.require((m.kind == action_command_t::KIND_MOVE) == (m.num_signals > 0), "num_signals",
                "does not go with kind: only KIND_MOVE has an action");
}

void check_together(Checker& check, const camera_image_t& m) {
  check.require(m.encoding != camera_image_t::ENCODING_GREY ||
                    m.num_bytes == std::int64_t{m.width} * m.height,
                "num_bytes", "is not width * height");
}

void check_together(Checker& check, const camera_info_t& m) {
  const std::int32_t count = m.num_coefficients;
  const bool fits = m.distortion_model == camera_info_t::MODEL_PLUMB_BOB  ? count == 4 || count == 5
                    : m.distortion_model == camera_info_t::MODEL_RATIONAL ? count == 8
                                                                          : count == 4;
  check.require(count == 0 || fits, "num_coefficients", "does not go with distortion_model");
}

template <int Side>
void require_variances(Checker& check, const char* field, std::span<const float> triangle) {
  check.require(unpack_triangle<Side>(triangle).diagonal().minCoeff() > 0, field,
                "has 0 on its diagonal");
}

void check_together(Checker& check, const marker_pose_t& m) {
  require_variances<8>(check, "corner_covariance", m.corner_covariance);
  require_variances<6>(check, "covariance", m.covariance);
  check.require(m.num_hypotheses == 1 || m.reprojection_error_px[0] <= m.reprojection_error_px[1],
                "reprojection_error_px", "is not ascending");
}

/// The pose of a position alone has no rotation, its covariance no rotation rows.
void check_position_alone(Checker& check, const part_observation_t& m) {
  const auto is_identity = [](const double(&q)[4]) {
    return q[0] == 1 && q[1] == 0 && q[2] == 0 && q[3] == 0;
  };
  constexpr const char* kRotated = "has a rotation, but has_rotation is 0";
  check.require(is_identity(m.X_CB.rotation_wxyz), "X_CB", kRotated);
  check.require(is_identity(m.X_CB_other.rotation_wxyz), "X_CB_other", kRotated);
  const Eigen::Matrix<double, 6, 6> covariance = unpack_triangle<6>(m.covariance);
  check.require(covariance.bottomRows<3>().isZero(0), "covariance",
                "has rotation rows, but has_rotation is 0");
  check.require(covariance.diagonal().head<3>().minCoeff() > 0, "covariance",
                "has 0 on the position's diagonal");
  check.require(m.has_other == 0, "has_other", "is 1, but has_rotation is 0");
}

void check_together(Checker& check, const part_observation_t& m) {
  check.require(m.has_other == 1 ? m.error_ratio >= 1 : m.error_ratio == 0, "error_ratio",
                "does not go with has_other");
  if (m.has_rotation == 0) return check_position_alone(check, m);
  require_variances<6>(check, "covariance", m.covariance);
}

void check_together(Checker& check, const sample_t& m) {
  check.require(m.rest_begin_utime <= m.rest_end_utime, "rest_end_utime",
                "is before rest_begin_utime");
  std::map<std::int32_t, std::set<std::int32_t>> tags_of;
  std::int32_t previous = -1;
  check.each("parts", m.parts, [&](const part_observation_t& part) {
    check.require(part.part_id > std::exchange(previous, part.part_id), "part_id",
                  "is not ascending");
    for (const tag_corners_t& tag : part.tags) tags_of[part.part_id].insert(tag.tag_id);
  });
  previous = -1;
  check.each("contradictions", m.contradictions, [&](const part_observation_t& part) {
    check.require(part.part_id >= std::exchange(previous, part.part_id), "part_id", "descends");
    check.require(part.num_tags == 1, "num_tags", "is not 1");
    if (check.problem().empty())
      check.require(tags_of[part.part_id].insert(part.tags.front().tag_id).second, "tags",
                    "repeats a tag");
  });
}

void check_together(Checker& check, const signal_t& m) {
  check.require(m.lower_limit <= m.upper_limit, "upper_limit", "is below lower_limit");
  check.require(m.lower_limit <= m.covered_lower && m.covered_upper <= m.upper_limit,
                "covered_lower", "or covered_upper is beyond the limits");
  check.require(m.covered_lower <= m.covered_upper, "covered_upper", "is below covered_lower");
}

// A Gaussian process that passes can be factorised again.

void check_together(Checker& check, const residual_gp_t& m) {
  const std::int64_t D = m.num_gp_signals, N = m.num_gp_samples;
  check.require_count("gp_inputs", m.num_gp_inputs, N * D);
  check.require_count("gp_residuals", m.num_gp_residuals, 6 * N);
}

void check_together(Checker& check, const matrix_gp_t& m) {
  const std::int64_t D = m.num_matrix_signals, N = m.num_matrix_poses;
  check.require_count("entry_length_scales", m.num_entry_lengths, 12 * D);
  check.require_count("matrix_inputs", m.num_matrix_inputs, N * D);
}

/// Positive semidefinite only up to pairs: the screw frames' gauge makes the matrix singular, and
/// in float its smallest eigenvalues are noise of either sign.
void check_parameter_covariance(Checker& check, const std::vector<float>& packed) {
  std::vector<double> deviations;
  for (std::size_t i = 0, k = 0; k < packed.size(); ++i) {
    deviations.push_back(std::sqrt(double{packed[k + i]}));  // NaN, which fails below, if negative
    const double scale = (1 + kCorrelationTolerance) * deviations[i];
    for (std::size_t j = 0; j <= i; ++j, ++k)
      check.require(std::abs(packed[k]) <= scale * deviations[j], "parameter_covariance",
                    "is not positive semidefinite");
  }
}

void check_together(Checker& check, const schema_edge_t& m) {
  const bool is_soft = m.base_kind == schema_edge_t::EDGE_SCREW_GP;
  const bool is_matrix = m.base_kind == schema_edge_t::EDGE_MATRIX_GP;
  const bool is_screw = m.base_kind == schema_edge_t::EDGE_SCREW;
  check.require(m.num_joints > 0 ? is_screw || is_soft : !is_screw, "base_kind",
                "does not go with num_joints");
  check.require(m.num_outliers <= m.num_samples_used, "num_outliers", "exceeds num_samples_used");
  check.require(m.num_residual_gp == is_soft, "num_residual_gp", "does not go with base_kind");
  check.require(m.num_matrix_gp == is_matrix, "num_matrix_gp", "does not go with base_kind");
  const std::int64_t side = 6 + 8 * m.num_joints, expected = side * (side + 1) / 2;
  check.require(m.num_covariance == 0 || m.num_covariance == expected, "num_covariance",
                "is neither 0 nor p(p+1)/2, p = 6 + 8 num_joints");
  if (m.num_covariance == expected) check_parameter_covariance(check, m.parameter_covariance);
}

void check_together(Checker& check, const body_change_t& m) {
  check.require(m.since_sample <= m.found_sample, "since_sample", "is after found_sample");
}

void check_together(Checker& check, const moved_tag_t& m) {
  check.require(m.moved_since_sample <= m.moved_found_sample, "moved_since_sample",
                "is after moved_found_sample");
  check.require(m.moved_until_sample == -1 || m.moved_until_sample > m.moved_found_sample,
                "moved_until_sample", "is not after moved_found_sample");
}

/// The edges of a schema are a tree of its parts, ordered from the root outwards: each leads to a
/// part that no edge before it touched. So one pass over the edges places every part.
void check_tree(Checker& check, const body_schema_t& m) {
  std::set<std::int32_t> placed;
  check.each("edges", m.edges, [&](const schema_edge_t& edge) {
    const auto is_part = [&](std::int32_t id) {
      return std::ranges::binary_search(m.part_ids, id);
    };
    check.require(is_part(edge.from_part), "from_part", "is not in part_ids");
    check.require(is_part(edge.to_part), "to_part", "is not in part_ids");
    check.require(edge.from_part != edge.to_part, "to_part", "is from_part");
    check.require(!std::ranges::binary_search(m.position_parts, edge.from_part), "from_part",
                  "is in position_parts: such a part is a leaf");
    check.require(edge.to_part != m.root_part, "to_part", "is the root");
    check.require(!placed.contains(edge.to_part), "to_part",
                  "was reached before: the edges are no tree ordered from the root outwards");
    placed.insert({edge.from_part, edge.to_part});
  });
  check.require(m.is_complete == 0 || m.num_edges == m.num_parts - 1, "is_complete",
                "is 1 but the edges do not span the parts");
}

/// Whatever names a signal of a schema names one that it has.
void check_signal_indices(Checker& check, const body_schema_t& m) {
  const auto require_signal = [&](const char* field, std::int32_t index) {
    check.require(index < m.num_signals, field, "is no index of signals");
  };
  const auto require_signals = [&](const char* field, const std::vector<std::int32_t>& indices) {
    for (const std::int32_t index : indices) require_signal(field, index);
  };
  require_signals("undecided_signals", m.undecided_signals);
  check.each("edges", m.edges, [&](const schema_edge_t& edge) {
    check.each("joints", edge.joints, [&](const screw_joint_t& joint) {
      require_signal("signal_index", joint.signal_index);
    });
    check.each("residual_gp", edge.residual_gp,
               [&](const residual_gp_t& gp) { require_signals("gp_signals", gp.gp_signals); });
    check.each("matrix_gp", edge.matrix_gp, [&](const matrix_gp_t& gp) {
      require_signals("matrix_signals", gp.matrix_signals);
    });
  });
}

void check_together(Checker& check, const body_schema_t& m) {
  const auto is_part = [&](std::int32_t id) { return std::ranges::binary_search(m.part_ids, id); };
  check.require(m.part_ids.empty() ? m.root_part == -1 : is_part(m.root_part), "root_part",
                "is not in part_ids (-1 where those are empty)");
  for (const std::int32_t id : m.position_parts)
    check.require(is_part(id), "position_parts", "is not in part_ids");
  check_tree(check, m);
  check_signal_indices(check, m);
  check.each("frames", m.frames, [&](const part_frame_t& frame) {
    check.require(is_part(frame.frame_part), "frame_part", "is not in part_ids");
  });
  std::set<std::int32_t> unconnected;
  check.each("unconnected", m.unconnected, [&](const unconnected_part_t& part) {
    check.require(unconnected.insert(part.unconnected_part).second, "unconnected_part", "repeats");
  });
  std::int64_t previous = -1;
  check.each("moved_tags", m.moved_tags, [&](const moved_tag_t& tag) {
    check.require(tag.moved_found_sample >= previous, "moved_found_sample", "descends");
    previous = tag.moved_found_sample;
  });
  check.each("wanted_actions", m.wanted_actions, [&](const wanted_action_t& wanted) {
    check.require(wanted.num_signals == m.num_signals, "num_signals", "is not that of the schema");
  });
}

void check_together(Checker& check, const change_size_t& m) {
  const int expected = m.size_kind == change_size_t::SIZE_UNKNOWN ? 0
                       : m.size_kind >= change_size_t::SIZE_POSE  ? 2
                                                                  : 1;
  check.require(m.num_amounts == expected, "num_amounts", "does not fit size_kind");
}

void check_together(Checker& check, const model_health_t& m) {
  check.require(m.probe_sample < 0 || m.num_probe > 0, "probe_sample",
                "wants a probe without an action");
  check.require((m.wanted_sample >= 0) == (m.num_wanted > 0), "wanted_sample",
                "does not go with num_wanted");
}

void check_together(Checker& check, const sample_request_t& m) {
  check.require(m.first_missing <= m.last_missing, "last_missing", "is before first_missing");
}

void check_together(Checker& check, const pose_target_t& m) {
  const bool is_pose = m.target_kind == pose_target_t::KIND_POSE;
  const bool is_tag = m.target_kind == pose_target_t::KIND_TAG;
  check.require(
      (is_pose || is_tag || m.target_kind == pose_target_t::KIND_POSITION) == (m.target_part >= 0),
      "target_part", "does not go with target_kind");
  check.require(is_tag || m.target_tag == 0, "target_tag", "does not go with target_kind");
  const double norm = Eigen::Map<const Eigen::Vector4d>(m.orientation_wxyz).norm();
  check.require(std::abs(norm - (is_pose ? 1 : 0)) <= kUnitTolerance, "orientation_wxyz",
                is_pose ? "is no unit quaternion" : "does not go with target_kind");
  check.require(m.way_point <= m.num_way_points, "way_point", "is beyond num_way_points");
}

void check_together(Checker& check, const process_info_t& m) {
  const std::string* previous = nullptr;
  check.each("counters", m.counters, [&](const counter_t& counter) {
    check.require(previous == nullptr || *previous < counter.counter_name, "counter_name",
                  "is not ascending");
    previous = &counter.counter_name;
  });
}

}  // namespace

template <class Message>
std::string check(const Message& message) {
  Checker checker;
  checker.check(message);
  return checker.problem();
}

template std::string check(const action_command_t&);
template std::string check(const motion_status_t&);
template std::string check(const sim_state_t&);
template std::string check(const camera_image_t&);
template std::string check(const camera_info_t&);
template std::string check(const marker_poses_t&);
template std::string check(const sample_t&);
template std::string check(const sample_request_t&);
template std::string check(const body_schema_t&);
template std::string check(const model_health_t&);
template std::string check(const pose_target_t&);
template std::string check(const control_status_t&);
template std::string check(const fault_command_t&);
template std::string check(const process_info_t&);

}  // namespace bodyschema
