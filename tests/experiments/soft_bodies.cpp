// soft_bodies: structure and error of soft arms whose sections bend by three chambers each, by the
// number of poses; or of a recorded stream, learned from every other block of time and judged by
// the blocks between, for several places of their borders. Prints a Markdown table.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <iostream>
#include <map>
#include <optional>
#include <set>
#include <sstream>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/recording/recording.h"
#include "tests/support/soft_arm.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

struct Arguments {
  std::vector<int> poses = {50, 100, 200, 400};
  int num_arms = 3;
  bool lists_wrong = false;
  std::string recording;
  int block = 128;  // instants
  std::vector<int> shifts = {0, 1, 32, 64, 96};
  std::vector<double> noise = {3, 1.5};  // [mm, °], told of the recording
};

struct Learned {
  LearnResult result;
  double cpu_s;
};

Learned learn_timed(const std::vector<Signal>& signals,
                    const std::vector<ActionPoseSample>& samples,
                    const std::optional<Noise>& noise) {
  LearnOptions options;
  options.measurement.noise = noise;
  const std::clock_t start = std::clock();
  LearnResult result = learn(signals, samples, options);
  return {std::move(result), static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC};
}

// By part: median error of position [mm] and rotation [°] in the root's frame.
std::string median_errors(const BodySchema& schema, const std::vector<ActionPoseSample>& samples) {
  std::map<int, std::vector<double>> position, rotation;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation* root = sample.find(schema.root);
    for (const PartObservation& o : sample.parts) {
      if (!root || o.part == schema.root) continue;
      const auto predicted = schema.predict(schema.root, o.part, sample.action);
      if (!predicted) continue;
      const Vector6d error = log(predicted->X_AB.inverse() * root->X_CB.inverse() * o.X_CB);
      position[o.part].push_back(1e3 * error.head<3>().norm());
      rotation[o.part].push_back(error.tail<3>().norm() / kDegree);
    }
  }
  std::string text;
  for (auto& [part, errors] : position)
    text += fmt::format("{}{:.2f} mm, {:.2f}°", text.empty() ? "" : "; ",
                        upper_median(std::move(errors)), upper_median(rotation[part]));
  return text;
}

// Not the chain 0-1-2-… where each edge has exactly its section's signals, but for those of which
// it is told that they may have no effect.
bool is_wrong(const BodySchema& schema, const SoftArm& arm) {
  const std::set<int> undecided(schema.undecided_signals.begin(), schema.undecided_signals.end());
  return std::any_of(schema.edges.begin(), schema.edges.end(), [&](const Edge& edge) {
    const std::vector<int> signals = edge.signals();
    std::set<int> differ, of_section = arm.signals_of(edge.from);
    for (const int s : signals)
      if (of_section.erase(s) == 0) differ.insert(s);
    return edge.to != edge.from + 1 || !of_section.empty() ||
           !std::includes(undecided.begin(), undecided.end(), differ.begin(), differ.end());
  });
}

// All edges are there, and of none is it open whether a signal has an effect.
bool is_sure(const BodySchema& schema) {
  return schema.complete &&
         std::none_of(schema.edges.begin(), schema.edges.end(), [&](const Edge& edge) {
           const std::vector<int> signals = edge.signals();
           return std::any_of(signals.begin(), signals.end(), [&](int s) {
             return std::binary_search(schema.undecided_signals.begin(),
                                       schema.undecided_signals.end(), s);
           });
         });
}

std::string structure_of(const BodySchema& schema, const std::vector<Signal>& signals) {
  std::string text = schema.complete ? "complete" : "incomplete";
  for (const Edge& edge : schema.edges) {
    text += fmt::format(", {}-{} {}:", edge.from, edge.to, edge.kind());
    for (const int s : edge.signals()) text += " " + signals[static_cast<std::size_t>(s)].name;
  }
  if (!schema.undecided_signals.empty()) text += "; perhaps without effect:";
  for (const int s : schema.undecided_signals)
    text += " " + signals[static_cast<std::size_t>(s)].name;
  return text;
}

void print_arms(const Arguments& arguments) {
  constexpr Noise kNoise{0.001, 0.5 * kDegree};
  fmt::print(
      "| chambers | poses | noise | right / incomplete / wrong | error, arm by arm, part 1; 2; 3 | "
      "CPU s, largest |\n|---|---|---|---|---|---|\n");
  for (const double coupling : {0.0, 0.3})
    for (const int num_poses : arguments.poses)
      for (const bool is_told : {true, false}) {
        int right = 0, incomplete = 0, wrong = 0;
        double cpu_s = 0;
        std::string errors;
        for (int seed = 1; seed <= arguments.num_arms; ++seed) {
          Rng rng(static_cast<unsigned>(seed));
          SoftArm arm;
          arm.coupling = coupling;
          arm.num_idle = coupling > 0 ? 2 : 0;
          arm.bend_rad = uniform(rng, 0.6, 1.2);
          const auto samples = arm.babble(num_poses, kNoise, rng);
          const Learned learned =
              learn_timed(arm.signals(), samples, is_told ? std::optional(kNoise) : std::nullopt);
          const BodySchema& schema = learned.result.schema;
          const bool is_bad = is_wrong(schema, arm);
          wrong += is_bad;
          if (is_bad && arguments.lists_wrong)
            std::cerr << fmt::format("arm {}, {} poses:{}\n", seed, num_poses,
                                     structure_of(schema, arm.signals()));
          right += !is_bad && is_sure(schema);
          incomplete += !is_bad && !is_sure(schema);
          cpu_s = std::max(cpu_s, learned.cpu_s);
          errors += (errors.empty() ? "" : " – ") + median_errors(schema, arm.babble(300, {}, rng));
        }
        fmt::print("| {} | {} | {} | {} / {} / {} | {} | {:.1f} |\n",
                   coupling > 0 ? "3 × 3 coupled, 2 idle" : "3 × 3", num_poses,
                   is_told ? "told" : "–", right, incomplete, wrong, errors, cpu_s);
      }
}

void print_recording(const Arguments& arguments) {
  std::ifstream in(arguments.recording);
  std::stringstream text;
  text << in.rdbuf();
  const Recording recording = parse_csv(text.str(), arguments.recording);
  fmt::print(
      "| blocks begin at | learned from | noise | structure | error in the other blocks, by part | "
      "CPU s |\n|---|---|---|---|---|---|\n");
  for (const int shift : arguments.shifts)
    for (const std::size_t which : {0, 1}) {
      std::vector<ActionPoseSample> half[2];
      for (std::size_t t = 0; t < recording.samples.size(); ++t)
        half[(t + static_cast<std::size_t>(shift)) / static_cast<std::size_t>(arguments.block) % 2]
            .push_back(recording.samples[t]);
      for (const bool is_told : {true, false}) {
        const Noise noise{1e-3 * arguments.noise[0], arguments.noise[1] * kDegree};
        const Learned learned = learn_timed(recording.signals, half[which],
                                            is_told ? std::optional(noise) : std::nullopt);
        const BodySchema& schema = learned.result.schema;
        fmt::print("| {} | {} | {} | {} | {} | {:.1f} |\n", shift, which == 0 ? "even" : "odd",
                   is_told ? "told" : "–", structure_of(schema, recording.signals),
                   median_errors(schema, half[1 - which]), learned.cpu_s);
      }
    }
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  CLI::App app("Soft bodies: structure, error, time");
  app.add_option("--poses", arguments.poses, "Poses to learn from");
  app.add_option("--arms", arguments.num_arms, "Random arms a row");
  app.add_flag("--list-wrong", arguments.lists_wrong, "Say what the wrong ones are");
  app.add_option("--recording", arguments.recording, "A stream in CSV instead")
      ->check(CLI::ExistingFile);
  app.add_option("--block", arguments.block, "Instants a block")->check(CLI::PositiveNumber);
  app.add_option("--shifts", arguments.shifts, "Instants by which the blocks' borders move")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--noise", arguments.noise, "mm and degrees told of the recording")->expected(2);
  CLI11_PARSE(app, argc, argv);
  std::setvbuf(stdout, nullptr, _IOLBF, 0);
  arguments.recording.empty() ? print_arms(arguments) : print_recording(arguments);
}
