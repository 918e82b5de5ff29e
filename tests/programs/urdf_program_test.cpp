// `bodyschema urdf` and `engineer` as their users run them, on schemas learned from recordings.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/programs/program_test.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {
namespace {

class UrdfProgramTest : public ProgramTest {
 protected:
  void expect_success(const std::string& arguments) const {
    const Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.exit_code, 0) << arguments << "\n" << outcome.err;
  }
  void expect_failure(const std::string& arguments, const std::string& what) const {
    ProgramTest::expect_failure(arguments, what, 1);
  }
  BodySchema read(const std::string& schema) const {
    return from_message(read_log(folder_ / schema, kBodySchema).back());
  }
  void write(const std::string& name, const BodySchema& schema) const {
    write_one_event_log(folder_ / name, kBodySchema, to_message(schema));
  }
};

/// Largest differences of what two schemas predict of the parts in the root, over the commands.
struct Difference {
  double length = 0;    ///< of (translation [m], rotation [rad])
  double distance = 0;  ///< Mahalanobis, by the covariance of the first one's mean
};
Difference difference(const BodySchema& a, const BodySchema& b) {
  Rng rng(1);
  Difference most;
  for (int n = 0; n < 50; ++n) {
    const Eigen::VectorXd action = random_action(a.signals, rng);
    for (const auto& [part, X] : b.predict_all(action)) {
      if (part == a.root) continue;
      const PosePrediction expected = *a.predict(a.root, part, action);
      const Vector6d error = log(expected.X_AB.inverse() * X);
      most.length = std::max(most.length, error.norm());
      most.distance =
          std::max(most.distance, std::sqrt(squared_mahalanobis(error, expected.covariance)));
    }
  }
  return most;
}

TEST_F(UrdfProgramTest, OfARecordingTheUrdfPredictsWhatTheSchemaDoes) {
  for (const std::string name : {"arm4_1", "arm7_1"}) {
    const std::string recording = BODYSCHEMA_RECORDINGS "/" + name + ".lcmlog";
    expect_success("learn '" + recording + "' --out learned.lcmlog");
    expect_success("urdf learned.lcmlog --out r.urdf --placement p.yaml");
    EXPECT_NE(text_of(folder_ / "stdout.txt").find("r.urdf: "), std::string::npos);
    expect_success("engineer r.urdf p.yaml --samples '" + recording + "' --out built.lcmlog");
    // What the learned screws slide is no more than the samples leave open.
    const Difference learned = difference(read("learned.lcmlog"), read("built.lcmlog"));
    EXPECT_LT(learned.length, 1e-3) << name;
    EXPECT_LT(learned.distance, 1) << name;
    // What has no such screws comes back as it was.
    expect_success("urdf built.lcmlog --out r2.urdf --placement p2.yaml");
    expect_success("engineer r2.urdf p2.yaml --samples '" + recording + "' --out again.lcmlog");
    EXPECT_LT(difference(read("built.lcmlog"), read("again.lcmlog")).length, 1e-9) << name;
  }
}

TEST_F(UrdfProgramTest, WhatIsRefusedIsNamedAndWritesNothing) {
  Rng rng(2);
  RandomTreeOptions options;
  options.share_prismatic = options.share_fixed = 0;
  options.share_helical = 1;
  BodySchema schema = true_schema(random_tree(options, rng));
  write("s.lcmlog", schema);
  expect_failure("urdf s.lcmlog --out r.urdf --placement p.yaml",
                 "s.lcmlog: a URDF has no such joints: ");
  EXPECT_FALSE(exists("r.urdf") || exists("p.yaml"));
  expect_success("urdf s.lcmlog --out r.urdf --placement p.yaml --nominal");
  EXPECT_NE(text_of(folder_ / "r.urdf").find("left out"), std::string::npos);
  expect_failure("urdf s.lcmlog --out s.lcmlog --placement p.yaml", "--out: s.lcmlog is an input");
  expect_failure("urdf s.lcmlog --out r.urdf --placement no/p.yaml", "--placement: cannot write");
  expect_failure("urdf s.lcmlog --out r.urdf --placement ./r.urdf", "another file than --out");
  schema.complete = false;
  schema.unconnected = {{900, Unconnected::kNotEnoughData, "seen twice"}};
  write("s.lcmlog", schema);
  expect_failure("urdf s.lcmlog --out r.urdf --placement p.yaml",
                 "the schema is incomplete: part 900: seen twice");
}

}  // namespace
}  // namespace bodyschema::test
