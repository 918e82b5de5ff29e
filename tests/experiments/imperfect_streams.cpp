// What the monitor says of robots that no model of ours describes: chains of 3 to 7 joints, one
// imperfection a row. The schema is learned from the robot itself; then it works healthy, then one
// link is bent. Counts events of the healthy robot, and after the fault those at other places;
// prints Markdown.
//
//   imperfect_streams [--robots 10] [--healthy 1000] [--broken 60] [--cell WORDS]

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <map>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/imperfect_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

constexpr int kTraining = 100;  // samples
constexpr Noise kTold{0.003, 1 * kDegree};

struct Count {
  int num_robots = 0, num_wrong_schemas = 0;
  int num_samples = 0, num_alarms = 0, num_robots_alarmed = 0;
  std::map<std::string, int> kinds;  ///< of the alarms, by kind and cause
  int num_found = 0, num_elsewhere = 0;
};

/// The edge or the marker that an event is about is the one of `part`.
bool is_at(const AdaptationEvent& event, int part) {
  return event.part == part || (event.part < 0 && event.to == part);
}

void watch(ImperfectRobot* robot, int num_joints, int num_healthy, int num_broken, Count* count) {
  LearnOptions learning;
  learning.root = 1;
  learning.measurement.noise = kTold;
  const BodySchema schema = learn(robot->signals(), robot->babble(kTraining), learning).schema;
  ++count->num_robots;
  if (!schema.complete || judge(schema, robot->structure()) != Rightness::kRight) {
    ++count->num_wrong_schemas;
    return;
  }
  AdaptationOptions options;
  options.measurement.noise = kTold;
  Adaptation adaptation(schema, options);
  const int before = count->num_alarms;
  for (int n = 0; n < num_healthy; ++n)
    for (const AdaptationEvent& event : adaptation.on_sample(robot->go(robot->random_action()))) {
      if (event.kind == AdaptationEvent::Kind::kProbeWanted) continue;
      ++count->num_alarms;
      ++count->kinds[std::string(name_of(event.kind)) + " " + event.cause];
    }
  count->num_samples += num_healthy;
  count->num_robots_alarmed += count->num_alarms > before;

  const int part = 2 + num_joints / 2;
  robot->bend(part, 0.03, 20 * kDegree);
  bool is_found = false;
  for (int n = 0; n < num_broken; ++n)
    for (const AdaptationEvent& event : adaptation.on_sample(robot->go(robot->random_action()))) {
      if (event.kind == AdaptationEvent::Kind::kProbeWanted) continue;
      is_found |= is_at(event, part);
      count->num_elsewhere += !is_at(event, part);
    }
  count->num_found += is_found;
}

}  // namespace

int main(int argc, char** argv) {
  int num_robots = 10, num_healthy = 1000, num_broken = 60;
  std::string cell;
  CLI::App app("A monitor of robots that are not as our models are");
  app.add_option("--robots", num_robots, "A row")->check(CLI::PositiveNumber);
  app.add_option("--healthy", num_healthy, "Samples before the fault")->check(CLI::PositiveNumber);
  app.add_option("--broken", num_broken, "Samples after it")->check(CLI::PositiveNumber);
  app.add_option("--cell", cell, "Rows whose name has these words alone");
  CLI11_PARSE(app, argc, argv);

  std::printf(
      "| imperfection | not learned | false events per 1000 samples | robots with one | of them | "
      "bent link found | events elsewhere |\n| --- | --- | --- | --- | --- | --- | --- |\n");
  for (const Imperfection& imperfection : imperfections()) {
    if (imperfection.name.find(cell) == std::string::npos) continue;
    Count count;
    for (int r = 0; r < num_robots; ++r) {
      const int num_joints = 3 + r % 5;
      ImperfectRobot robot(num_joints, true, imperfection, static_cast<std::uint64_t>(500 + r));
      watch(&robot, num_joints, num_healthy, num_broken, &count);
    }
    const int num_watched = count.num_robots - count.num_wrong_schemas;
    std::string kinds;
    for (const auto& [kind, number] : count.kinds)
      kinds += (kinds.empty() ? "" : ", ") + std::to_string(number) + " " + kind;
    std::printf("| %s | %d of %d | %.2f | %d of %d | %s | %d of %d | %d |\n",
                imperfection.name.c_str(), count.num_wrong_schemas, count.num_robots,
                1e3 * count.num_alarms / std::max(count.num_samples, 1), count.num_robots_alarmed,
                num_watched, kinds.empty() ? "–" : kinds.c_str(), count.num_found, num_watched,
                count.num_elsewhere);
    std::fflush(stdout);
  }
}
