#pragma once

#include <fstream>
#include <sstream>
#include <string>
#include <vector>

#include "tests/programs/program_test.h"
#include "tests/support/synthetic_robot.h"

// What the tests of the program `bodyschema` have in common: a folder, its files, and the program
// run in it.

namespace bodyschema::test {

/// The structure that `learn --json` printed, in the form that judge() reads.
inline BodySchema structure_of(const Json& json) {
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

class BodyschemaProgramTest : public ProgramTest {
 protected:
  Outcome run(const std::vector<std::string>& arguments, const std::string& before = "") const {
    return ProgramTest::run(in_quotes(arguments), before);
  }
  void expect_failure(const std::vector<std::string>& arguments, const std::string& what,
                      int exit_code = 0) const {
    ProgramTest::expect_failure(in_quotes(arguments), what, exit_code);
  }

  std::string write(const std::string& name, const std::string& text) const {
    std::ofstream(folder_ / name, std::ios::binary) << text;
    return name;
  }
  std::string write(const std::string& name, const std::vector<ActionPoseSample>& samples) const {
    std::stringstream text;
    write_csv(samples, text);
    return write(name, text.str());
  }
  /// 30 samples of a 2-DOF robot.
  std::string write_robot(const std::string& name, Regime regime = Regime::kTagIso) {
    Rng rng(71);
    robot_ = chapter_robot("a", rng);
    ObservationOptions options;
    options.regime = regime;
    return write(name, babble(robot_, 30, options, rng));
  }

  SyntheticRobot robot_;

 private:
  static std::string in_quotes(const std::vector<std::string>& arguments) {
    std::string text;
    for (const std::string& argument : arguments) text += "'" + argument + "' ";
    return text;
  }
};

inline std::vector<Json> lines_of(const std::string& text) {
  std::vector<Json> lines;
  std::stringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(Json::parse(line));
  return lines;
}

}  // namespace bodyschema::test
