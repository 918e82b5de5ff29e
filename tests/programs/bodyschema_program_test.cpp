#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <map>
#include <nlohmann/json.hpp>
#include <numeric>
#include <random>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/geometry/angle.h"
#include "tests/lcmtypes/example_messages.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using Json = nlohmann::json;

std::string text_of(const std::filesystem::path& file) {
  std::stringstream text;
  text << std::ifstream(file, std::ios::binary).rdbuf();
  return text.str();
}

struct Outcome {
  int exit_code = 0;
  std::string out;
  std::string err;

  Json json() const {
    EXPECT_EQ(exit_code, 0) << err;
    const Json parsed = Json::parse(out, nullptr, false);
    EXPECT_FALSE(parsed.is_discarded()) << out;
    return parsed;
  }
};

/// The structure that `learn --json` printed, in the form that test::judge() reads.
BodySchema structure_of(const Json& json) {
  BodySchema schema;
  schema.complete = json.at("complete");
  schema.parts = json.at("parts").get<std::vector<int>>();
  for (const Json& printed : json.at("edges")) {
    Edge edge;
    edge.from = printed.at("from");
    edge.to = printed.at("to");
    for (const Json& name : printed.at("signals")) {
      ScrewJoint joint;  // CSV columns are called q1, q2, …
      joint.signal = std::stoi(name.get<std::string>().substr(1)) - 1;
      edge.joints.push_back(joint);
    }
    schema.edges.push_back(edge);
  }
  return schema;
}

/// Runs the program in a folder of its own, whose name has a space.
class BodyschemaProgramTest : public testing::Test {
 protected:
  BodyschemaProgramTest() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    folder_ = std::filesystem::path(testing::TempDir()) /
              ("bodyschema program " + std::to_string(getpid()) + test->name());
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
  }
  ~BodyschemaProgramTest() override { std::filesystem::remove_all(folder_); }

  /// `before`: shell text in front of the program, e.g. "cat s.csv | ".
  Outcome run(const std::vector<std::string>& arguments, const std::string& before = "") const {
    const auto out = folder_ / "stdout.txt", err = folder_ / "stderr.txt";
    std::string command =
        "cd '" + folder_.string() + "' && " + before + "'" + BODYSCHEMA_PROGRAM + "'";
    for (const std::string& argument : arguments) command += " '" + argument + "'";
    command += " >stdout.txt 2>stderr.txt";
    if (before.find('|') == std::string::npos) command += " </dev/null";
    const int status = std::system(command.c_str());
    EXPECT_TRUE(WIFEXITED(status)) << command << " was killed";
    return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, text_of(out), text_of(err)};
  }
  /// It failed with a message that contains `what`, and printed no result.
  void expect_failure(const std::vector<std::string>& arguments, const std::string& what,
                      int exit_code = 0) const {
    const Outcome outcome = run(arguments);
    if (exit_code != 0) {
      EXPECT_EQ(outcome.exit_code, exit_code) << what;
    }
    EXPECT_TRUE(outcome.exit_code == 1 || outcome.exit_code == 2) << outcome.exit_code << what;
    EXPECT_EQ(outcome.out, "") << what;
    EXPECT_NE(outcome.err.find(what), std::string::npos) << outcome.err;
  }

  std::string write(const std::string& name, const std::string& text) const {
    std::ofstream(folder_ / name, std::ios::binary) << text;
    return name;
  }
  std::string write(const std::string& name, const std::vector<ActionPoseSample>& samples) const {
    std::stringstream text;
    test::write_csv(samples, text);
    return write(name, text.str());
  }
  /// 30 samples of a 2-DOF robot.
  std::string write_robot(const std::string& name, test::Regime regime = test::Regime::kTagIso) {
    test::Rng rng(71);
    robot_ = test::chapter_robot("a", rng);
    test::ObservationOptions options;
    options.regime = regime;
    return write(name, test::babble(robot_, 30, options, rng));
  }
  bool exists(const std::string& name) const { return std::filesystem::exists(folder_ / name); }

  std::filesystem::path folder_;
  test::SyntheticRobot robot_;
};

TEST_F(BodyschemaProgramTest, ASchemaBeyondADatagramIsLearnedSavedAndLoaded) {
  constexpr int kParts = 25;
  std::mt19937_64 rng(3);
  std::normal_distribution<double> normal;
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < 70; ++t) {
    ActionPoseSample& sample = samples.emplace_back();
    sample.utime = 1'000'000 * t;
    sample.sample_index = t;
    sample.action = Eigen::VectorXd::Constant(1, std::sin(t));
    for (int part = 0; part < kParts; ++part) {
      Vector6d noise;
      for (double& value : noise) value = 1e-3 * normal(rng);
      PartObservation& seen = sample.parts.emplace_back();
      seen.part = part;
      seen.X_CB = Eigen::Translation3d(0.1 * part, 0, 1) * exp(noise);
    }
  }
  const std::string csv = write("rigid.csv", samples);
  const Outcome learned = run(
      {"learn", csv, "--method", "chapter", "--noise", "0.001", "0.06", "--out", "large.lcmlog"});
  ASSERT_EQ(learned.exit_code, 0) << learned.err;
  EXPECT_GT(std::filesystem::file_size(folder_ / "large.lcmlog"), 64'000U);
  const Json shown = run({"show", "large.lcmlog", "--json"}).json();
  EXPECT_TRUE(shown["complete"].get<bool>());
  EXPECT_EQ(shown["edges"].size(), kParts - 1U);
  EXPECT_EQ(run({"predict", "large.lcmlog", csv}).exit_code, 0);

  write_one_event_log(folder_ / "larger.lcmlog", kBodySchema, test::large_schema(200));
  EXPECT_EQ(run({"show", "larger.lcmlog", "--json"}).json()["edges"].size(), 199U);
}

TEST_F(BodyschemaProgramTest, AHundredPartsAreLearnedSavedAndLoaded) {
  test::Rng rng(5);
  const auto robot = test::random_tree({.num_parts = 100, .num_hidden = 0}, rng);
  const auto csv = write("tree.csv", test::babble(robot, 10, {}, rng));
  const Json learned = run({"learn", csv, "--out", "large.lcmlog", "--json"}).json();
  EXPECT_TRUE(test::is_right(structure_of(learned), robot));
  EXPECT_GT(std::filesystem::file_size(folder_ / "large.lcmlog"), 64'000U);
  const Json shown = run({"show", "large.lcmlog", "--json"}).json();
  EXPECT_EQ(shown["edges"].size(), 99U);
  const Json parts = run({"predict", "large.lcmlog", csv, "--json"}).json()["parts"];
  ASSERT_EQ(parts.size(), 99U);
  for (const Json& part : parts) EXPECT_LT(part["position_max_m"].get<double>(), 1e-4);
}

TEST_F(BodyschemaProgramTest, LearnFindsTheStructureOfTreesWithBranchesSlidersAndSharedSignals) {
  test::Rng rng(72);
  int num_prismatic = 0, num_branches = 0;
  for (int run_index = 0; run_index < 10; ++run_index) {
    test::RandomTreeOptions tree;
    tree.num_parts = 6 + run_index % 4;
    tree.share_prismatic = 0.3;
    const auto robot = test::random_tree(tree, rng);
    std::map<int, int> children;
    for (const auto& link : robot.links) {
      num_prismatic += link.slide != 0 && link.turn == 0;
      num_branches += ++children[link.parent] == 2;
    }
    test::ObservationOptions options;
    options.regime = run_index % 2 ? test::Regime::kTagIso : test::Regime::kFree;
    const auto csv = write("tree.csv", test::babble(robot, 120, options, rng));
    const Json json = run({"learn", csv, "--json"}).json();
    EXPECT_TRUE(test::is_right(structure_of(json), robot)) << "tree " << run_index << "\n" << json;
    EXPECT_EQ(json["samples"], 120);
    EXPECT_EQ(json["root"], 1);
    // The idle signal, whatever its number, and none that moves something.
    std::string idle = "q";
    idle += std::to_string(robot.signals.size());
    EXPECT_EQ(json["unused_signals"], Json::array({idle}));
  }
  EXPECT_GT(num_prismatic, 2);
  EXPECT_GT(num_branches, 2);
}

TEST_F(BodyschemaProgramTest, LearnPrintsTheKeysThatAreDocumented) {
  const Outcome outcome = run({"learn", write_robot("s.csv"), "--json"});
  EXPECT_EQ(outcome.err, "");
  const Json json = outcome.json();
  for (const char* key :
       {"complete", "samples", "parts", "position_parts", "root", "edges", "unconnected",
        "unused_signals", "undecided_signals", "outliers", "noise", "one_cluster"}) {
    EXPECT_TRUE(json.contains(key)) << key;
  }
  EXPECT_EQ(json.size(), 12U);
  EXPECT_TRUE(json["complete"].get<bool>());
  ASSERT_EQ(json["edges"].size(), 4U);
  for (const Json& edge : json["edges"]) {
    EXPECT_GT(edge.at("position_rms_m").get<double>(), 0);
    EXPECT_LT(edge.at("position_rms_m").get<double>(), 0.05);
    EXPECT_GT(edge.at("rotation_rms_deg").get<double>(), 0);
  }
  // 3 mm and 1° per axis were put in.
  EXPECT_NEAR(json["noise"]["position_m"].get<double>(), 0.003, 0.0015);
  EXPECT_NEAR(json["noise"]["rotation_deg"].get<double>(), 1, 0.5);
  EXPECT_EQ(json["noise"]["from"], "residuals");
}

TEST_F(BodyschemaProgramTest, LearnDoesNotWriteOverItsRecording) {
  const std::string recording = "t,q1,part,x,y,z,qw,qx,qy,qz\n0,0,1,0,0,1,1,0,0,0\n";
  write("samples.csv", recording);
  const Outcome outcome = run({"learn", "samples.csv", "--out", "./samples.csv"});
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_NE(outcome.err.find("is an input itself"), std::string::npos) << outcome.err;
  std::ifstream file(folder_ / "samples.csv");
  EXPECT_EQ(std::string(std::istreambuf_iterator<char>(file), {}), recording);
}

TEST_F(BodyschemaProgramTest, LearnsAsTheChapterDidForComparison) {
  const auto csv = write_robot("s.csv", test::Regime::kFree);
  const Outcome outcome =
      run({"learn", csv, "--method", "chapter", "--noise", "0.001", "0.3", "--json"});
  const Json json = outcome.json();
  EXPECT_TRUE(test::is_right(structure_of(json), robot_)) << json;
  for (const Json& edge : json["edges"]) EXPECT_EQ(edge["kind"], "matrix_gp");
  EXPECT_NE(outcome.err.find("30 local models learned"), std::string::npos) << outcome.err;
  // The written schema predicts like the learned one: the Gaussian processes are factorised again.
  EXPECT_EQ(run({"learn", csv, "--method", "chapter", "--noise", "0.001", "0.3", "--out",
                 "schema.lcmlog"})
                .exit_code,
            0);
  for (const Json& edge : run({"show", "schema.lcmlog", "--json"}).json()["edges"])
    EXPECT_EQ(edge["matrix_gp"]["entries"].size(), 12U);
  for (const Json& part : run({"predict", "schema.lcmlog", csv, "--json"}).json()["parts"])
    EXPECT_LT(part["position_median_m"].get<double>(), 0.002);
  expect_failure({"learn", csv, "--method", "magic"}, "--method");
}

// At the noise of its cameras, 50 mm and 15°, a joint that turns less than that is no joint.
TEST_F(BodyschemaProgramTest, TheChaptersMethodGoesByTheNoiseOfTheData) {
  const auto csv = write_robot("s.csv");
  const Json json = run({"learn", csv, "--method", "chapter", "--json"}).json();
  EXPECT_TRUE(test::is_right(structure_of(json), robot_)) << json;
  const Json screw = run({"learn", csv, "--json"}).json();
  for (const char* of : {"position_m", "rotation_deg"})
    EXPECT_NEAR(json["noise"][of].get<double>(), screw["noise"][of].get<double>(), 1e-9);
}

TEST_F(BodyschemaProgramTest, WithoutJsonPeopleReadIt) {
  const Outcome outcome = run({"learn", write_robot("s.csv")});
  EXPECT_EQ(outcome.exit_code, 0);
  EXPECT_EQ(outcome.err, "");
  EXPECT_EQ(outcome.out.rfind("Complete structure of 5 parts from 30 samples\n", 0), 0U);
  EXPECT_FALSE(Json::accept(outcome.out));
}

TEST_F(BodyschemaProgramTest, TheSameRecordingGivesTheSameBytes) {
  const auto csv = write_robot("s.csv");
  const Outcome first = run({"learn", csv, "--out", "1.lcmlog", "--json"});
  const Outcome second = run({"learn", csv, "--out", "2.lcmlog", "--json"});
  EXPECT_EQ(first.out, second.out);
  EXPECT_EQ(text_of(folder_ / "1.lcmlog"), text_of(folder_ / "2.lcmlog"));
  EXPECT_FALSE(text_of(folder_ / "1.lcmlog").empty());
}

TEST_F(BodyschemaProgramTest, ALearnedSchemaPredictsWhatItHasNotSeen) {
  const auto csv = write_robot("train.csv", test::Regime::kFree);
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  test::Rng rng(73);
  const auto held_out = write("test.csv", test::babble(robot_, 11, {}, rng));
  const Json json = run({"predict", "schema.lcmlog", held_out, "--json"}).json();
  EXPECT_EQ(json["samples"], 11);
  ASSERT_EQ(json["parts"].size(), 4U);
  for (std::size_t i = 0; i < 4; ++i) {
    const Json& part = json["parts"][i];
    EXPECT_EQ(part.size(), 10U);
    EXPECT_EQ(part.at("part"), i + 2);
    EXPECT_EQ(part.at("count"), 11);
    EXPECT_LT(part.at("position_max_m").get<double>(), 1e-4);
    EXPECT_LE(part.at("position_median_m").get<double>(), part.at("position_max_m").get<double>());
    EXPECT_LE(part.at("position_rms_m").get<double>(), part.at("position_max_m").get<double>());
    EXPECT_LT(part.at("rotation_rms_deg").get<double>(), 0.01);
    EXPECT_GE(part.at("rotation_median_deg").get<double>(), 0);
  }
  const Outcome text = run({"predict", "schema.lcmlog", held_out});
  EXPECT_EQ(text.exit_code, 0);
  EXPECT_NE(text.out.find("median"), std::string::npos);
}

TEST_F(BodyschemaProgramTest, ReachFindsTheActionOfAPoseOrTheNearest) {
  ASSERT_EQ(run({"learn", write_robot("train.csv", test::Regime::kFree), "--out", "schema.lcmlog"})
                .exit_code,
            0);
  const Json shown = run({"show", "schema.lcmlog", "--json"}).json();
  std::vector<std::string> at = {"predict", "schema.lcmlog", "--json", "--action"};
  for (const Json& signal : shown["signals"])
    at.push_back(
        std::to_string(0.7 * signal["upper"].get<double>() + 0.3 * signal["lower"].get<double>()));
  const auto pose_of = [](const Json& predicted) {
    for (const Json& part : predicted["parts"])
      if (part["part"] == 5) return part["X_RB"];
    return Json();
  };
  const Json X_RB = pose_of(run(at).json());
  const auto add = [](std::vector<std::string> to, const Json& numbers) {
    for (const Json& number : numbers) to.push_back(number.dump());
    return to;
  };
  std::vector<std::string> reach = {"reach", "schema.lcmlog", "--part",
                                    "5",     "--json",        "--position"};
  reach = add(reach, X_RB["position_m"]);
  EXPECT_TRUE(run(reach).json()["rotation_error_deg"].is_null());
  reach.push_back("--orientation");
  reach = add(reach, X_RB["rotation_wxyz"]);
  const Outcome reached = run(reach);
  EXPECT_EQ(reached.exit_code, 0);
  const Json json = reached.json();
  EXPECT_EQ(json["reached"], true) << json;
  EXPECT_LE(json["position_error_m"].get<double>(), 1e-4);
  EXPECT_LE(json["rotation_error_deg"].get<double>(), 0.01);
  at.resize(4);
  for (const auto& [name, value] : json["action"].items()) at.push_back(value.dump());
  const Json found = pose_of(run(at).json());
  for (int i = 0; i < 3; ++i)
    EXPECT_NEAR(found["position_m"][i].get<double>(), X_RB["position_m"][i].get<double>(), 1e-3);

  const Json where = run({"where", "5", "--schema", "schema.lcmlog", "--json"}).json();
  ASSERT_EQ(where["parts"].size(), 1U) << where;
  EXPECT_EQ(where["parts"][0]["part"], 5);
  EXPECT_TRUE(where["signals"].is_null());
  for (int i = 0; i < 3; ++i) {
    const double at = X_RB["position_m"][i].get<double>();
    EXPECT_LE(where["parts"][0]["lowest_m"][i].get<double>(), at);
    EXPECT_GE(where["parts"][0]["highest_m"][i].get<double>(), at);
  }
  expect_failure({"where", "77", "--schema", "schema.lcmlog"}, "no part 77");

  const Outcome far =
      run({"reach", "schema.lcmlog", "--part", "5", "--json", "--position", "9", "9", "9"});
  EXPECT_EQ(far.exit_code, 1);
  const Json nearest = Json::parse(far.out);
  EXPECT_EQ(nearest["reached"], false);
  EXPECT_GT(nearest["position_error_m"].get<double>(), 5);
  EXPECT_NE(nearest["why"].get<std::string>().find("out of reach"), std::string::npos);

  const std::vector<std::string> of_none = {
      "reach", "schema.lcmlog", "--part", "77", "--position", "0", "0", "0"};
  expect_failure(of_none, "--part");
  expect_failure({"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "nan"},
                 "--position");
  expect_failure({"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "0",
                  "--orientation", "1", "1", "0", "0"},
                 "unit quaternion");
  expect_failure(
      {"reach", "schema.lcmlog", "--part", "5", "--position", "0", "0", "0", "--from", "1"},
      "--from");
}

// What a recording says does not hang on the order in which it says it, nor on units and names.
TEST_F(BodyschemaProgramTest, OrderOfRowsUnitOfStampsAndNamesChangeNothing) {
  const std::string text = text_of(folder_ / write_robot("s.csv"));
  std::vector<std::vector<std::string>> rows;
  std::stringstream stream(text);
  for (std::string line; std::getline(stream, line);) {
    std::stringstream fields(line);
    for (rows.emplace_back(); std::getline(fields, rows.back().emplace_back(), ',');) {
    }
    rows.back().pop_back();
  }
  const std::vector<std::string> header = rows.front();
  rows.erase(rows.begin());
  const auto csv_of = [](const std::vector<std::string>& names,
                         const std::vector<std::vector<std::string>>& lines) {
    std::string csv;
    const auto add = [&csv](const std::vector<std::string>& fields) {
      for (const std::string& field : fields) csv += (&field == &fields[0] ? "" : ",") + field;
      csv += "\n";
    };
    add(names);
    for (const auto& line : lines) add(line);
    return csv;
  };
  const auto learned = [&](const std::string& csv) {
    return run({"learn", write("other.csv", csv), "--out", "other.lcmlog", "--json"}).json();
  };
  const Json as_it_is = run({"learn", "s.csv", "--out", "schema.lcmlog", "--json"}).json();
  ASSERT_TRUE(test::is_right(structure_of(as_it_is), robot_)) << as_it_is;
  const std::string bytes = text_of(folder_ / "schema.lcmlog");

  test::Rng rng(76);
  auto other = rows;
  std::shuffle(other.begin(), other.end(), rng);
  EXPECT_EQ(learned(csv_of(header, other)), as_it_is);
  EXPECT_EQ(text_of(folder_ / "other.lcmlog"), bytes);

  other = rows;
  for (auto& row : other) row[0] += "000";  // in milliseconds
  EXPECT_EQ(learned(csv_of(header, other)), as_it_is);
  EXPECT_EQ(text_of(folder_ / "other.lcmlog"), bytes);

  // Poses at rest: whichever came first. The last digits differ, for sums have another order.
  other = rows;
  std::vector<int> stamps(30);
  std::iota(stamps.begin(), stamps.end(), 0);
  std::shuffle(stamps.begin(), stamps.end(), rng);
  for (auto& row : other) row[0] = std::to_string(stamps.at(std::stoul(row[0])));
  const Json shuffled = learned(csv_of(header, other));
  for (const char* key : {"complete", "parts", "unused_signals", "undecided_signals"})
    EXPECT_EQ(shuffled.at(key), as_it_is.at(key));
  ASSERT_EQ(shuffled.at("edges").size(), as_it_is.at("edges").size());
  EXPECT_TRUE(test::is_right(structure_of(shuffled), robot_)) << shuffled;

  // Signals and parts of other names, the parts in another order: the same edges.
  std::vector<std::string> names = header;
  names[1] = "turn";
  names[2] = "lift";
  other = rows;
  const std::map<std::string, std::string> part_of{
      {"1", "7"}, {"2", "4"}, {"3", "30"}, {"4", "2"}, {"5", "9"}};
  for (auto& row : other) row[3] = part_of.at(row[3]);
  using Ends = std::pair<std::set<std::string>, std::vector<std::string>>;
  std::set<Ends> expected, found;
  const std::map<std::string, std::string> signal_of{{"q1", "turn"}, {"q2", "lift"}};
  for (const Json& edge : as_it_is.at("edges")) {
    Ends ends;
    for (const char* end : {"from", "to"})
      ends.first.insert(part_of.at(std::to_string(edge.at(end).get<int>())));
    for (const Json& signal : edge.at("signals")) ends.second.push_back(signal_of.at(signal));
    expected.insert(ends);
  }
  write("other.csv", csv_of(names, other));
  const Json renamed = run({"learn", "other.csv", "--root", "7", "--json"}).json();
  for (const Json& edge : renamed.at("edges")) {
    Ends ends;
    for (const char* end : {"from", "to"})
      ends.first.insert(std::to_string(edge.at(end).get<int>()));
    for (const Json& signal : edge.at("signals")) ends.second.push_back(signal);
    found.insert(ends);
  }
  EXPECT_EQ(found, expected);
}

TEST_F(BodyschemaProgramTest, APredictionSaysHowWellItIsKnownAndWhatWasNeverTried) {
  const auto csv = write_robot("train.csv", test::Regime::kTagIso);
  const Json learned = run({"learn", csv, "--out", "schema.lcmlog", "--json"}).json();
  ASSERT_TRUE(learned.at("complete"));
  const Json within = run({"predict", "schema.lcmlog", "--action", "0.1", "-0.2", "--json"}).json();
  const Json beyond = run({"predict", "schema.lcmlog", "--action", "9", "-0.2", "--json"}).json();
  EXPECT_EQ(within.at("action"), Json({{"q1", 0.1}, {"q2", -0.2}}));
  EXPECT_EQ(within.at("outside_training"), Json::array());
  EXPECT_EQ(beyond.at("outside_training"), Json({"q1"}));
  ASSERT_EQ(within.at("parts").size(), 4U);
  int num_outside = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    const Json &in = within["parts"][i], &out = beyond["parts"][i];
    EXPECT_EQ(in.at("outside_training"), Json::array());
    EXPECT_GT(in.at("position_sd_m").get<double>(), 1e-5);
    EXPECT_LT(in.at("position_sd_m").get<double>(), 0.01);
    EXPECT_GT(in.at("rotation_sd_deg").get<double>(), 1e-3);
    if (out.at("outside_training").empty()) continue;
    EXPECT_EQ(out.at("outside_training"), Json({"q1"}));
    EXPECT_GT(out.at("rotation_sd_deg"), in.at("rotation_sd_deg"));
    ++num_outside;
  }
  EXPECT_GT(num_outside, 0);
  EXPECT_NE(
      run({"predict", "schema.lcmlog", "--action", "9", "-0.2"}).out.find("outside training: q1"),
      std::string::npos);

  // Of a recording: the samples outside are counted, and each row says it.
  test::Rng rng(75);
  std::vector<ActionPoseSample> samples = test::babble(robot_, 3, {}, rng);
  for (ActionPoseSample& sample : samples) sample.action << 0, 0;
  samples[1].action << 0, 9;
  const auto odd = write("odd.csv", samples);
  const Json json =
      run({"predict", "schema.lcmlog", odd, "--out", "predicted.csv", "--json"}).json();
  EXPECT_EQ(json.at("outside_training"), Json({{"samples", 1}, {"signals", {"q2"}}}));
  const std::string rows = text_of(folder_ / "predicted.csv");
  EXPECT_TRUE(
      rows.starts_with("t,q1,q2,part,x,y,z,qw,qx,qy,qz,position_sd_m,rotation_sd_deg,"
                       "outside_training\n0,0,0,2,"))
      << rows;
  EXPECT_EQ(std::count(rows.begin(), rows.end(), '\n'), 1 + 3 * 4);
  EXPECT_NE(rows.find(",q2\n"), std::string::npos);

  expect_failure({"predict", "schema.lcmlog", "--action", "1"}, "q1 q2");
  expect_failure({"predict", "schema.lcmlog", odd, "--action", "1", "2"}, "--action");
}

TEST_F(BodyschemaProgramTest, PredictionErrorsAreThoseThatWerePutIn) {
  ASSERT_EQ(run({"learn", write_robot("train.csv", test::Regime::kFree), "--out", "schema.lcmlog"})
                .exit_code,
            0);
  test::Rng rng(74);
  auto samples = test::babble(robot_, 9, {}, rng);
  for (ActionPoseSample& sample : samples) {
    for (PartObservation& part : sample.parts) {
      if (part.part != 5) continue;
      part.X_CB.translation() += Eigen::Vector3d(0, 0.03, 0.04);
      part.X_CB.linear() *= exp_so3({0, 0, 0.1});
    }
  }
  const Json json = run({"predict", "schema.lcmlog", write("s.csv", samples), "--json"}).json();
  const Json& part = json["parts"].back();
  EXPECT_EQ(part["part"], 5);
  EXPECT_NEAR(part["position_median_m"].get<double>(), 0.05, 1e-4);
  EXPECT_NEAR(part["position_rms_m"].get<double>(), 0.05, 1e-4);
  EXPECT_NEAR(part["rotation_median_deg"].get<double>(), 0.1 / kDegree, 1e-2);
}

TEST_F(BodyschemaProgramTest, ShowPrintsASchemaFile) {
  const Json learned =
      run({"learn", write_robot("s.csv"), "--out", "schema.lcmlog", "--json"}).json();
  const Json shown = run({"show", "schema.lcmlog", "--json"}).json();
  EXPECT_EQ(shown["parts"], learned["parts"]);
  EXPECT_EQ(shown["root"], learned["root"]);
  EXPECT_EQ(shown["samples"], learned["samples"]);
  EXPECT_EQ(shown["edges"].size(), learned["edges"].size());
  EXPECT_EQ(shown["version"], 30);
  for (const Json& edge : shown["edges"]) EXPECT_TRUE(edge.contains("joints"));
  const Outcome text = run({"show", "schema.lcmlog"});
  EXPECT_EQ(text.exit_code, 0);
  // Only `learn` knows the source of the noise.
  std::string learned_text = run({"learn", "s.csv"}).out;
  const std::string source = ", estimated from what the best models leave";
  ASSERT_NE(learned_text.find(source), std::string::npos) << learned_text;
  EXPECT_EQ(text.out, learned_text.erase(learned_text.find(source), source.size()));
}

/// Samples of a 2-DOF robot whose `parts` have random poses.
std::vector<ActionPoseSample> with_flying_parts(const std::set<int>& parts) {
  test::Rng rng(75);
  auto samples = test::babble(test::chapter_robot("a", rng), 60, {}, rng);
  for (ActionPoseSample& sample : samples) {
    for (PartObservation& part : sample.parts)
      if (parts.count(part.part)) part.X_CB = test::random_pose(rng, 0.5, 2);
  }
  return samples;
}

TEST_F(BodyschemaProgramTest, ABodyThatAdmitsNoValidModelIsIncompleteWithReasons) {
  const auto csv = write("s.csv", with_flying_parts({1, 2, 3, 4, 5}));
  const Json json =
      run({"learn", csv, "--noise", "0.003", "1", "--json", "--out", "schema.lcmlog"}).json();
  EXPECT_FALSE(json["complete"].get<bool>());
  EXPECT_EQ(json["edges"], Json::array());
  ASSERT_EQ(json["unconnected"].size(), 4U);
  for (const Json& part : json["unconnected"]) {
    EXPECT_GT(part.at("part").get<int>(), 1);
    EXPECT_NE(part.at("reason").get<std::string>().find("no valid model"), std::string::npos);
  }
  EXPECT_EQ(json["unused_signals"], Json::array());
  EXPECT_EQ(json["undecided_signals"], (Json{"q1", "q2"}));
  // Such a schema can be kept, shown and applied as well.
  EXPECT_FALSE(run({"show", "schema.lcmlog", "--json"}).json()["complete"].get<bool>());
  EXPECT_EQ(run({"predict", "schema.lcmlog", csv, "--json"}).json()["parts"], Json::array());
}

TEST_F(BodyschemaProgramTest, APartThatNoModelExplainsIsNamedAndTheOthersAreConnected) {
  const Json json = run({"learn", write("s.csv", with_flying_parts({4})), "--json"}).json();
  EXPECT_FALSE(json["complete"].get<bool>());
  EXPECT_EQ(json["edges"].size(), 3U) << json;
  ASSERT_EQ(json["unconnected"].size(), 1U) << json;
  EXPECT_EQ(json["unconnected"][0]["part"], 4);
}

TEST_F(BodyschemaProgramTest, NoiseIsNotBlamedForABodyThatMovesAtRandom) {
  const Json json =
      run({"learn", write("s.csv", with_flying_parts({1, 2, 3, 4, 5})), "--json"}).json();
  EXPECT_FALSE(json["complete"].get<bool>()) << json;
}

TEST_F(BodyschemaProgramTest, AFewSamplesAreNoError) {
  const std::string header = "t,q1,part,x,y,z,qw,qx,qy,qz\n";
  const auto one = write("one.csv", header + "0,1,3,0,0,1,1,0,0,0\n");
  const Json json = run({"learn", one, "--json", "--out", "schema.lcmlog"}).json();
  EXPECT_EQ(json["parts"], Json::array({3}));
  EXPECT_EQ(json["root"], 3);
  const auto two = write("two.csv", header + "0,1,3,0,0,1,1,0,0,0\n0,1,4,0,0,2,1,0,0,0\n");
  const Json both = run({"learn", two, "--json", "--out", "schema.lcmlog"}).json();
  EXPECT_FALSE(both["complete"].get<bool>());
  EXPECT_EQ(both["unconnected"].size(), 1U);
}

TEST_F(BodyschemaProgramTest, AnObviousOutlierIsNamed) {
  write_robot("s.csv");
  test::Rng rng(76);
  auto samples = test::babble(robot_, 40, {}, rng);
  for (PartObservation& part : samples[17].parts) {
    if (part.part == 4) part.X_CB.translation().x() += 0.5;
  }
  const Json json =
      run({"learn", write("o.csv", samples), "--noise", "0.003", "1", "--json"}).json();
  EXPECT_TRUE(test::is_right(structure_of(json), robot_));
  EXPECT_EQ(json["outliers"], Json::parse(R"([{"sample": 17, "part": 4}])"));
  EXPECT_EQ(json["noise"],
            Json::parse(R"({"position_m": 0.003, "rotation_deg": 1.0, "from": "given"})"));
}

TEST_F(BodyschemaProgramTest, TheRootIsTheLowestPartOrTheOneAskedFor) {
  const auto csv = write_robot("s.csv");
  for (const int root : {1, 3, 5}) {
    const Json json = run({"learn", csv, "--root", std::to_string(root), "--json"}).json();
    EXPECT_EQ(json["root"], root);
    EXPECT_TRUE(test::is_right(structure_of(json), robot_));
    // Every part but the root is led to once.
    std::set<int> led_to;
    for (const Json& edge : json["edges"]) EXPECT_TRUE(led_to.insert(edge["to"].get<int>()).second);
    EXPECT_FALSE(led_to.count(root));
    EXPECT_EQ(led_to.size(), 4U);
  }
}

TEST_F(BodyschemaProgramTest, SenselessOptionsAreRefused) {
  const auto csv = write_robot("s.csv");
  expect_failure({"learn", csv, "--root", "9", "--out", "schema.lcmlog"},
                 "--root: part 9 is never seen");
  for (const std::string noise : {"0", "nan", "inf"}) {
    expect_failure({"learn", csv, "--noise", noise, "1", "--out", "schema.lcmlog"}, "--noise");
    expect_failure({"learn", csv, "--noise", "0.001", noise, "--out", "schema.lcmlog"}, "--noise");
  }
  expect_failure({"learn", csv, "--noise", "-0.001", "1", "--out", "schema.lcmlog"}, "--noise");
  expect_failure({"learn", csv, "--noise", "0.001", "--out", "schema.lcmlog"}, "--noise");
  expect_failure({"learn", csv, "--speed", "3"}, "--speed");
  expect_failure({"learn"}, "SAMPLES");
  expect_failure({"predict", csv}, "SAMPLES");
  expect_failure({"forget", csv}, "bodyschema: unknown command 'forget'; there are: learn ");
  expect_failure({}, "subcommand is required");
  EXPECT_FALSE(exists("schema.lcmlog"));
}

TEST_F(BodyschemaProgramTest, ExitCodesTellWrongUsageFromABadInput) {
  const auto csv = write_robot("s.csv");
  for (const std::vector<std::string>& wrong : std::vector<std::vector<std::string>>{
           {},
           {"forget"},
           {"learn"},
           {"learn", csv, "--speed", "3"},
           {"learn", csv, "--noise", "1"},
           {"learn", csv, "--noise", "x", "1"},
           {"learn", csv, "--noise", "0", "1"},
           {"learn", csv, "--root", "1e3"},
           {"learn", csv, "--method", "magic"},
           {"target"},
           {"target", "--part", "-1", "--position", "0", "0", "0"},
           {"target", "--part", "1"},
           {"target", "--part", "1", "--tag", "40", "--position", "0", "0", "0"},
           {"target", "--part", "1", "--tag", "40", "--orientation", "1", "0", "0", "0"},
           {"target", "--part", "1", "--orientation", "1", "0", "0", "0"},
           {"target", "--part", "1", "--position", "0", "0"},
           {"target", "--part", "1", "--position", "0", "0", std::string(309, '9')},
           {"target", "--part", "1", "--position", "nan", "0", "0"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--timeout", "1e300"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--timeout", "nan"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--keep", "inf"},
           {"log"},
           {"status", "--seconds", "0"},
           {"fault", "target", "40", "0", "0"},
           {"fault", "melt"}}) {
    const Outcome outcome = run(wrong);
    EXPECT_EQ(outcome.exit_code, 2) << Json(wrong) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_LT(outcome.err.size(), 300U) << outcome.err;
  }
  for (const std::vector<std::string>& bad :
       std::vector<std::vector<std::string>>{{"learn", "none.csv"},
                                             {"learn", csv, "--root", "9"},
                                             {"show", csv},
                                             {"log", "none.lcmlog"},
                                             {"rig", "nonesuch"},
                                             {"learn", csv, "--out", "no/where"}}) {
    EXPECT_EQ(run(bad).exit_code, 1) << Json(bad);
  }
  EXPECT_NE(run({"--help"}).out.find("2 wrong usage"), std::string::npos);
}

TEST_F(BodyschemaProgramTest, ItsVersionIsAResult) {
  const Outcome outcome = run({"--version"});
  EXPECT_EQ(outcome.exit_code, 0);
  EXPECT_EQ(outcome.out.rfind("bodyschema 0.", 0), 0U) << outcome.out;
}

// It once latched the arm, and ./run stop ends the group.
TEST_F(BodyschemaProgramTest, StopDoesNothingButSayWhichIsMeant) {
  for (const std::vector<std::string>& arguments :
       {std::vector<std::string>{"stop"}, {"stop", "--in", "memq://"}}) {
    const Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.exit_code, 2);
    EXPECT_EQ(outcome.out, "");
    EXPECT_NE(outcome.err.find("`bodyschema halt` stops the arm; a group is ended by `./run stop`"),
              std::string::npos)
        << outcome.err;
  }
  EXPECT_NE(run({"stop"}, "BODYSCHEMA_COMMAND=./run ").err.find("`./run halt`"), std::string::npos);
  const std::string help = run({"--help"}).out;
  EXPECT_NE(help.find("\n  halt "), std::string::npos) << help;
  EXPECT_EQ(help.find("\n  stop "), std::string::npos) << help;
}

// Today's time-out of a target is 120 s.
TEST_F(BodyschemaProgramTest, WhereNobodyIsOnTheBusEveryCommandEndsAtOnceAndSaysWhatToType) {
  for (const std::vector<std::string>& command :
       std::vector<std::vector<std::string>>{{"target", "--part", "1", "--position", "0", "0", "0"},
                                             {"target", "--part", "1", "--tag", "40"},
                                             {"hold"},
                                             {"release"},
                                             {"halt"},
                                             {"resume"}}) {
    std::vector<std::string> arguments = command;
    arguments.insert(arguments.end(), {"--in", "memq://"});
    expect_failure(arguments, "nothing is heard on memq://: no group runs there. ./run --keep", 1);
  }
}

TEST_F(BodyschemaProgramTest, ANoiseThatIsNoneIsAskedBack) {
  const auto csv = write_robot("s.csv");
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  for (const std::vector<std::string>& command :
       std::vector<std::vector<std::string>>{{"learn", csv}, {"monitor", "schema.lcmlog", csv}}) {
    const auto expect = [&](const std::string& position, const std::string& rotation,
                            const std::string& what) {
      std::vector<std::string> arguments = command;
      arguments.insert(arguments.end(), {"--noise", position, rotation});
      expect_failure(arguments, what, 2);
    };
    expect("3", "1", "3 m is no noise of a marker; did you mean: --noise 0.003 1");
    expect("0.003", "57", "57 degrees are no noise of a marker");
    expect(std::string(309, '9'), "1", "--noise");
  }
  EXPECT_NE(run({"learn", csv, "--noise", "0.003", "0.0175"}).err.find("looks like radians"),
            std::string::npos);
  EXPECT_EQ(run({"learn", csv, "--noise", "0.0254", "6.1"}).exit_code, 0);
}

TEST_F(BodyschemaProgramTest, TheNoiseIsAlwaysToldWithWhereItIsKnownFrom) {
  const auto csv = write_robot("s.csv");
  const auto from = [&](const std::vector<std::string>& arguments) {
    std::vector<std::string> json = arguments;
    json.emplace_back("--json");
    const Json noise = run(json).json()["noise"];
    EXPECT_GT(noise["position_m"].get<double>(), 0);
    EXPECT_NE(run(arguments).out.find("noise per axis and marker: "), std::string::npos);
    return noise["from"].get<std::string>();
  };
  EXPECT_EQ(from({"learn", csv}), "residuals");
  EXPECT_EQ(from({"learn", csv, "--noise", "0.003", "1"}), "given");
  EXPECT_EQ(from({"learn", csv, "--method", "chapter"}), "residuals");
  const std::string header = "t,q1,part,x,y,z,qw,qx,qy,qz\n";
  const auto one = write("one.csv", header + "0,1,3,0,0,1,1,0,0,0\n");
  EXPECT_EQ(from({"learn", one}), "assumed");
  EXPECT_EQ(run({"learn", one}).out.find("it is less"), std::string::npos);
  test::Rng rng(79);
  std::vector<ActionPoseSample> repeats;
  for (int n = 0; n < 40; ++n) {
    Eigen::VectorXd action(2);
    action << 0.1 * (n % 4), 0.2 * (n % 4);
    repeats.push_back(test::observe(robot_, action, {.regime = test::Regime::kTagIso}, n, rng));
  }
  EXPECT_EQ(from({"learn", write("repeats.csv", repeats)}), "repeats");
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  EXPECT_NE(run({"monitor", "schema.lcmlog", csv}).err.find("mm"), std::string::npos);
  EXPECT_NE(run({"monitor", "schema.lcmlog", csv}).err.find("that of schema.lcmlog"),
            std::string::npos);
}

TEST_F(BodyschemaProgramTest, StdinAndPackedFilesAreReadLikeFiles) {
  const auto csv = write_robot("s.csv");
  const std::string expected = run({"learn", csv, "--json"}).out;
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  EXPECT_EQ(run({"learn", "-", "--json"}, "cat s.csv | ").out, expected);
  EXPECT_EQ(run({"learn", "-", "--json"}, "gzip -c s.csv | ").out, expected);
  ASSERT_EQ(run({"show", "schema.lcmlog"}, "gzip -k s.csv && ").exit_code, 0);
  EXPECT_EQ(run({"learn", "s.csv.gz", "--json"}).out, expected);
  EXPECT_EQ(run({"predict", "schema.lcmlog", "-", "--json"}, "cat s.csv | ").out,
            run({"predict", "schema.lcmlog", csv, "--json"}).out);
  const Outcome broken = run({"learn", "-"}, "head -c 90 s.csv | ");
  EXPECT_EQ(broken.exit_code, 1);
  EXPECT_EQ(broken.err.rfind("bodyschema: stdin:", 0), 0U) << broken.err;
}

TEST_F(BodyschemaProgramTest, AHintIsGivenBesideTheResultAndChangesNothing) {
  write_robot("s.csv");
  test::Rng rng(80);
  auto samples = test::babble(robot_, 30, {}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& part : sample.parts) part.X_CB.translation() *= 1000;
  const Outcome outcome = run({"learn", write("mm.csv", samples), "--json"});
  EXPECT_EQ(outcome.exit_code, 0);
  EXPECT_NE(outcome.err.find("mm.csv: positions look like millimetres"), std::string::npos);
  EXPECT_EQ(outcome.json()["samples"], 30);
}

TEST_F(BodyschemaProgramTest, HelpIsAResult) {
  for (const auto& arguments : std::vector<std::vector<std::string>>{
           {"--help"}, {"learn", "--help"}, {"predict", "--help"}, {"show", "--help"}}) {
    const Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.exit_code, 0);
    EXPECT_EQ(outcome.err, "");
    EXPECT_GT(outcome.out.size(), 100U);
  }
}

TEST_F(BodyschemaProgramTest, ABrokenFileIsPointedAtAndNothingIsWritten) {
  const std::string header = "t,q1,part,x,y,z,qw,qx,qy,qz\n";
  const std::string row = "0,1,1,0,0,0,1,0,0,0\n";
  write("schema.lcmlog", "what was there before");
  const auto expect = [&](const std::string& text, const std::string& what) {
    write("broken.csv", text);
    expect_failure({"learn", "broken.csv", "--out", "schema.lcmlog", "--json"}, what);
    EXPECT_EQ(text_of(folder_ / "schema.lcmlog"), "what was there before");
  };
  expect(header + row + "1,1,1,0,0,zero,1,0,0,0\n",
         "broken.csv:3:11: z: expected a finite number, found 'zero'");
  expect(header + row + "1,1,1,0,0,0,1,1,0,0\n", "broken.csv:3:13: qw,qx,qy,qz: expected a unit");
  expect("time,q1\n", "broken.csv:1:1: expected the header");
  expect("", "broken.csv:1:1: expected a header line");
  expect(header, "broken.csv:2:1: expected at least one row");
  // A name that JSON could not hold, after everything was learned and written.
  expect("t,\xE9paule,part,x,y,z,qw,qx,qy,qz\n" + row, "broken.csv:1:3: expected the name");
  expect_failure({"learn", "no such.csv", "--out", "new.lcmlog"}, "no such.csv: cannot be read");
  expect_failure({"learn", ".", "--out", "new.lcmlog"}, "found a folder");
  EXPECT_FALSE(exists("new.lcmlog"));
  for (const auto& entry : std::filesystem::directory_iterator(folder_)) {
    const std::string name = entry.path().filename();
    EXPECT_TRUE(name == "broken.csv" || name == "schema.lcmlog" || name == "stdout.txt" ||
                name == "stderr.txt")
        << name << " was left behind";
  }
}

TEST_F(BodyschemaProgramTest, AResultThatCannotBeWrittenIsAFailure) {
  const auto csv = write_robot("s.csv");
  expect_failure({"learn", csv, "--out", "no such folder/schema.lcmlog", "--json"},
                 "no such folder/schema.lcmlog");
  std::filesystem::create_directory(folder_ / "taken");
  expect_failure({"learn", csv, "--out", "taken", "--json"}, "taken");
  // A full disk behind stdout.
  const std::string command = "cd '" + folder_.string() + "' && '" + BODYSCHEMA_PROGRAM +
                              "' learn s.csv --json >/dev/full 2>stderr.txt";
  const int status = std::system(command.c_str());
  ASSERT_TRUE(WIFEXITED(status));
  EXPECT_NE(WEXITSTATUS(status), 0);
  EXPECT_NE(text_of(folder_ / "stderr.txt").find("stdout"), std::string::npos);
}

TEST_F(BodyschemaProgramTest, FilesOfTheWrongKindAreRefused) {
  const auto csv = write_robot("s.csv");
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  expect_failure({"learn", "schema.lcmlog"}, "schema.lcmlog: expected SAMPLE messages");
  expect_failure({"show", csv}, "s.csv");
  expect_failure({"show", "no such.lcmlog"}, "no such.lcmlog");
  expect_failure({"predict", csv, csv}, "s.csv");
  write("empty.lcmlog", "");
  expect_failure({"show", "empty.lcmlog"}, "empty.lcmlog: expected a schema");
  // Cut anywhere, a schema file is an error, never a crash.
  const std::string whole = text_of(folder_ / "schema.lcmlog");
  for (std::size_t size = 1; size < whole.size(); size += whole.size() / 12) {
    write("cut.lcmlog", whole.substr(0, size));
    expect_failure({"show", "cut.lcmlog"}, "cut.lcmlog");
  }
  // A recording of another robot.
  const auto other = write("other.csv", "t,q1,part,x,y,z,qw,qx,qy,qz\n0,1,1,0,0,0,1,0,0,0\n");
  expect_failure({"predict", "schema.lcmlog", other},
                 "other.csv: the signals of the samples are q1; those of the schema q1, q2");
  // The same one with other names.
  std::string renamed = text_of(folder_ / csv);
  renamed.replace(renamed.find("q1,q2"), 5, "q2,q3");
  expect_failure({"predict", "schema.lcmlog", write("renamed.csv", renamed)},
                 "renamed.csv: the signals of the samples are q2, q3");
}

TEST_F(BodyschemaProgramTest, ALogOfARunIsLearnedFromWithoutItsTestSamples) {
  test::Rng rng(77);
  const auto robot = test::chapter_robot("a", rng);
  const test::ObservationOptions options{
      .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
  auto samples = test::babble(robot, 40, options, rng);
  {
    LogAppender log(folder_ / "samples.lcmlog");
    for (ActionPoseSample& sample : samples) {
      if (sample.sample_index % 5 == 4) {
        sample.purpose = Purpose::kTest;
        for (PartObservation& part : sample.parts) {
          part.X_CB = test::random_pose(rng, 0, 9);
          part.X_CB_other.reset();
          part.error_ratio = 0;
        }
      }
      log.append(kSample, to_message(sample));
    }
  }
  const Json json = run({"learn", "samples.lcmlog", "--json", "--out", "schema.lcmlog"}).json();
  EXPECT_TRUE(test::is_right(structure_of(json), robot)) << json;
  EXPECT_EQ(json["samples"], 32);
  for (const Json& outlier : json["outliers"]) EXPECT_NE(outlier["sample"].get<int>() % 5, 4);
  EXPECT_EQ(run({"predict", "schema.lcmlog", "samples.lcmlog", "--json"}).json()["samples"], 40);

  // A part that only TEST samples show cannot be the root.
  std::filesystem::remove(folder_ / "samples.lcmlog");
  {
    LogAppender log(folder_ / "samples.lcmlog");
    for (ActionPoseSample& sample : samples) {
      if (sample.purpose == Purpose::kTest) {
        PartObservation phantom = PartObservation();
        phantom.part = 9;
        phantom.covariance.setIdentity();
        sample.parts.push_back(phantom);
      }
      log.append(kSample, to_message(sample));
    }
  }
  expect_failure({"learn", "samples.lcmlog", "--root", "9", "--out", "9.lcmlog"},
                 "--root: part 9 is never seen");
}

TEST_F(BodyschemaProgramTest, ALogOfNothingButTestSamplesTeachesNothing) {
  test::Rng rng(78);
  const test::ObservationOptions options{.regime = test::Regime::kTag, .with_covariances = true};
  {
    LogAppender log(folder_ / "samples.lcmlog");
    for (ActionPoseSample& sample : test::babble(test::chapter_robot("a", rng), 5, options, rng)) {
      sample.purpose = Purpose::kTest;
      log.append(kSample, to_message(sample));
    }
  }
  const Json json = run({"learn", "samples.lcmlog", "--json", "--out", "schema.lcmlog"}).json();
  EXPECT_FALSE(json["complete"].get<bool>());
  EXPECT_EQ(json["samples"], 0);
  EXPECT_TRUE(json["root"].is_null());
  EXPECT_TRUE(run({"show", "schema.lcmlog", "--json"}).json()["root"].is_null());
}

TEST_F(BodyschemaProgramTest, NoiseColumnsWeighTheObservations) {
  write_robot("s.csv", test::Regime::kTagIso);
  std::stringstream lines(text_of(folder_ / "s.csv")), with_noise;
  std::string line;
  for (bool is_header = true; std::getline(lines, line); is_header = false)
    with_noise << line << (is_header ? ",sp_m,sr_deg" : ",0.003,1") << "\n";
  const Json json = run({"learn", write("n.csv", with_noise.str()), "--json"}).json();
  EXPECT_TRUE(test::is_right(structure_of(json), robot_));
  EXPECT_EQ(json["noise"]["from"], "covariances");
  EXPECT_NEAR(json["noise"]["position_m"].get<double>(), 0.003, 1e-9);
  EXPECT_NEAR(json["noise"]["rotation_deg"].get<double>(), 1, 1e-9);
}

TEST_F(BodyschemaProgramTest, RigPrintsTheNetworkOfAGoodRigOnly) {
  const Outcome outcome = run({"rig", std::string(BODYSCHEMA_CONFIG) + "/arm2"});
  EXPECT_EQ(outcome.exit_code, 0);
  std::istringstream words(outcome.out);
  std::string kind, bus, images;
  words >> kind >> bus >> images;
  EXPECT_TRUE(kind == "private" || kind == "host") << outcome.out;
  EXPECT_EQ(bus.rfind("udpm://", 0), 0U);
  EXPECT_EQ(images.rfind("udpm://", 0), 0U);
  EXPECT_NE(bus, images);
  EXPECT_TRUE(outcome.out.ends_with("\nOK: 5 parts, 2 signals, 16 tags\n")) << outcome.out;
  EXPECT_EQ(outcome.err, "");
  expect_failure({"rig", "."}, "yaml: cannot be read", 1);
  run({"learn", write_robot("robot.csv"), "--out", "schema.lcmlog"});
  EXPECT_EQ(run({"rig", std::string(BODYSCHEMA_CONFIG) + "/arm2", "--initial", "schema.lcmlog"})
                .exit_code,
            0);
  expect_failure({"rig", std::string(BODYSCHEMA_CONFIG) + "/arm7", "--initial", "schema.lcmlog"},
                 "schema.lcmlog: it has 2 action signals");
}

TEST_F(BodyschemaProgramTest, ARigIsFoundByItsName) {
  std::filesystem::create_directory(folder_ / "config");
  std::filesystem::copy(std::string(BODYSCHEMA_CONFIG) + "/arm2", folder_ / "config" / "myarm");
  EXPECT_EQ(run({"rig", "myarm"}).exit_code, 0);
  EXPECT_EQ(run({"rig", "config/myarm"}).exit_code, 0);
  EXPECT_EQ(run({"rig", "../config/myarm"}, "cd config && ").exit_code, 0);
  expect_failure({"rig", "myram"},
                 "there is no rig 'myram'; there are: myarm; did you mean 'myarm'?", 1);
  expect_failure({"rig", "config/myram"}, "config/myram: expected the folder of a rig", 1);
  // Every problem at once, each with its place.
  write("config/myarm/motor_babbler.yaml", "choice: smart\n");
  write("config/myarm/network.yaml", "network: wifi\n");
  const Outcome outcome = run({"rig", "myarm"});
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_EQ(outcome.out, "");
  EXPECT_NE(outcome.err.find("motor_babbler.yaml:1: choice: 'smart' is none of: active, random"),
            std::string::npos)
      << outcome.err;
  EXPECT_NE(outcome.err.find("network.yaml:1: network: 'wifi'"), std::string::npos) << outcome.err;
}

TEST_F(BodyschemaProgramTest, ALogTellsItsRig) {
  const std::string log = std::string(BODYSCHEMA_LOGS) + "/arm2_15.lcmlog";
  const Outcome outcome = run({"log", log, "--rig-of", BODYSCHEMA_CONFIG});
  EXPECT_EQ(outcome.exit_code, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "arm2\n");
  std::filesystem::create_directory(folder_ / "rigs");
  const auto copy = [&](const std::string& from, const std::string& to) {
    std::filesystem::copy(BODYSCHEMA_CONFIG + from, folder_ / "rigs" / to);
  };
  copy("/arm7", "arm7");
  expect_failure({"log", log, "--rig-of", "rigs"}, "arm7: ", 1);
  copy("/arm2", "here");
  EXPECT_EQ(run({"log", log, "--rig-of", "rigs"}).out, "here\n");
  copy("/arm2", "there");
  expect_failure({"log", log, "--rig-of", "rigs"}, "may be of several rigs: here, there", 1);
  run({"learn", write_robot("s.csv"), "--out", "schema.lcmlog"});
  expect_failure({"log", "schema.lcmlog", "--rig-of", "nowhere"}, "nowhere", 1);
}

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
  // Its axes are no perfect screws: their residual, 0.3 mm, is more than its noise.
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
  EXPECT_LT(part["position_median_m"].get<double>(), 0.0005);
  EXPECT_LT(part["rotation_median_deg"].get<double>(), 0.06);
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

std::vector<Json> lines_of(const std::string& text) {
  std::vector<Json> lines;
  std::stringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(Json::parse(line));
  return lines;
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

TEST_F(BodyschemaProgramTest, MonitorFindsAStuckJointNamesItAndWritesTheRepairedSchema) {
  test::Rng rng(73);
  const test::SyntheticRobot robot = test::chapter_robot("a", rng);
  test::SyntheticRobot stuck = robot;
  for (test::TrueLink& link : stuck.links) {
    if (link.signal != 1) continue;
    Vector6d turned = Vector6d::Zero();
    turned(5) = link.turn * 0.4;
    link.X_before = link.X_before * exp(turned);
    link.signal = -1;
  }
  test::ObservationOptions options;
  options.regime = test::Regime::kTagIso;
  const auto learned = write("learned.csv", test::babble(robot, 60, options, rng));
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 80; ++n)
    samples.push_back(
        test::observe(n < 40 ? robot : stuck, robot.random_action(rng), options, n, rng));
  const auto changing = write("changing.csv", samples);
  options.regime = test::Regime::kFree;
  const auto truth = write("truth.csv", test::babble(stuck, 20, options, rng));
  run({"learn", learned, "--noise", "0.003", "1", "--out", "schema.lcmlog"});

  const Outcome outcome = run({"monitor", "schema.lcmlog", changing, "--noise", "0.003", "1",
                               "--evaluate", truth, "--out", "repaired.lcmlog", "--json"});
  ASSERT_EQ(outcome.exit_code, 0) << outcome.err;
  const std::vector<Json> lines = lines_of(outcome.out);
  int num_judged = 0;
  std::vector<std::string> causes;
  for (const Json& line : lines) {
    if (line.contains("event")) {
      EXPECT_GE(line["sample"], 40) << line;
      if (line["event"] == "candidate" || line["event"] == "refined")
        causes.push_back(line["cause"]);
      if (line["event"] == "candidate") {
        EXPECT_TRUE(line["signal"].is_string()) << line;
        EXPECT_NEAR(line["amount"]["command"].get<double>(), 0.4, 0.05) << line;
        EXPECT_GT(line["amount_sd"]["command"], 0) << line;
        EXPECT_EQ(line["since"], 40) << line;
      }
      EXPECT_TRUE(line.contains("margin") && line.contains("samples_used") && line.contains("t"));
      EXPECT_TRUE(line.contains("part") != (line.contains("from") && line.contains("to"))) << line;
      continue;
    }
    EXPECT_EQ(line["sample"], num_judged++);
    for (const Json& part : line["parts"]) {
      const double error = part["position_rms_m"];
      if (line["sample"] >= 50) {
        EXPECT_LT(error, 0.02) << line;
      }
    }
  }
  EXPECT_EQ(num_judged, 80);
  ASSERT_FALSE(causes.empty());
  EXPECT_EQ(causes.back(), "joint_stuck");
  const Json errors = run({"predict", "repaired.lcmlog", truth, "--json"}).json();
  for (const Json& part : errors["parts"]) EXPECT_LT(part["position_rms_m"], 0.02) << part;

  // The same again gives the same bytes; people get a line an event.
  EXPECT_EQ(run({"monitor", "schema.lcmlog", changing, "--noise", "0.003", "1", "--evaluate", truth,
                 "--json"})
                .out,
            outcome.out);
  const Outcome text = run({"monitor", "schema.lcmlog", changing, "--noise", "0.003", "1"});
  EXPECT_NE(text.out.find("q2 (3→4) stuck at 0."), std::string::npos) << text.out;
  EXPECT_NE(text.out.find("since sample 40: adopted"), std::string::npos) << text.out;
  EXPECT_NE(text.out.find("80 samples, "), std::string::npos) << text.out;
}

TEST_F(BodyschemaProgramTest, MonitorSaysNothingOfAHealthyBody) {
  const auto csv = write_robot("robot.csv");
  run({"learn", csv, "--out", "schema.lcmlog"});
  test::Rng rng(74);
  test::ObservationOptions options;
  options.regime = test::Regime::kTagIso;
  const auto later = write("later.csv", test::babble(robot_, 200, options, rng));
  const Outcome outcome = run({"monitor", "schema.lcmlog", later, "--json"});
  EXPECT_EQ(outcome.exit_code, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "");
}

TEST_F(BodyschemaProgramTest, PositionsAloneAreLearnedShownPredictedAndMonitored) {
  test::Rng rng(75);
  robot_ = test::chapter_robot("a", rng);
  const int leaf = robot_.visible_parts().back();
  const auto csv_of = [&](const std::string& name, int num_samples) {
    return write(name,
                 test::with_positions_alone(
                     test::babble(robot_, num_samples, {test::Regime::kTagIso}, rng), {leaf}));
  };
  const Json learned =
      run({"learn", csv_of("s.csv", 100), "--out", "schema.lcmlog", "--json"}).json();
  EXPECT_TRUE(learned["complete"].get<bool>()) << learned.dump(1);
  EXPECT_EQ(learned["position_parts"], Json({leaf}));
  for (const Json& edge : learned["edges"])
    EXPECT_EQ(edge.at("rotation_rms_deg").is_null(), edge.at("to") == leaf);
  const Json shown = run({"show", "schema.lcmlog", "--json"}).json();
  for (const Json& edge : shown["edges"]) {
    EXPECT_EQ(edge.at("rotation_sd_deg").is_null(), edge.at("to") == leaf);
    EXPECT_GT(edge.at("position_sd_m").get<double>(), 0);
  }
  EXPECT_NE(run({"show", "schema.lcmlog"}).out.find("position alone"), std::string::npos);
  const auto later = csv_of("later.csv", 150);
  const Json predicted = run({"predict", "schema.lcmlog", later, "--json"}).json();
  for (const Json& part : predicted["parts"]) {
    EXPECT_LT(part.at("position_median_m").get<double>(), 0.02);
    EXPECT_EQ(part.at("rotation_median_deg").is_null(), part.at("part") == leaf);
    EXPECT_EQ(part.at("rotation_rms_deg").is_null(), part.at("part") == leaf);
  }
  const Outcome monitored = run({"monitor", "schema.lcmlog", later, "--json"});
  EXPECT_EQ(monitored.exit_code, 0) << monitored.err;
  EXPECT_EQ(monitored.out, "");
  expect_failure({"learn", later, "--method", "chapter"}, "needs orientations", 1);
  expect_failure({"monitor", "schema.lcmlog", later, "--method", "chapter"}, "needs orientations",
                 1);
  expect_failure({"learn", write("half.csv", "t,q1,part,x,y,z,qw,qx,qy,qz\n0,0,1,0,0,0,1,,,\n")},
                 "half.csv:2:", 1);
}

TEST_F(BodyschemaProgramTest, WildPosesAreSeenWhateverRateTheRigBesideALogTells) {
  test::Rng rng(76);
  robot_ = test::chapter_robot("a", rng);
  const test::ObservationOptions options{.regime = test::Regime::kTagIso, .with_covariances = true};
  {
    LogAppender log(folder_ / "run.lcmlog");
    for (ActionPoseSample& sample : test::babble(robot_, 100, options, rng)) {
      for (PartObservation& part : sample.parts)
        if (test::uniform(rng, 0, 1) < 0.1) part.X_CB = test::random_pose(rng, 1, 2);
      log.append(kSample, to_message(sample));
    }
  }
  std::filesystem::create_directory(folder_ / "config");
  std::map<std::string, std::size_t> num_edges, events;
  for (const std::string rate : {"0.3", "0.001"}) {
    write("config/noise.yaml",
          "tag_position_m: 0\ntag_rotation_deg: 0\ntag_size_share: 0\n"
          "systematic_position_m: 0.0005\nsystematic_rotation_deg: 0.1\n"
          "corner_noise_px: 0.05\nsmall_tag_noise_px: 0.15\noutlier_rate: " +
              rate + "\n");
    std::vector<std::string> learn = {"learn", "run.lcmlog", "--json"};
    if (!exists("schema.lcmlog")) learn.insert(learn.end(), {"--out", "schema.lcmlog"});
    num_edges[rate] = run(learn).json()["edges"].size();
    events[rate] = run({"monitor", "schema.lcmlog", "run.lcmlog", "--json"}).out.size();
  }
  EXPECT_EQ(num_edges["0.3"], 4U);
  // Learner and monitor see that they are wild, whatever is told.
  EXPECT_EQ(num_edges["0.001"], 4U);
  EXPECT_EQ(events["0.3"], 0U);
  EXPECT_EQ(events["0.001"], 0U);
  write("config/noise.yaml", "tag_position_m: 0\noutlier_rate: often\n");
  expect_failure({"learn", "run.lcmlog"}, "noise.yaml");
  expect_failure({"report", "run.lcmlog"}, "noise.yaml");
}

TEST_F(BodyschemaProgramTest, MonitorRefusesWhatDoesNotBelongTogether) {
  const auto csv = write_robot("robot.csv");
  run({"learn", csv, "--out", "schema.lcmlog"});
  test::Rng rng(75);
  const auto other = write("other.csv", test::babble(test::chapter_robot("c", rng), 5, {}, rng));
  expect_failure({"monitor", "schema.lcmlog", other}, "other.csv: the signals of the samples are");
  expect_failure({"monitor", "schema.lcmlog", csv, "--evaluate", other}, "other.csv");
  expect_failure({"monitor", "schema.lcmlog", csv, "--out", csv}, "--out");
  expect_failure({"monitor", "schema.lcmlog", csv, "--out", "no such folder/out.lcmlog"},
                 "cannot write no such");
  expect_failure({"monitor", csv, csv}, "robot.csv");
  auto samples = test::babble(robot_, 5, {}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& o : sample.parts) o.part += 100;
  expect_failure({"monitor", "schema.lcmlog", write("elsewhere.csv", samples)},
                 "none of the parts of schema.lcmlog");
}

TEST_F(BodyschemaProgramTest, AnEngineeredModelPredictsTheRobotItDescribes) {
  write("robot.urdf", R"(<robot name="r"><link name="base"/><link name="arm"/>
    <joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
      <origin xyz="0 0 0.5" rpy="0 0 0"/><axis xyz="0 0 1"/>
      <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>)");
  write("placement.yaml", R"(root: 1
uncertainty: {position_m: 0.002, rotation_deg: 0.5}
signals: [{name: q, joint: j, gain: 0.5, offset: 0, lower: -2, upper: 2}]
parts:
  - {part: 1, link: base, X_LB: {position_m: [0, 0, 0]}}
  - {part: 2, link: arm, X_LB: {position_m: [0.2, 0, 0]}}
)");
  // At q = π the arm has turned by 90 degrees; the root stands 2 m in front of the camera.
  write("samples.csv",
        "t,q,part,x,y,z,qw,qx,qy,qz\n"
        "0,0,1,0,0,2,1,0,0,0\n0,0,2,0.2,0,2.5,1,0,0,0\n"
        "1,3.14159265358979,1,0,0,2,1,0,0,0\n"
        "1,3.14159265358979,2,0,0.2,2.5,0.707106781186547,0,0,0.707106781186547\n");
  const Json json = run({"engineer", "robot.urdf", "placement.yaml", "--samples", "samples.csv",
                         "--out", "schema.lcmlog", "--json"})
                        .json();
  EXPECT_NEAR(json["X_CR"]["position_m"][2].get<double>(), 2, 1e-9);
  const Json errors = run({"predict", "schema.lcmlog", "samples.csv", "--json"}).json();
  EXPECT_EQ(errors["parts"][0]["count"], 2);
  EXPECT_LT(errors["parts"][0]["position_max_m"], 1e-9);
  EXPECT_LT(errors["parts"][0]["rotation_rms_deg"], 1e-6);
}

TEST_F(BodyschemaProgramTest, AFaultWithoutASimulatorSaysSo) {
  expect_failure({"fault", "repair", "--in", "memq://"}, "no simulator is heard on memq://");
}

TEST_F(BodyschemaProgramTest, AFaultIsCheckedBeforeItIsSent) {
  expect_failure({"fault"}, "subcommand is required");
  expect_failure({"fault", "bend", "forearm"}, "DEG is required");
  expect_failure({"fault", "bend", "forearm", "91"}, "not in range");
  expect_failure({"fault", "tool", "-1"}, "not in range");
  expect_failure({"fault", "marker-lost", "twelve"}, "not in range");
  expect_failure({"fault", "melt"}, "fault: unknown command 'melt'; there are: stuck bend ");
}

TEST_F(BodyschemaProgramTest, ADriverTestWithoutADriverSaysSo) {
  const std::string rig = std::string(BODYSCHEMA_CONFIG) + "/arm2";
  expect_failure({"driver-test", "--rig-folder", rig, "--in", "memq://", "--yes"},
                 "no MOTION_STATUS within 5 s");
  expect_failure({"driver-test", "--yes"}, "--rig-folder is required");
  expect_failure({"driver-test", "--rig-folder", rig, "--kill", "x", "--restart", "y"}, "excludes");
}

}  // namespace
}  // namespace bodyschema
