#include "common/bus/check.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <functional>
#include <random>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "bodyschema/message_fields.h"
#include "common/bus/convert.h"
#include "common/bus/triangle.h"
#include "common/text/text.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

/// Visitor of describe() that breaks one field in one way that its kind forbids: the n-th of all
/// ways of all fields.
class Breaker {
 public:
  explicit Breaker(int n) : countdown_(n) {}

  /// Path of the broken field; "" if there are no more than n ways.
  const std::string& broken() const { return broken_; }

  template <class Value, class Kind>
  void operator()(const char* field, Value& value, const Kind& kind) {
    if constexpr (requires { ways(field, value, kind); }) {
      ways(field, value, kind);
    } else {
      for (auto& element : value) (*this)(field, element, kind);
    }
  }
  template <class Message>
  void operator()(const char* field, Message& message) {
    if constexpr (std::is_array_v<Message>) {
      each(field, message);
    } else {
      within(std::string(field) + ".", message);
    }
  }
  template <class Element, class Kind>
  void array(const char* field, const std::int32_t&, std::vector<Element>& elements,
             const Kind& kind) {
    lengths(field, elements);
    if constexpr (std::is_same_v<Element, std::uint8_t>) return;
    for (Element& element : elements) (*this)(field, element, kind);
    if constexpr (std::is_same_v<Kind, Ascending>)
      for (std::size_t i = 1; i < elements.size(); ++i) put(field, elements[i], elements[i - 1]);
  }
  template <class Message>
  void array(const char* field, const std::int32_t&, std::vector<Message>& messages) {
    lengths(field, messages);
    each(field, messages);
  }

 private:
  template <class Change>
  void way(const char* field, const Change& change) {
    if (countdown_-- != 0) return;
    change();
    broken_ = path_ + field;
  }
  template <class Value>
  void put(const char* field, Value& value, const std::type_identity_t<Value>& bad) {
    way(field, [&] { value = bad; });
  }

  template <class Message>
  void within(const std::string& step, Message& message) {
    const std::string outer = std::exchange(path_, path_ + step);
    describe(*this, message);
    path_ = outer;
  }
  template <class Messages>
  void each(const char* field, Messages& messages) {
    int index = 0;
    for (auto& message : messages) within(field + ("[" + std::to_string(index++) + "]."), message);
  }

  template <class Element>
  void lengths(const char* field, std::vector<Element>& array) {
    way(field, [&] { array.emplace_back(); });
    if (!array.empty()) way(field, [&] { array.pop_back(); });
  }

  template <class Number>
  requires std::is_arithmetic_v<Number>
  void ways(const char* field, Number& value, const Range& range) {
    const auto beyond = [&](double bound, double direction) {
      if (!std::isfinite(bound)) return;
      if constexpr (std::is_integral_v<Number>)
        put(field, value, static_cast<Number>(bound + direction));
      else
        put(field, value,
            std::nextafter(static_cast<Number>(bound), static_cast<Number>(direction * INFINITY)));
    };
    beyond(range.lower, -1);
    beyond(range.upper, 1);
    if constexpr (std::is_floating_point_v<Number>)
      for (const float bad : {NAN, INFINITY, -INFINITY}) put(field, value, bad);
  }
  void ways(const char* field, double& value, Positive) {
    for (const double bad : {0.0, -1.0, double{NAN}, double{INFINITY}}) put(field, value, bad);
  }
  void ways(const char* field, double& value, Measured) {
    for (const double bad : {-0.5, -2.0, double{NAN}, double{INFINITY}}) put(field, value, bad);
  }
  void ways(const char* field, std::int8_t& value, Constant kind) {
    put(field, value, -1);
    put(field, value, static_cast<std::int8_t>(kind.last + 1));
  }
  template <class Id>
  void ways(const char* field, Id& value, Ascending) {
    put(field, value, -1);
    if (path_.ends_with("].") && !path_.ends_with("[0].")) put(field, value, 0);
  }
  void ways(const char* field, std::string& value, const Range& bytes) {
    for (const char* bad : {"50 \xB0", "\xED\xA0\x80", "cut \xE2\x86"}) put(field, value, bad);
    put(field, value, std::string("a\0b", 3));
    put(field, value, std::string(static_cast<std::size_t>(bytes.upper) + 1, 'x'));
    if (bytes.lower > 0) put(field, value, "");
  }
  void ways(const char* field, double (&q)[4], Quaternion) {
    for (const double factor : {0.0, 0.998, 1.002, double{NAN}})
      way(field, [&] { std::ranges::transform(q, q, [&](double w) { return factor * w; }); });
  }
  template <std::size_t N>
  void ways(const char* field, float (&triangle)[N], Covariance) {
    put(field, triangle[4], NAN);
    put(field, triangle[N - 1], -1e-9F);
    put(field, triangle[1], 1.01F * std::sqrt(triangle[0] * triangle[2]));
    way(field, [&] { triangle[0] = 0, triangle[1] = 1e-9F; });
  }

  int countdown_;
  std::string path_, broken_;
};

TEST(Check, ComplainsOfEveryFieldThatIsBroken) {
  for_each_channel([](const auto& channel, const auto& example) {
    int num_ways = 0;
    for (;; ++num_ways) {
      auto message = example;
      Breaker breaker(num_ways);
      describe(breaker, message);
      if (breaker.broken().empty()) break;
      const std::string problem = check(message);
      EXPECT_TRUE(problem.starts_with(breaker.broken() + " "))
          << channel.name << ": " << breaker.broken() << ", complaint: " << problem;
    }
    EXPECT_GT(num_ways, 5) << channel.name;
  });
}

/// Fails unless check() refuses the changed message and its complaint begins with `field`.
template <class Message>
void expect_refused(Message message, const std::string& field,
                    const std::type_identity_t<std::function<void(Message&)>>& change) {
  ASSERT_EQ(check(message), "");
  change(message);
  const std::string problem = check(message);
  EXPECT_EQ(problem.substr(0, field.size() + 1), field + " ") << "complaint: " << problem;
}

TEST(Check, AcceptsEveryExample) {
  for_each_channel([](const auto& channel, const auto& message) {
    EXPECT_EQ(check(message), "") << channel.name;
  });
}

// What is wrong somewhere is told as an event first, then as a finding.
TEST(Check, AFindingMayHaveTheCauseOfAnyEvent) {
  for (int cause = 0; cause < 100; ++cause) {
    model_health_t of_event = example_model_health(), of_finding = of_event;
    of_event.events[0].event_cause = static_cast<std::int8_t>(cause);
    of_finding.findings[0].finding_cause = static_cast<std::int8_t>(cause);
    EXPECT_EQ(check(of_event).empty(), check(of_finding).empty()) << cause;
  }
}

TEST(Check, RefusesFieldsThatContradictEachOther) {
  expect_refused(example_sample(), "rest_end_utime",
                 [](auto& m) { m.rest_end_utime = m.rest_begin_utime - 1; });
  expect_refused(example_sample(), "parts[0].error_ratio",
                 [](auto& m) { m.parts[0].error_ratio = 2; });
  expect_refused(example_sample(), "parts[1].error_ratio",
                 [](auto& m) { m.parts[1].error_ratio = 0.9; });
  expect_refused(example_marker_poses(), "markers[0].covariance",
                 [](auto& m) { std::ranges::fill(m.markers[0].covariance, 0.0F); });
  expect_refused(example_marker_poses(), "markers[0].corner_covariance",
                 [](auto& m) { m.markers[0].corner_covariance[35] = 0; });
  expect_refused(example_sample(), "parts[0].covariance",
                 [](auto& m) { std::ranges::fill(m.parts[0].covariance, 0.0F); });
  expect_refused(example_marker_poses(), "markers[0].reprojection_error_px",
                 [](auto& m) { m.markers[0].reprojection_error_px[0] = 1; });
  expect_refused(example_camera_image(), "num_bytes", [](auto& m) { ++m.height; });
  expect_refused(example_camera_info(), "num_coefficients", [](auto& m) {
    m.distortion.resize(3);
    m.num_coefficients = 3;
  });
  expect_refused(example_camera_info(), "num_coefficients",
                 [](auto& m) { m.distortion_model = camera_info_t::MODEL_FISHEYE; });
  expect_refused(example_sample_request(), "last_missing", [](auto& m) { m.last_missing = 2; });
  expect_refused(example_pose_target(), "target_part",
                 [](auto& m) { m.target_kind = pose_target_t::KIND_HOLD; });
  expect_refused(example_pose_target(), "target_part", [](auto& m) { m.target_part = -1; });
  expect_refused(example_pose_target(), "orientation_wxyz",
                 [](auto& m) { m.target_kind = pose_target_t::KIND_POSITION; });
  expect_refused(example_pose_target(), "orientation_wxyz",
                 [](auto& m) { m.orientation_wxyz[0] = 0.9; });
  expect_refused(example_pose_target(), "target_tag", [](auto& m) { m.target_tag = 40; });
  expect_refused(example_pose_target(), "way_point", [](auto& m) { m.way_point = 21; });
  expect_refused(example_process_info(), "counters[1].counter_name",
                 [](auto& m) { m.counters[1].counter_name = m.counters[0].counter_name; });
  expect_refused(example_model_health(), "probe_sample", [](auto& m) {
    m.probe_action.clear();
    m.num_probe = 0;
  });
  expect_refused(example_model_health(), "wanted_sample", [](auto& m) { m.wanted_sample = -1; });
  expect_refused(example_body_schema(), "wanted_actions[0].num_signals", [](auto& m) {
    m.wanted_actions[0].wanted_action.pop_back();
    m.wanted_actions[0].num_signals = 1;
  });
  expect_refused(example_model_health(), "findings[0].finding_size.num_amounts", [](auto& m) {
    m.findings[0].finding_size.size_kind = change_size_t::SIZE_FACTOR;
  });
  expect_refused(example_model_health(), "events[0].event_size.num_amounts",
                 [](auto& m) { m.events[0].event_size.size_kind = change_size_t::SIZE_UNKNOWN; });
}

TEST(Check, OnlyAMoveHasAnAction) {
  expect_refused(example_action_command(), "num_signals",
                 [](auto& m) { m.kind = action_command_t::KIND_STOP; });
  expect_refused(example_action_command(), "num_signals", [](auto& m) {
    m.action.clear();
    m.num_signals = 0;
  });
}

TEST(Check, AcceptsWhatIsNotKnown) {
  body_schema_t schema = example_body_schema();
  std::ranges::fill(schema.X_CR_covariance, 0.0F);
  EXPECT_EQ(check(schema), "") << "an unknown camera pose has no covariance yet";
  model_health_t health = example_model_health();
  health.worst_position_m = health.part_health[0].position_median_m = -1;
  health.edge_health[0].median_mahalanobis2 = -1;
  EXPECT_EQ(check(health), "");
}

TEST(Check, IdsAscendInTheirOwnArray) {
  sample_t sample = example_sample();
  sample.parts[1].tags[0].tag_id = 0;
  EXPECT_EQ(check(sample), "");
}

TEST(Check, ContradictionsAreOfOneTagEachThatIsNowhereElse) {
  const auto refuses = [](auto spoil) {
    sample_t sample = example_sample();
    spoil(sample);
    return check(sample);
  };
  EXPECT_EQ(refuses([](sample_t& m) { m.parts[1].part_id = m.parts[0].part_id; }),
            "parts[1].part_id is not ascending");
  EXPECT_EQ(refuses([](sample_t& m) { m.contradictions[0].tags[0].tag_id = 13; }),
            "contradictions[0].tags repeats a tag");
  EXPECT_EQ(refuses([](sample_t& m) { m.contradictions[0].num_tags = 0; }).substr(0, 17),
            "contradictions[0]");
  EXPECT_EQ(refuses([](sample_t& m) { m.contradictions[0].part_id = 7; }), "");  // seen so alone
}

TEST(Check, AcceptsASingularCovarianceAndOneWithVeryDifferentUnits) {
  sample_t sample = example_sample();
  for (int i = 0, k = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j, ++k) {
      const float scale_i = i < 3 ? 1e-6F : 1e3F;
      const float scale_j = j < 3 ? 1e-6F : 1e3F;
      sample.parts[0].covariance[k] = scale_i * scale_j;
    }
  }
  EXPECT_EQ(check(sample), "");
}

TEST(Check, AcceptsANearlySingularCovarianceThatRoundingToFloatMadeIndefinite) {
  std::mt19937_64 rng(5);
  std::normal_distribution<double> normal;
  int num_indefinite = 0;
  sample_t sample = example_sample();
  for (int n = 0; n < 2000; ++n) {
    Eigen::Matrix<double, 6, 6> root = Eigen::Matrix<double, 6, 6>::Zero();
    for (double& value : root.leftCols<5>().reshaped()) value = normal(rng);
    root.topRows<3>() *= 1e-3;
    const Eigen::Matrix<double, 6, 6> singular = root * root.transpose();
    pack_triangle(singular, sample.parts[0].covariance);
    ASSERT_EQ(check(sample), "");
    const auto rounded = unpack_triangle<6>(sample.parts[0].covariance);
    num_indefinite += correlation_of(rounded).selfadjointView<Eigen::Lower>().eigenvalues()[0] < 0;
    // A receiver may invert it, and sends it on unchanged.
    const Matrix6d covariance = from_message(sample.parts[0].covariance);
    EXPECT_EQ(covariance.llt().info(), Eigen::Success);
    EXPECT_TRUE(correlation_of(covariance).isApprox(correlation_of(rounded), 3e-5));
    to_message(covariance, sample.parts[0].covariance);
    EXPECT_EQ(from_message(sample.parts[0].covariance),
              unpack_triangle<6>(sample.parts[0].covariance));
  }
  EXPECT_GT(num_indefinite, 100);
}

TEST(Check, APositionAloneSaysNothingOfRotation) {
  const auto alone = [] {
    sample_t sample = example_sample();
    part_observation_t& part = sample.parts[0];
    part.has_rotation = 0;
    part.X_CB.rotation_wxyz[0] = 1;
    for (int i = 1; i < 4; ++i) part.X_CB.rotation_wxyz[i] = 0;
    part.X_CB_other = part.X_CB;
    std::fill(part.covariance + 6, part.covariance + 21, 0.0F);
    return sample;
  };
  EXPECT_EQ(check(alone()), "");
  expect_refused(alone(), "parts[0].X_CB", [](auto& m) { m.parts[0].X_CB = m.parts[1].X_CB; });
  expect_refused(alone(), "parts[0].X_CB_other",
                 [](auto& m) { m.parts[0].X_CB_other = m.parts[1].X_CB; });
  expect_refused(alone(), "parts[0].covariance",
                 [](auto& m) { m.parts[0].covariance[20] = 1e-6F; });
  expect_refused(alone(), "parts[0].covariance", [](auto& m) {
    std::fill(m.parts[0].covariance, m.parts[0].covariance + 6, 0.0F);
  });
  expect_refused(alone(), "parts[0].has_other", [](auto& m) {
    m.parts[0].has_other = 1;
    m.parts[0].error_ratio = 2;
  });
}

TEST(Check, RefusesASchemaThatIsNoTreeOfItsOwnPartsAndSignals) {
  const auto refused = [](const std::string& field, const auto& change) {
    expect_refused(example_body_schema(), field, change);
  };
  refused("position_parts", [](auto& m) { m.position_parts[1] = 10; });
  refused("edges[1].from_part", [](auto& m) { m.position_parts[0] = 4; });
  refused("edges[0].to_part", [](auto& m) { m.edges[0].to_part = 7; });
  refused("edges[0].from_part", [](auto& m) { m.edges[0].from_part = 7; });
  refused("edges[0].to_part", [](auto& m) { m.edges[0].to_part = 9, m.edges[0].from_part = 9; });
  refused("edges[0].to_part", [](auto& m) { m.edges[0].to_part = 2, m.edges[0].from_part = 4; });
  refused("edges[1].to_part", [](auto& m) { m.edges[1].to_part = 4; });
  refused("edges[2].to_part", [](auto& m) { m.edges[2].to_part = 1; });
  refused("edges[1].to_part", [](auto& m) { std::swap(m.edges[0], m.edges[1]); });
  refused("edges[0].joints[1].signal_index",
          [](auto& m) { m.edges[0].joints[1].signal_index = 2; });
  refused("edges[2].residual_gp[0].gp_signals",
          [](auto& m) { m.edges[2].residual_gp[0].gp_signals[1] = 2; });
  refused("edges[3].matrix_gp[0].matrix_signals",
          [](auto& m) { m.edges[3].matrix_gp[0].matrix_signals[0] = 2; });
  refused("undecided_signals", [](auto& m) { m.undecided_signals[1] = m.num_signals; });
  refused("root_part", [](auto& m) { m.root_part = -1; });
  refused("root_part", [](auto& m) { m.root_part = 7; });
  refused("is_complete", [](auto& m) { m.is_complete = 1; });
  refused("frames[0].frame_part", [](auto& m) { m.frames[0].frame_part = 7; });
  refused("unconnected[1].unconnected_part", [](auto& m) {
    m.unconnected.push_back(m.unconnected[0]);
    ++m.num_unconnected;
  });
}

TEST(Check, RefusesASchemaWhoseFieldsContradictEachOther) {
  const auto refused = [](const std::string& field, const auto& change) {
    expect_refused(example_body_schema(), field, change);
  };
  refused("signals[0].upper_limit", [](auto& m) { m.signals[0].upper_limit = -2; });
  refused("signals[0].covered_lower", [](auto& m) { m.signals[0].covered_upper = 2; });
  refused("signals[0].covered_upper", [](auto& m) { m.signals[0].covered_upper = -1.3; });
  refused("changes[0].since_sample", [](auto& m) { m.changes[0].since_sample = 33; });
  refused("moved_tags[0].moved_since_sample",
          [](auto& m) { m.moved_tags[0].moved_since_sample = 35; });
  refused("moved_tags[0].moved_until_sample",
          [](auto& m) { m.moved_tags[0].moved_until_sample = 34; });
  refused("moved_tags[1].moved_found_sample", [](auto& m) {
    m.moved_tags.push_back(m.moved_tags[0]);
    ++m.num_moved_tags;
    m.moved_tags[1].moved_found_sample = 33;
  });
  refused("edges[0].num_outliers", [](auto& m) { m.edges[0].num_outliers = 41; });
  refused("edges[0].num_covariance", [](auto& m) {
    m.edges[0].parameter_covariance.resize(21);
    m.edges[0].num_covariance = 21;
  });
  refused("edges[0].parameter_covariance", [](auto& m) { m.edges[0].parameter_covariance[1] = 1; });
  refused("edges[0].parameter_covariance",
          [](auto& m) { m.edges[0].parameter_covariance[2] = -1e-6F; });
  // Each kind of edge has what its name says, and nothing else.
  refused("edges[0].base_kind",
          [](auto& m) { m.edges[0].base_kind = schema_edge_t::EDGE_MATRIX_GP; });
  refused("edges[1].base_kind", [](auto& m) { m.edges[1].base_kind = schema_edge_t::EDGE_SCREW; });
  refused("edges[2].num_residual_gp",
          [](auto& m) { m.edges[2].base_kind = schema_edge_t::EDGE_SCREW; });
  refused("edges[3].num_matrix_gp",
          [](auto& m) { m.edges[3].base_kind = schema_edge_t::EDGE_RIGID; });
  // A Gaussian process can be factorised again.
  const auto extend = [](std::int32_t& count, std::vector<double>& array) {
    array.resize(static_cast<std::size_t>(++count), 1);
  };
  const auto residual = [&](const std::string& field, auto count, auto array) {
    refused("edges[2].residual_gp[0]." + field, [&](auto& m) {
      extend(m.edges[2].residual_gp[0].*count, m.edges[2].residual_gp[0].*array);
    });
  };
  residual("gp_inputs", &residual_gp_t::num_gp_inputs, &residual_gp_t::gp_inputs);
  residual("gp_residuals", &residual_gp_t::num_gp_residuals, &residual_gp_t::gp_residuals);
  const auto matrix = [&](const std::string& field, auto count, auto array) {
    refused("edges[3].matrix_gp[0]." + field, [&](auto& m) {
      extend(m.edges[3].matrix_gp[0].*count, m.edges[3].matrix_gp[0].*array);
    });
  };
  matrix("entry_length_scales", &matrix_gp_t::num_entry_lengths, &matrix_gp_t::entry_length_scales);
  matrix("matrix_inputs", &matrix_gp_t::num_matrix_inputs, &matrix_gp_t::matrix_inputs);
}

TEST(AsText, ReplacesOnlyWhatIsNotUtf8) {
  EXPECT_EQ(as_text("2 → 4, 50°"), "2 → 4, 50°");
  EXPECT_EQ(as_text("50 \xB0"
                    "C"),
            "50 ?C");
  EXPECT_EQ(as_text(std::string("a\0b", 3)), "a?b");
  EXPECT_EQ(as_text("cut \xE2\x86"), "cut ??");
}

}  // namespace
}  // namespace bodyschema::test
