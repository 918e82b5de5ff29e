#include "common/config/yaml.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <random>

#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

/// Text of the ConfigError; fails if there is none.
std::string error_of(const std::function<void()>& action) {
  try {
    action();
  } catch (const ConfigError& error) {
    return error.what();
  } catch (const std::exception& error) {
    ADD_FAILURE() << "not a ConfigError: " << error.what();
    return "";
  }
  ADD_FAILURE() << "no error";
  return "";
}

#define EXPECT_CONFIG_ERROR(action, expected) EXPECT_EQ(error_of([&] { action; }), expected)

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

TEST(YamlTest, ReadsEveryTypeItOffers) {
  const Yaml yaml = Yaml::parse(R"(
a: 1.5
n: -7
yes: true
name: arm7
list: [1, 2.5, -3e-2]
ids: [4, 5]
v: [1, 2, 3]
below: {inner: 3}
items:
  - {id: 1}
  - {id: 2}
)");
  EXPECT_EQ(yaml.number("a"), 1.5);
  EXPECT_EQ(yaml.integer("n"), -7);
  EXPECT_TRUE(yaml.boolean("yes"));
  EXPECT_EQ(yaml.text("name"), "arm7");
  EXPECT_EQ(yaml.choice("name", {"arm2", "arm7"}), "arm7");
  EXPECT_EQ(yaml.numbers("list"), (std::vector<double>{1, 2.5, -3e-2}));
  EXPECT_EQ(yaml.integers("ids"), (std::vector<std::int64_t>{4, 5}));
  EXPECT_EQ(yaml.vector3("v"), Eigen::Vector3d(1, 2, 3));
  EXPECT_EQ(yaml.section("below").integer("inner"), 3);
  std::vector<std::int64_t> ids;
  for (const Yaml& item : yaml.list("items")) ids.push_back(item.integer("id"));
  EXPECT_EQ(ids, (std::vector<std::int64_t>{1, 2}));
  EXPECT_NO_THROW(yaml.finish());
}

TEST(YamlTest, AMissingKeyIsNamedWithItsMapping) {
  const Yaml yaml = Yaml::parse("stop:\n  min_samples: 3\nseed: 1\n", "rig/babbler.yaml");
  EXPECT_CONFIG_ERROR(yaml.number("position_m"),
                      "rig/babbler.yaml:1: position_m: this key is missing");
  EXPECT_CONFIG_ERROR(yaml.section("stop").integer("position_m"),
                      "rig/babbler.yaml:2: stop.position_m: this key is missing");
}

TEST(YamlTest, AMissingKeyThatWasMisspeltIsRecognised) {
  const Yaml yaml = Yaml::parse("outlier_rat: 0.1\nmax_signals: 2\n", "f");
  EXPECT_TRUE(contains(error_of([&] { yaml.number("outlier_rate"); }), "is 'outlier_rat' meant?"));
}

TEST(YamlTest, AnUnknownKeyIsAnErrorThatNamesTheNearestKnownOne) {
  const Yaml yaml = Yaml::parse("resend_s: 1\nmax_samples: 3\nresent_s: 2\n", "f");
  yaml.number("resend_s");
  yaml.integer("max_samples");
  EXPECT_CONFIG_ERROR(yaml.finish(),
                      "f:3: resent_s: this key is unknown; did you mean 'resend_s'?");
}

TEST(YamlTest, AnUnknownKeyDeepInsideIsFound) {
  const Yaml yaml = Yaml::parse("tags:\n  - id: 1\n    place: {x: 1, y: 2}\n", "f");
  for (const Yaml& tag : yaml.list("tags")) {
    tag.integer("id");
    tag.section("place").number("x");
  }
  EXPECT_CONFIG_ERROR(yaml.finish(),
                      "f:3: tags[0].place.y: this key is unknown; did you mean 'x'?");
}

TEST(YamlTest, AnUnknownKeyOfAPoseIsFound) {
  const Yaml yaml = Yaml::parse("X_BM: {position_m: [0, 0, 0], rpy_degrees: [1, 2, 3]}", "f");
  yaml.pose("X_BM");
  EXPECT_TRUE(contains(error_of([&] { yaml.finish(); }), "X_BM.rpy_degrees: this key is unknown"));
}

TEST(YamlTest, ASectionOrListMayBeAskedForTwice) {
  const Yaml yaml = Yaml::parse("a: {x: 1, y: 2}\nb: [{x: 1, y: 2}]\n");
  yaml.section("a").number("x");
  yaml.section("a").number("y");
  yaml.list("b").at(0).number("x");
  yaml.list("b").at(0).number("y");
  EXPECT_NO_THROW(yaml.finish());
}

TEST(YamlTest, EachSectionHasItsOwnKeys) {
  const Yaml yaml = Yaml::parse("a: {x: 1}\nb: {x: 1}\n", "f");
  yaml.section("a").number("x");
  yaml.section("b");
  EXPECT_TRUE(contains(error_of([&] { yaml.finish(); }), "f:2: b.x: this key is unknown"));
}

TEST(YamlTest, AWrongTypeIsRefusedWithLineAndKey) {
  const Yaml yaml = Yaml::parse(
      "number: fast\ninteger: 1.5\nflag: maybe\ntext: [1]\nlist: 3\nwords: [1, two]\nmap: "
      "3\nnothing:\n",
      "f");
  EXPECT_CONFIG_ERROR(yaml.number("number"), "f:1: number: expected a number");
  EXPECT_CONFIG_ERROR(yaml.integer("integer"), "f:2: integer: expected an integer");
  EXPECT_CONFIG_ERROR(yaml.boolean("flag"), "f:3: flag: expected true or false");
  EXPECT_CONFIG_ERROR(yaml.text("text"), "f:4: text: expected a text");
  EXPECT_CONFIG_ERROR(yaml.numbers("list"), "f:5: list: expected a list of numbers");
  EXPECT_CONFIG_ERROR(yaml.list("list"), "f:5: list: expected a list");
  EXPECT_CONFIG_ERROR(yaml.numbers("words"), "f:6: words: expected a list of numbers");
  EXPECT_CONFIG_ERROR(yaml.integers("words"), "f:6: words: expected a list of integers");
  EXPECT_CONFIG_ERROR(yaml.section("map"), "f:7: map: expected a mapping 'key: value'");
  EXPECT_CONFIG_ERROR(yaml.number("nothing"), "f:8: nothing: expected a number");
  EXPECT_CONFIG_ERROR(yaml.text("nothing"), "f:8: nothing: expected a text");
  EXPECT_CONFIG_ERROR(yaml.section("nothing"), "f:8: nothing: expected a mapping 'key: value'");
}

TEST(YamlTest, AValueOutOfRangeIsRefusedAndItsEndsAreNot) {
  const Yaml yaml = Yaml::parse("a: 2\nb: 2.5\n", "f");
  EXPECT_EQ(yaml.integer("a", 2, 2), 2);
  EXPECT_EQ(yaml.number("b", 2.5, 2.5), 2.5);
  EXPECT_CONFIG_ERROR(yaml.integer("a", 3, 9), "f:1: a: 2 is outside 3 … 9");
  EXPECT_CONFIG_ERROR(yaml.integer("a", 0, 1), "f:1: a: 2 is outside 0 … 1");
  EXPECT_CONFIG_ERROR(yaml.number("b", 3, 9), "f:2: b: 2.5 is outside 3 … 9");
  EXPECT_CONFIG_ERROR(yaml.number("b", 0, 1), "f:2: b: 2.5 is outside 0 … 1");
  EXPECT_CONFIG_ERROR(yaml.choice("a", {"x", "y"}), "f:1: a: '2' is none of: x, y");
}

TEST(YamlTest, AnIntegerThatDoesNotFitIsRefused) {
  const Yaml yaml = Yaml::parse("a: 9223372036854775808\nb: 9223372036854775807\nc: 1e3\n");
  EXPECT_TRUE(contains(error_of([&] { yaml.integer("a"); }), "expected an integer"));
  EXPECT_EQ(yaml.integer("b"), std::numeric_limits<std::int64_t>::max());
  EXPECT_TRUE(contains(error_of([&] { yaml.integer("c"); }), "expected an integer"));
}

TEST(YamlTest, NoNumberIsEverInfiniteOrNaN) {
  for (const std::string value : {".nan", ".NaN", ".inf", "-.inf", "nan", "inf", "1e999"}) {
    const Yaml yaml = Yaml::parse("a: " + value + "\nb: [0, " + value + "]\n");
    EXPECT_TRUE(contains(error_of([&] { yaml.number("a"); }), "number")) << value;
    EXPECT_TRUE(contains(error_of([&] { yaml.numbers("b"); }), "numbers")) << value;
  }
}

TEST(YamlTest, AListOfAnotherLengthIsRefused) {
  const Yaml yaml = Yaml::parse("v: [1, 2]\n", "f");
  EXPECT_CONFIG_ERROR(yaml.vector3("v"), "f:1: v: expected 3 numbers, found 2");
}

TEST(YamlTest, ADuplicateKeyIsRefusedAtAnyDepth) {
  EXPECT_CONFIG_ERROR(Yaml::parse("a: 1\nb: 2\na: 3\n", "f"), "f:3: a: this key stands twice");
  const Yaml yaml = Yaml::parse("a:\n  b: 1\n  b: 2\n", "f");
  EXPECT_CONFIG_ERROR(yaml.section("a"), "f:3: a.b: this key stands twice");
}

TEST(YamlTest, WhatIsNoMappingIsRefused) {
  EXPECT_CONFIG_ERROR(Yaml::parse("- 1\n- 2\n", "f"), "f:1: expected a mapping 'key: value'");
  // A reader of the first document would miss all later ones.
  EXPECT_CONFIG_ERROR(Yaml::parse("a: 1\n---\na: 2\n", "f"),
                      "f:2: expected one YAML document, found a second one");
  EXPECT_EQ(Yaml::parse("---\na: 1\n", "f").integer("a"), 1);
  EXPECT_CONFIG_ERROR(Yaml::parse("just words", "f"), "f:1: expected a mapping 'key: value'");
  EXPECT_CONFIG_ERROR(Yaml::parse("", "f"), "f:1: expected a mapping 'key: value'");
  EXPECT_CONFIG_ERROR(Yaml::parse("# only a comment\n", "f"),
                      "f:1: expected a mapping 'key: value'");
  const Yaml yaml = Yaml::parse("list: [1, {a: 2}]\n", "f");
  EXPECT_CONFIG_ERROR(yaml.list("list"), "f:1: list[0]: expected a mapping 'key: value'");
}

TEST(YamlTest, AKeyThatIsNoTextIsRefused) {
  EXPECT_TRUE(contains(error_of([] { Yaml::parse("? [a, b]\n: 1\n", "f"); }), "f:1"));
  const Yaml yaml = Yaml::parse("a:\n  ? [a, b]\n  : 1\n", "f");
  EXPECT_TRUE(contains(error_of([&] { yaml.section("a"); }), "f:2"));
}

TEST(YamlTest, BrokenSyntaxIsReportedWithLineAndColumn) {
  const std::string error = error_of([] { Yaml::parse("a: 1\nb: [1, 2\nc: 3\n", "f.yaml"); });
  EXPECT_TRUE(contains(error, "f.yaml:3:")) << error;
  const std::string tab = error_of([] { Yaml::parse("a: {x: 1\n\t}\nb: @\n", "f.yaml"); });
  EXPECT_TRUE(contains(tab, "f.yaml:3:4: ")) << tab;
}

TEST(YamlTest, ATabAndADecimalCommaAreNamed) {
  const std::string tab = error_of([] { Yaml::parse("a:\n\tb: 1\n", "f"); });
  EXPECT_TRUE(contains(tab, "f:2:")) << tab;
  EXPECT_TRUE(contains(tab, "begins with a tab")) << tab;
  EXPECT_CONFIG_ERROR(Yaml::parse("a: 0,5\n", "f").number("a"),
                      "f:1: a: expected a number, with a point and not a comma");
}

TEST(YamlTest, AFileThatCannotBeReadIsNamed) {
  const std::string folder = testing::TempDir();
  EXPECT_TRUE(contains(error_of([&] { Yaml::load(folder + "/no_such.yaml"); }),
                       "no_such.yaml: cannot be read"));
  EXPECT_TRUE(contains(error_of([&] { Yaml::load(folder); }), folder));
}

TEST(YamlTest, KnowsItsFileAndItsText) {
  const std::string file = testing::TempDir() + "/yaml_test_" + std::to_string(getpid()) + ".yaml";
  std::ofstream(file) << "a: 1  # why\n";
  const Yaml yaml = Yaml::load(file);
  std::filesystem::remove(file);
  EXPECT_EQ(yaml.file(), file);
  EXPECT_EQ(yaml.file_text(), "a: 1  # why\n");
  EXPECT_CONFIG_ERROR(yaml.number("size"), file + ":1: size: this key is missing");
}

TEST(YamlTest, AnOptionalKeyCountsAsKnown) {
  const Yaml yaml = Yaml::parse("b: 1\n");
  EXPECT_FALSE(yaml.has("a"));
  EXPECT_TRUE(yaml.has("b"));
  EXPECT_NO_THROW(yaml.finish());
}

// R = Rz(yaw) Ry(pitch) Rx(roll), by hand: roll turns y to z, yaw turns x to y.
TEST(YamlTest, RollPitchYawTurnAboutTheFixedAxesInThatOrder) {
  const Yaml yaml = Yaml::parse(R"(
roll: {position_m: [1, 2, 3], rpy_deg: [90, 0, 0]}
pitch: {position_m: [0, 0, 0], rpy_deg: [0, 90, 0]}
yaw: {position_m: [0, 0, 0], rpy_deg: [0, 0, 90]}
roll_and_yaw: {position_m: [0, 0, 0], rpy_deg: [90, 0, 90]}
)");
  using Eigen::Vector3d;
  const Vector3d x = Vector3d::UnitX(), y = Vector3d::UnitY(), z = Vector3d::UnitZ();
  EXPECT_LT((yaml.pose("roll") * y - Vector3d(1, 2, 4)).norm(), 1e-12);
  EXPECT_LT((yaml.pose("pitch").linear() * z - x).norm(), 1e-12);
  EXPECT_LT((yaml.pose("yaw").linear() * x - y).norm(), 1e-12);
  // First roll (y to z), then yaw (z stays): y goes to z, z goes to −y and then to x.
  EXPECT_LT((yaml.pose("roll_and_yaw").linear() * y - z).norm(), 1e-12);
  EXPECT_LT((yaml.pose("roll_and_yaw").linear() * z - x).norm(), 1e-12);
}

TEST(YamlTest, AQuaternionAndRollPitchYawDescribeTheSameRotation) {
  std::mt19937_64 rng(7);
  std::uniform_real_distribution<double> degrees(-180, 180);
  for (int n = 0; n < 100; ++n) {
    const Eigen::Vector3d rpy(degrees(rng), degrees(rng) / 2, degrees(rng));
    std::ostringstream text;
    text.precision(17);
    text << "p: {position_m: [0.1, -0.2, 0.3], rpy_deg: [" << rpy.x() << ", " << rpy.y() << ", "
         << rpy.z() << "]}\n";
    const Pose from_rpy = Yaml::parse(text.str()).pose("p");
    const Eigen::Quaterniond q(from_rpy.linear());
    text << "q: {position_m: [0.1, -0.2, 0.3], rotation_wxyz: [" << q.w() << ", " << q.x() << ", "
         << q.y() << ", " << q.z() << "]}\n";
    const Pose from_q = Yaml::parse(text.str()).pose("q");
    EXPECT_LT((from_rpy.matrix() - from_q.matrix()).norm(), 1e-12);
    EXPECT_NEAR(from_rpy.linear().determinant(), 1, 1e-12);
    // The angles can be read off the matrix again.
    const Eigen::Matrix3d R = from_rpy.linear();
    EXPECT_NEAR(std::asin(-R(2, 0)) / kDegree, rpy.y(), 1e-5);
  }
}

TEST(YamlTest, APoseWithoutRotationIsATranslation) {
  const Yaml yaml = Yaml::parse("p: {position_m: [1, 2, 3]}\n");
  const Pose X = yaml.pose("p");
  EXPECT_EQ(X.linear(), Eigen::Matrix3d::Identity());
  EXPECT_EQ(X.translation(), Eigen::Vector3d(1, 2, 3));
  EXPECT_NO_THROW(yaml.finish());
}

TEST(YamlTest, AQuaternionThatIsNotUnitAndAPoseWithTwoRotationsAreRefused) {
  const Yaml yaml = Yaml::parse(
      "a: {position_m: [0, 0, 0], rotation_wxyz: [1, 1, 0, 0]}\n"
      "b: {position_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], rpy_deg: [0, 0, 0]}\n",
      "f");
  EXPECT_CONFIG_ERROR(yaml.pose("a"), "f:1: a.rotation_wxyz: is not a unit quaternion");
  const std::string error = error_of([&] {
    yaml.pose("b");
    yaml.finish();
  });
  EXPECT_TRUE(contains(error, "f:2: b.rpy_deg")) << error;
}

// Any text of a file gives a value or a ConfigError, never another exception or a crash.
TEST(YamlTest, DamagedFilesGiveAConfigErrorOrAValue) {
  const std::string good = R"(family: tag36h11
tags:
  - {id: 0, size_m: 0.08, part: 1, placement: {position_m: [0.02, -0.04, 0], rpy_deg: [-90, 0, 32]}}
  - {id: 1, size_m: 0.08, part: 1, placement: none}
stop: {min: 3, deep: {max: 4}}
)";
  const std::string bytes = "{}[]:,-#'\"|>&*!%@`? \n\t0123abc.\x80\xff";
  std::mt19937_64 rng(11);
  const auto below = [&](std::size_t n) { return static_cast<std::size_t>(rng() % n); };
  int num_read = 0;
  for (int n = 0; n < 5000; ++n) {
    std::string text = good;
    for (std::size_t k = 0; k <= below(3); ++k) {
      const std::size_t at = below(text.size());
      switch (below(3)) {
        case 0:
          text[at] = bytes[below(bytes.size())];
          break;
        case 1:
          text.insert(at, 1, bytes[below(bytes.size())]);
          break;
        default:
          text.erase(at, 1 + below(4));
      }
    }
    try {
      const Yaml yaml = Yaml::parse(text);
      yaml.choice("family", {"tag36h11"});
      for (const Yaml& tag : yaml.list("tags")) {
        tag.integer("id");
        tag.number("size_m");
        tag.integer("part");
        if (tag.text("placement") != "none") tag.pose("placement");
      }
      yaml.section("stop").section("deep").integer("max");
      yaml.finish();
      ++num_read;
    } catch (const ConfigError&) {
    }
  }
  EXPECT_LT(num_read, 5000);
}

}  // namespace
}  // namespace bodyschema
