// online_table: cost of one new sample online. Prints a Markdown table, one row per range of N:
// the processor time of one thread from a SAMPLE to its LEARNED_SCHEMA, both as messages; that of
// the preparation for the next one in the idle time between; the share of
// right structures.
//
// online_table [ROBOT REGIME LAST_N NUM_SEEDS]      d tag 200 5

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <functional>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

double seconds_of(const std::function<void()>& act) {
  const std::clock_t start = std::clock();
  act();
  return static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
}

struct Row {
  std::vector<double> learning_s, preparing_s;
  int right = 0;
};

double median(std::vector<double> values) {
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

}  // namespace

int main(int argc, char** argv) {
  const std::string robot_name = argc > 1 ? argv[1] : "d";
  ObservationOptions observation{.with_covariances = true};
  observation.regime = Regime::kTag;
  for (const Regime regime : {Regime::kFree, Regime::kChapter, Regime::kTag, Regime::kTagIso})
    if (argc > 2 && argv[2] == std::string(name_of(regime))) observation.regime = regime;
  const int last_n = argc > 3 ? std::stoi(argv[3]) : 200;
  const int num_seeds = argc > 4 ? std::stoi(argv[4]) : 5;
  const std::vector<int> ends = {10, 20, 30, 50, 100, 200, 500, 1000, 2000, 5000};
  std::vector<Row> rows(ends.size());
  for (int seed = 1; seed <= num_seeds; ++seed) {
    Rng rng(seed);
    const SyntheticRobot robot = chapter_robot(robot_name, rng);
    StructureLearner learner({.signals = robot.signals, .options = {}});
    for (const ActionPoseSample& sample : babble(robot, last_n, observation, rng)) {
      const int n = static_cast<int>(sample.sample_index) + 1;
      const sample_t message = to_message(sample);
      body_schema_t schema;
      const double learning_s = seconds_of([&] {
        learner.on_sample(message);
        schema = learner.take_job()();
      });
      const double preparing_s = seconds_of([&] { learner.take_preparation()(); });
      if (n < 5) continue;
      Row& row = rows[std::lower_bound(ends.begin(), ends.end(), n) - ends.begin()];
      row.learning_s.push_back(learning_s);
      row.preparing_s.push_back(preparing_s);
      row.right += is_right(from_message(schema), robot);
    }
  }
  std::printf(
      "| N | SAMPLE to LEARNED_SCHEMA, median | worst | over 20 ms | preparation, median | "
      "worst | right |\n|---|---|---|---|---|---|---|\n");
  for (std::size_t r = 0; r < rows.size(); ++r) {
    const Row& row = rows[r];
    if (row.learning_s.empty()) continue;
    const auto slow = std::count_if(row.learning_s.begin(), row.learning_s.end(),
                                    [](double s) { return s > 0.020; });
    std::printf("| %d … %d | %.1f ms | %.1f ms | %.1f %% | %.0f ms | %.0f ms | %.0f %% |\n",
                r == 0 ? 5 : ends[r - 1] + 1, std::min(ends[r], last_n),
                1e3 * median(row.learning_s),
                1e3 * *std::max_element(row.learning_s.begin(), row.learning_s.end()),
                100.0 * static_cast<double>(slow) / static_cast<double>(row.learning_s.size()),
                1e3 * median(row.preparing_s),
                1e3 * *std::max_element(row.preparing_s.begin(), row.preparing_s.end()),
                100.0 * row.right / static_cast<double>(row.learning_s.size()));
  }
}
