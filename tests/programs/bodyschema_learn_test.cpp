// bodyschema learn: structures, their noise, and logs that are learned from.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
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
#include "tests/lcmtypes/example_messages.h"
#include "tests/programs/bodyschema_program.h"

namespace bodyschema::test {
namespace {

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

  write_one_event_log(folder_ / "larger.lcmlog", kBodySchema, large_schema(200));
  EXPECT_EQ(run({"show", "larger.lcmlog", "--json"}).json()["edges"].size(), 199U);
}

TEST_F(BodyschemaProgramTest, AHundredPartsAreLearnedSavedAndLoaded) {
  Rng rng(5);
  const auto robot = random_tree({.num_parts = 100, .num_hidden = 0}, rng);
  const auto csv = write("tree.csv", babble(robot, 10, {}, rng));
  const Json learned = run({"learn", csv, "--out", "large.lcmlog", "--json"}).json();
  EXPECT_TRUE(is_right(structure_of(learned), robot));
  EXPECT_GT(std::filesystem::file_size(folder_ / "large.lcmlog"), 64'000U);
  const Json shown = run({"show", "large.lcmlog", "--json"}).json();
  EXPECT_EQ(shown["edges"].size(), 99U);
  const Json parts = run({"predict", "large.lcmlog", csv, "--json"}).json()["parts"];
  ASSERT_EQ(parts.size(), 99U);
  for (const Json& part : parts) EXPECT_LT(part["position_max_m"].get<double>(), 1e-4);
}

TEST_F(BodyschemaProgramTest, LearnFindsTheStructureOfTreesWithBranchesSlidersAndSharedSignals) {
  Rng rng(72);
  int num_prismatic = 0, num_branches = 0;
  for (int run_index = 0; run_index < 10; ++run_index) {
    RandomTreeOptions tree;
    tree.num_parts = 6 + run_index % 4;
    tree.share_prismatic = 0.3;
    const auto robot = random_tree(tree, rng);
    std::map<int, int> children;
    for (const auto& link : robot.links) {
      num_prismatic += link.slide != 0 && link.turn == 0;
      num_branches += ++children[link.parent] == 2;
    }
    ObservationOptions options;
    options.regime = run_index % 2 ? Regime::kTagIso : Regime::kFree;
    const auto csv = write("tree.csv", babble(robot, 120, options, rng));
    const Json json = run({"learn", csv, "--json"}).json();
    EXPECT_TRUE(is_right(structure_of(json), robot)) << "tree " << run_index << "\n" << json;
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
        "unused_signals", "undecided_signals", "outliers", "noise", "one_cluster",
        "serial_correlation", "command_lag_s", "command_smear_s"}) {
    EXPECT_TRUE(json.contains(key)) << key;
  }
  EXPECT_EQ(json.size(), 15U);
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
  const auto csv = write_robot("s.csv", Regime::kFree);
  const Outcome outcome =
      run({"learn", csv, "--method", "chapter", "--noise", "0.001", "0.3", "--json"});
  const Json json = outcome.json();
  EXPECT_TRUE(is_right(structure_of(json), robot_)) << json;
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
  EXPECT_TRUE(is_right(structure_of(json), robot_)) << json;
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

// The camera drifts while the pose of its base, part 1, is given as a constant.
TEST_F(BodyschemaProgramTest, LearnSaysWhereWhatIsLeftLasts) {
  test::Rng rng(5);
  const auto robot = test::chapter_robot("a", rng);
  for (const double drift_m : {0.0, 0.02}) {
    auto samples = test::babble(robot, 80, {.regime = test::Regime::kTagIso}, rng);
    for (std::size_t t = 0; t < samples.size(); ++t)
      for (PartObservation& o : samples[t].parts) {
        if (o.part == 1)
          o.X_CB = robot.X_CR;
        else
          o.X_CB.translation().x() += drift_m * static_cast<double>(t) / 80;
      }
    std::ofstream file(folder_ / "drift.csv");
    test::write_csv(samples, file);
    file.close();
    const Outcome outcome = run({"learn", "drift.csv", "--noise", "0.008", "1"});
    EXPECT_EQ(outcome.out.find("lasts from one pose to the next") != std::string::npos, drift_m > 0)
        << outcome.out;
  }
}

TEST_F(BodyschemaProgramTest, TheSameRecordingGivesTheSameBytes) {
  const auto csv = write_robot("s.csv");
  const Outcome first = run({"learn", csv, "--out", "1.lcmlog", "--json"});
  const Outcome second = run({"learn", csv, "--out", "2.lcmlog", "--json"});
  EXPECT_EQ(first.out, second.out);
  EXPECT_EQ(text_of(folder_ / "1.lcmlog"), text_of(folder_ / "2.lcmlog"));
  EXPECT_FALSE(text_of(folder_ / "1.lcmlog").empty());
}

// What a recording says does not hang on the order in which it says it, nor on units and names.
/// The fields of a CSV file without quotes, line by line.
std::vector<std::vector<std::string>> rows_of(const std::string& csv) {
  std::vector<std::vector<std::string>> rows;
  std::stringstream stream(csv);
  for (std::string line; std::getline(stream, line);) {
    std::stringstream fields(line);
    for (rows.emplace_back(); std::getline(fields, rows.back().emplace_back(), ',');) {
    }
    rows.back().pop_back();
  }
  return rows;
}

std::string csv_of(const std::vector<std::string>& names,
                   const std::vector<std::vector<std::string>>& lines) {
  std::string csv;
  const auto add = [&csv](const std::vector<std::string>& fields) {
    for (const std::string& field : fields) csv += (&field == &fields[0] ? "" : ",") + field;
    csv += "\n";
  };
  add(names);
  for (const auto& line : lines) add(line);
  return csv;
}

/// What `learn --json` printed of each edge: its two parts and its signals, renamed if told so.
std::set<std::pair<std::set<std::string>, std::vector<std::string>>> edges_of(
    const Json& learned, const std::map<std::string, std::string>& renamed_to = {}) {
  const auto renamed = [&](const std::string& name) {
    return renamed_to.empty() ? name : renamed_to.at(name);
  };
  std::set<std::pair<std::set<std::string>, std::vector<std::string>>> edges;
  for (const Json& edge : learned.at("edges")) {
    std::set<std::string> parts;
    for (const char* end : {"from", "to"})
      parts.insert(renamed(std::to_string(edge.at(end).get<int>())));
    std::vector<std::string> signals;
    for (const Json& signal : edge.at("signals")) signals.push_back(renamed(signal));
    edges.emplace(parts, signals);
  }
  return edges;
}

TEST_F(BodyschemaProgramTest, OrderOfRowsUnitOfStampsAndNamesChangeNothing) {
  const std::string text = text_of(folder_ / write_robot("s.csv"));
  std::vector<std::vector<std::string>> rows = rows_of(text);
  const std::vector<std::string> header = rows.front();
  rows.erase(rows.begin());
  const auto learned = [&](const std::string& csv) {
    return run({"learn", write("other.csv", csv), "--out", "other.lcmlog", "--json"}).json();
  };
  const Json as_it_is = run({"learn", "s.csv", "--out", "schema.lcmlog", "--json"}).json();
  ASSERT_TRUE(is_right(structure_of(as_it_is), robot_)) << as_it_is;
  const std::string bytes = text_of(folder_ / "schema.lcmlog");

  Rng rng(76);
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
  EXPECT_TRUE(is_right(structure_of(shuffled), robot_)) << shuffled;

  // Signals and parts of other names, the parts in another order: the same edges.
  std::vector<std::string> names = header;
  names[1] = "turn";
  names[2] = "lift";
  other = rows;
  const std::map<std::string, std::string> renamed_to{
      {"1", "7"}, {"2", "4"}, {"3", "30"}, {"4", "2"}, {"5", "9"}, {"q1", "turn"}, {"q2", "lift"}};
  for (auto& row : other) row[3] = renamed_to.at(row[3]);
  write("other.csv", csv_of(names, other));
  const Json renamed = run({"learn", "other.csv", "--root", "7", "--json"}).json();
  EXPECT_EQ(edges_of(renamed), edges_of(as_it_is, renamed_to));
}

/// Samples of a 2-DOF robot whose `parts` have random poses.
std::vector<ActionPoseSample> with_flying_parts(const std::set<int>& parts) {
  Rng rng(75);
  auto samples = babble(chapter_robot("a", rng), 60, {}, rng);
  for (ActionPoseSample& sample : samples) {
    for (PartObservation& part : sample.parts)
      if (parts.contains(part.part)) part.X_CB = random_pose(rng, 0.5, 2);
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
  Rng rng(76);
  auto samples = babble(robot_, 40, {}, rng);
  for (PartObservation& part : samples[17].parts) {
    if (part.part == 4) part.X_CB.translation().x() += 0.5;
  }
  const Json json =
      run({"learn", write("o.csv", samples), "--noise", "0.003", "1", "--json"}).json();
  EXPECT_TRUE(is_right(structure_of(json), robot_));
  EXPECT_EQ(json["outliers"], Json::parse(R"([{"sample": 17, "part": 4}])"));
  EXPECT_EQ(json["noise"],
            Json::parse(R"({"position_m": 0.003, "rotation_deg": 1.0, "from": "given"})"));
}

TEST_F(BodyschemaProgramTest, TheRootIsTheLowestPartOrTheOneAskedFor) {
  const auto csv = write_robot("s.csv");
  for (const int root : {1, 3, 5}) {
    const Json json = run({"learn", csv, "--root", std::to_string(root), "--json"}).json();
    EXPECT_EQ(json["root"], root);
    EXPECT_TRUE(is_right(structure_of(json), robot_));
    // Every part but the root is led to once.
    std::set<int> led_to;
    for (const Json& edge : json["edges"]) EXPECT_TRUE(led_to.insert(edge["to"].get<int>()).second);
    EXPECT_FALSE(led_to.contains(root));
    EXPECT_EQ(led_to.size(), 4U);
  }
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
  Rng rng(79);
  std::vector<ActionPoseSample> repeats;
  for (int n = 0; n < 40; ++n) {
    Eigen::VectorXd action(2);
    action << 0.1 * (n % 4), 0.2 * (n % 4);
    repeats.push_back(observe(robot_, action, {.regime = Regime::kTagIso}, n, rng));
  }
  EXPECT_EQ(from({"learn", write("repeats.csv", repeats)}), "repeats");
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  EXPECT_NE(run({"monitor", "schema.lcmlog", csv}).err.find("mm"), std::string::npos);
  EXPECT_NE(run({"monitor", "schema.lcmlog", csv}).err.find("that of schema.lcmlog"),
            std::string::npos);
}

TEST_F(BodyschemaProgramTest, ALogOfARunIsLearnedFromWithoutItsTestSamples) {
  Rng rng(77);
  const auto robot = chapter_robot("a", rng);
  const ObservationOptions options{
      .regime = Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
  auto samples = babble(robot, 40, options, rng);
  {
    LogAppender log(folder_ / "samples.lcmlog");
    for (ActionPoseSample& sample : samples) {
      if (sample.sample_index % 5 == 4) {
        sample.purpose = Purpose::kTest;
        for (PartObservation& part : sample.parts) {
          part.X_CB = random_pose(rng, 0, 9);
          part.X_CB_other.reset();
          part.error_ratio = 0;
        }
      }
      log.append(kSample, to_message(sample));
    }
  }
  const Json json = run({"learn", "samples.lcmlog", "--json", "--out", "schema.lcmlog"}).json();
  EXPECT_TRUE(is_right(structure_of(json), robot)) << json;
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
  Rng rng(78);
  const ObservationOptions options{.regime = Regime::kTag, .with_covariances = true};
  {
    LogAppender log(folder_ / "samples.lcmlog");
    for (ActionPoseSample& sample : babble(chapter_robot("a", rng), 5, options, rng)) {
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
  write_robot("s.csv", Regime::kTagIso);
  std::stringstream lines(text_of(folder_ / "s.csv")), with_noise;
  std::string line;
  for (bool is_header = true; std::getline(lines, line); is_header = false)
    with_noise << line << (is_header ? ",sp_m,sr_deg" : ",0.003,1") << "\n";
  const Json json = run({"learn", write("n.csv", with_noise.str()), "--json"}).json();
  EXPECT_TRUE(is_right(structure_of(json), robot_));
  EXPECT_EQ(json["noise"]["from"], "covariances");
  EXPECT_NEAR(json["noise"]["position_m"].get<double>(), 0.003, 1e-9);
  EXPECT_NEAR(json["noise"]["rotation_deg"].get<double>(), 1, 1e-9);
}

}  // namespace
}  // namespace bodyschema::test
