// bodyschema learn and monitor on recordings of others.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "common/geometry/angle.h"
#include "tests/programs/bodyschema_program.h"

namespace bodyschema::test {
namespace {

/// Recordings of others, read in their own folder; the project keeps no copy.
class RealDataTest : public BodyschemaProgramTest {
 protected:
  void SetUp() override {
    const char* folder = std::getenv("BODYSCHEMA_REAL_DATA");
    data_ = folder ? folder : BODYSCHEMA_REAL_DATA;
    if (!std::filesystem::is_directory(data_)) GTEST_SKIP() << data_ << " is not there";
  }
  /// Two recordings: of the blocks of `length` instants the even ones, and the odd ones.
  std::pair<std::string, std::string> split(const std::filesystem::path& csv, int length) {
    std::ifstream in(csv);
    std::string header, line;
    std::getline(in, header);
    std::ostringstream half[2];
    half[0] << header << "\n";
    half[1] << header << "\n";
    int instant = -1;
    for (std::string time; std::getline(in, line);) {
      const std::string t = line.substr(0, line.find(','));
      if (t != time) ++instant;
      time = t;
      half[instant / length % 2] << line << "\n";
    }
    return {write("even.csv", half[0].str()), write("odd.csv", half[1].str())};
  }

  std::filesystem::path data_;
};

// In metres, w x y z, with commas: right input gets no hint.
TEST_F(RealDataTest, NoneOfThemGetsAHint) {
  int num_recordings = 0;
  for (const auto& entry : std::filesystem::directory_iterator(data_)) {
    if (entry.path().extension() != ".csv") continue;
    // Refused as soon as it was read: the result of learning does not matter here.
    const Outcome outcome = run({"learn", entry.path().string(), "--root", "99"});
    EXPECT_EQ(outcome.exit_code, 1);
    EXPECT_NE(outcome.err.find("--root: part 99 is never seen"), std::string::npos) << outcome.err;
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
    ++num_recordings;
  }
  EXPECT_GT(num_recordings, 0);
}

TEST_F(RealDataTest, TheWeldingPositionerIsOneEdgeOfBothSignals) {
  const auto csv = data_ / "positioner_2dof_metrology.csv";
  if (!std::filesystem::exists(csv)) GTEST_SKIP() << csv << " is not there";
  const Json json = run({"learn", csv, "--out", "schema.lcmlog", "--json"}).json();
  EXPECT_TRUE(json["complete"].get<bool>()) << json;
  EXPECT_EQ(json["samples"], 205);
  EXPECT_EQ(json["parts"], (Json{0, 1}));
  ASSERT_EQ(json["edges"].size(), 1U) << json;
  const auto signals = json["edges"][0]["signals"].get<std::set<std::string>>();
  EXPECT_EQ(signals, (std::set<std::string>{"q1", "q2"}));
  // Its axes are no perfect screws: two leave 0.4 mm, which come back with its turns.
  EXPECT_EQ(json["edges"][0]["kind"], "screw_gp");
  const Json errors = run({"predict", "schema.lcmlog", csv, "--json"}).json();
  EXPECT_EQ(errors["parts"][0]["count"], 205);
  EXPECT_LT(errors["parts"][0]["position_median_m"].get<double>(), 0.0005);
  EXPECT_LT(errors["parts"][0]["rotation_median_deg"].get<double>(), 0.06);
}

// Learned from every other row, judged by the rest. (Its rows are q1; within one q2 turns.)
TEST_F(RealDataTest, TheWeldingPositionerIsPredictedWhereItWasNotLearned) {
  const auto csv = data_ / "positioner_2dof_metrology.csv";
  if (!std::filesystem::exists(csv)) GTEST_SKIP() << csv << " is not there";
  const auto [even, odd] = split(csv, 1);
  const Json json = run({"learn", even, "--out", "schema.lcmlog", "--json"}).json();
  EXPECT_EQ(json["edges"][0]["signals"].get<std::set<std::string>>(),
            (std::set<std::string>{"q1", "q2"}));
  const Json part = run({"predict", "schema.lcmlog", odd, "--json"}).json()["parts"][0];
  EXPECT_GE(part["count"], 100);
  EXPECT_LT(part["position_rms_m"].get<double>(), 0.0003);
  EXPECT_LT(part["rotation_rms_deg"].get<double>(), 0.04);
  // Twice that noise is told, which twice of is far too much: still no more noise, but a process.
  const Json told =
      run({"learn", even, "--noise", "0.0003", "0.03", "--out", "told.lcmlog", "--json"}).json();
  EXPECT_TRUE(told["complete"].get<bool>()) << told;
  EXPECT_EQ(told["edges"][0]["kind"], "screw_gp");
}

// Seven joints between the only two parts seen: learned from every other pose, judged by the rest.
TEST_F(RealDataTest, AnArmSeenAtItsEndsIsAChainOfAllItsJoints) {
  const auto csv = data_ / "arm7_ends.csv";
  if (!std::filesystem::exists(csv)) GTEST_SKIP() << csv << " is not there";
  const auto [even, odd] = split(csv, 1);
  for (const std::vector<std::string>& noise :
       {std::vector<std::string>{}, {"--noise", "0.001", "0.2"}}) {
    std::vector<std::string> arguments{"learn", even, "--out", "schema.lcmlog", "--json"};
    arguments.insert(arguments.end(), noise.begin(), noise.end());
    const Json json = run(arguments).json();
    EXPECT_TRUE(json["complete"].get<bool>()) << json;
    EXPECT_EQ(json["edges"][0]["signals"], (Json{"q1", "q2", "q3", "q4", "q5", "q6", "q7"}));
    const Json part = run({"predict", "schema.lcmlog", odd, "--json"}).json()["parts"][0];
    EXPECT_LT(part["position_rms_m"].get<double>(), 0.0020);
    EXPECT_LT(part["rotation_rms_deg"].get<double>(), 0.3);
  }
}

// What six joints leave of seven is no noise, and too few poses are no proof.
TEST_F(RealDataTest, AnArmOfWhichASignalIsMissingIsNotExplainedByNoise) {
  const auto csv = data_ / "arm7_ends.csv";
  if (!std::filesystem::exists(csv)) GTEST_SKIP() << csv << " is not there";
  for (const int missing : {2, 7}) {
    std::ifstream in(csv);
    std::ostringstream out;
    for (std::string line; std::getline(in, line);) {
      std::istringstream cells(line);
      int column = 0;
      for (std::string cell; std::getline(cells, cell, ','); ++column)
        if (column != missing) out << (column == 0 ? "" : ",") << cell;
      out << "\n";
    }
    const Json json = run({"learn", write("six.csv", out.str()), "--json"}).json();
    EXPECT_FALSE(json["complete"].get<bool>()) << missing;
  }
}

TEST_F(RealDataTest, ABrokenRecordingHasNoValidModel) {
  const auto csv = data_ / "trunk_adiabatic4.csv";
  if (!std::filesystem::exists(csv)) GTEST_SKIP() << csv << " is not there";
  for (const std::vector<std::string>& noise :
       {std::vector<std::string>{}, {"--noise", "0.003", "1.5"}}) {
    std::vector<std::string> arguments{"learn", csv, "--json"};
    arguments.insert(arguments.end(), noise.begin(), noise.end());
    const Json json = run(arguments).json();
    EXPECT_FALSE(json["complete"].get<bool>());
    EXPECT_TRUE(json["edges"].empty()) << json["edges"];
    ASSERT_EQ(json["unconnected"].size(), 3U);
    for (const Json& part : json["unconnected"])
      EXPECT_EQ(part["reason"].get<std::string>().rfind("no valid model", 0), 0U) << part;
  }
}

// A soft trunk, six motors on tendons, 100 Hz; part 2 is seen turned over in bursts. Learned from
// every other block of time (1.28 s), judged by the blocks between.
TEST_F(RealDataTest, TheSoftTrunkIsAChainOfScrewsWithResidualProcesses) {
  const auto csv = data_ / "trunk_c11.csv";
  if (!std::filesystem::exists(csv)) GTEST_SKIP() << csv << " is not there";
  const auto [even, odd] = split(csv, 128);
  for (const bool is_told : {true, false}) {
    std::vector<std::string> learn{"learn", even, "--out", "schema.lcmlog", "--json"};
    if (is_told) learn.insert(learn.end(), {"--noise", "0.003", "1.5"});
    const Json json = run(learn).json();
    EXPECT_TRUE(json["complete"].get<bool>()) << json["unconnected"];
    ASSERT_EQ(json["edges"].size(), 3U);
    for (int n = 0; n < 3; ++n) {
      EXPECT_EQ(json["edges"][n]["from"], n);
      EXPECT_EQ(json["edges"][n]["to"], n + 1);
      EXPECT_EQ(json["edges"][n]["kind"], "screw_gp");
    }
    // The flips: 9 to 17 % of part 2, and nothing of the others to speak of.
    std::map<int, int> outliers;
    for (const Json& o : json["outliers"]) ++outliers[o["part"].get<int>()];
    const double samples = json["samples"];
    EXPECT_GT(outliers[2], 0.09 * samples);
    EXPECT_LT(outliers[2], 0.25 * samples);
    EXPECT_LT(outliers[0] + outliers[1] + outliers[3], 0.08 * samples);
  }
  const Json parts = run({"predict", "schema.lcmlog", odd, "--json"}).json()["parts"];
  // Measured, its noise not told: 1.1, 2.9 and 5.5 mm from the root.
  const double position_m[] = {0.0015, 0.004, 0.008};
  for (int n = 0; n < 3; ++n)
    EXPECT_LT(parts[n]["position_median_m"].get<double>(), position_m[n]) << parts[n];
}

/// Learned from every other block of time (1.28 s), monitored on the blocks between.
class TrunkMonitorTest : public RealDataTest {
 protected:
  void SetUp() override {
    RealDataTest::SetUp();
    if (IsSkipped()) return;
    csv_ = data_ / "trunk_c11.csv";
    if (!std::filesystem::exists(csv_)) GTEST_SKIP() << csv_ << " is not there";
    odd_ = split(csv_, 128).second;
    ASSERT_EQ(
        run({"learn", "even.csv", "--noise", "0.003", "1.5", "--out", "schema.lcmlog"}).exit_code,
        0);
  }
  std::vector<Json> events(const std::string& file) const {
    const Outcome outcome = run({"monitor", "schema.lcmlog", file, "--noise", "0.003", "1.5",
                                 "--json", "--out", "monitored.lcmlog"});
    EXPECT_EQ(outcome.exit_code, 0) << outcome.err;
    return lines_of(outcome.out);
  }
  /// The rows of a recording, each after `change`.
  template <class Change>
  std::string rewritten(const std::string& name, const std::string& file, Change change) const {
    std::ifstream in(folder_ / file);
    std::string line, text;
    std::getline(in, line);
    text = line + "\n";
    while (std::getline(in, line)) text += change(line);
    return write(name, text);
  }

  std::filesystem::path csv_;
  std::string odd_;
};

TEST_F(TrunkMonitorTest, NoAlarmOnTheHeldOutHalfOfTheTrunk) {
  EXPECT_EQ(events(odd_), std::vector<Json>{});
  // The judged instants of a stream are random: the whole recording from other instants on.
  const std::string whole = write("whole.csv", text_of(csv_));
  for (const double from_s : {0.0, 0.21, 0.42, 0.63, 0.84}) {
    const std::string later = rewritten("later.csv", whole, [&](const std::string& row) {
      return std::stod(row) < from_s ? "" : row + "\n";
    });
    EXPECT_EQ(events(later), std::vector<Json>{}) << "from " << from_s << " s on";
  }
}

// By 3 cm and 20° on its part, from the middle of the recording on.
TEST_F(TrunkMonitorTest, AMarkerMovedOnTheTrunkIsFound) {
  constexpr double kChange_s = 30;
  Vector6d by = Vector6d::Zero();
  by(0) = 0.03;
  by(5) = 20 * kDegree;
  const std::string moved = rewritten("moved.csv", odd_, [&](const std::string& row) {
    std::vector<double> v;
    std::stringstream fields(row);
    for (std::string field; std::getline(fields, field, ',');) v.push_back(std::stod(field));
    if (v[0] < kChange_s || v[7] != 3) return row + "\n";
    Pose X = Pose::Identity();
    X.translation() = Eigen::Vector3d(v[8], v[9], v[10]);
    X.linear() = Eigen::Quaterniond(v[11], v[12], v[13], v[14]).normalized().toRotationMatrix();
    X = X * exp(by);
    const Eigen::Quaterniond q(X.linear());
    std::ostringstream out;
    out << std::setprecision(9);
    for (int n = 0; n < 8; ++n) out << v[static_cast<std::size_t>(n)] << ",";
    out << X.translation().x() << "," << X.translation().y() << "," << X.translation().z() << ","
        << q.w() << "," << q.x() << "," << q.y() << "," << q.z() << "\n";
    return out.str();
  });
  const std::vector<Json> found = events(moved);
  ASSERT_EQ(found.size(), 2U) << Json(found);
  EXPECT_EQ(found[0]["event"], "mismatch");
  EXPECT_EQ(found[1]["event"], "candidate");
  EXPECT_EQ(found[1]["cause"], "marker_moved");
  for (const Json& event : found) {
    EXPECT_EQ(event["part"], 3);
    EXPECT_GE(event["t"], kChange_s);
    EXPECT_LE(event["samples_used"], 4);
    // Every other block is missing.
    EXPECT_LT(event["t"], kChange_s + 6);
  }
  // And mended: part 3 is predicted as well as it was before.
  const std::string after = rewritten("after.csv", moved, [&](const std::string& row) {
    return std::stod(row) < kChange_s ? "" : row + "\n";
  });
  const auto error_m = [&](const char* schema) {
    return run({"predict", schema, after, "--json"})
        .json()["parts"][2]["position_median_m"]
        .get<double>();
  };
  EXPECT_GT(error_m("schema.lcmlog"), 0.025);
  EXPECT_LT(error_m("monitored.lcmlog"), 0.010);
}

}  // namespace
}  // namespace bodyschema::test
