// The refiner beside the learner: errors of the end effector over random robots, beside the
// Cramér–Rao bound, with the coverage of the ellipsoids that they predict; the rig arm7 from
// rendered images, with errors of its tags and its lens; a real recording. Prints Markdown.
//
//   refinement robots [--robots 100] [--kinds a c d] [--noise tag flips chapter]
//     [--samples 10 20 30 50 100]
//   refinement nominal [--robots 100]
//   refinement rig config/arm7 [--seeds 10]
//   refinement recording CSV

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <map>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "common/config/calibration_id.h"
#include "common/config/rig.h"
#include "common/estimation/chi_square.h"
#include "common/estimation/evaluation.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "common/scene/calibration_error.h"
#include "common/scene/robot.h"
#include "processes/refiner/proposed_files.h"
#include "processes/refiner/refine.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/recording/recording.h"
#include "tests/experiments/figures/cramer_rao.h"
#include "tests/experiments/figures/robots.h"
#include "tests/support/random_arm.h"
#include "tests/support/rendered_run.h"

using namespace bodyschema;

namespace {

using experiments::Trial;

/// Processor time of this one thread.
double seconds_since(std::clock_t begin) {
  return static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC;
}

/// Errors of one method's end effector over robots.
struct Errors {
  double squares = 0;
  int num_inside = 0, num = 0;  ///< of the ellipsoids of 95 %
  double seconds = 0;

  double rms_mm() const { return 1e3 * std::sqrt(squares / std::max(num, 1)); }
  double coverage() const { return 100.0 * num_inside / std::max(num, 1); }

  /// Of its pose in the root's frame; `in_camera`: of that in the camera's, the root was never
  /// seen.
  void add(const BodySchema& schema, const Trial& trial, bool in_camera = false) {
    const double limit = chi_square_quantile(6, 0.05);
    for (const Eigen::VectorXd& action : trial.test_actions) {
      const auto truth = trial.robot.poses_in_camera(action);
      const auto predicted = schema.predict(trial.root(), trial.end_effector(), action);
      const Pose& X_CR = in_camera ? schema.X_CR : truth.at(trial.root());
      const Vector6d error =
          log(predicted->X_AB.inverse() * (X_CR.inverse() * truth.at(trial.end_effector())));
      squares += error.head<3>().squaredNorm();
      num_inside += squared_mahalanobis(error, predicted->covariance) < limit ? 1 : 0;
      ++num;
    }
  }
};

/// 10 % of the poses turned over.
std::vector<ActionPoseSample> with_flips(std::vector<ActionPoseSample> samples, test::Rng& rng) {
  for (ActionPoseSample& sample : samples)
    for (PartObservation& observation : sample.parts)
      if (test::uniform(rng, 0, 1) < 0.1)
        observation.X_CB.linear() *=
            exp_so3(test::uniform(rng, 10, 60) * kDegree * Eigen::Vector3d::UnitX());
  return samples;
}

void compare(const std::string& kind, test::Regime regime, bool has_flips,
             const std::vector<int>& sizes, int num_robots) {
  for (const int size : sizes) {
    Errors learned, refined;
    double bounds = 0;
    int num_right = 0;
    for (int seed = 1; seed <= num_robots; ++seed) {
      test::Rng rng(seed);
      const Trial trial = experiments::make_trial(kind, regime, size, seed);
      const std::vector<ActionPoseSample> samples =
          has_flips ? with_flips(trial.samples, rng) : trial.samples;
      const BodySchema schema = learn(trial.robot.signals, samples).schema;
      if (!test::is_right(schema, trial.robot)) continue;
      experiments::CramerRao bound(trial.robot);
      for (const ActionPoseSample& sample : trial.samples) bound.add(sample);
      const double limit = experiments::position_bound_rms(
          bound, trial.root(), trial.end_effector(), trial.test_actions);
      if (!std::isfinite(limit)) continue;
      ++num_right;
      bounds += limit * limit;
      learned.add(schema, trial);
      const std::clock_t begin = std::clock();
      const Refinement result = refine(schema, refiner_samples(samples), {}, {});
      refined.seconds += seconds_since(begin);
      refined.add(result.schema, trial);
    }
    const double bound_mm = 1e3 * std::sqrt(bounds / std::max(num_right, 1));
    std::printf(
        "| %s | %s%s | %d | %d of %d | %.3f | %.3f | %.3f | %.2f | %.2f | %.1f | %.1f | %.0f |\n",
        kind.c_str(), test::name_of(regime), has_flips ? ", 10 % flips" : "", size, num_right,
        num_robots, bound_mm, learned.rms_mm(), refined.rms_mm(), learned.rms_mm() / bound_mm,
        refined.rms_mm() / bound_mm, learned.coverage(), refined.coverage(),
        1e3 * refined.seconds / std::max(num_right, 1));
    std::fflush(stdout);
  }
}

void run_robots(const std::vector<std::string>& kinds, const std::vector<std::string>& noise,
                const std::vector<int>& sizes, int num_robots) {
  std::printf(
      "Robots of the chapter whose structure was found; rms over robots and test poses of the end "
      "effector's position, coverage of the predicted ellipsoids of 95 %%.\n\n"
      "| robot | noise | N | robots | bound mm | learned mm | refined mm | learned / bound | "
      "refined / bound | coverage learned %% | coverage refined %% | ms |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const std::string& kind : kinds)
    for (const std::string& of : noise)
      compare(kind, of == "chapter" ? test::Regime::kChapter : test::Regime::kTag, of == "flips",
              sizes, num_robots);
}

/// A model as built, every length and angle of it off by 5 mm and 1° per axis; the arm's base and
/// end alone are seen, or its end alone.
void refine_nominal(bool sees_base, int num_samples, int num_robots) {
  Errors nominal, refined;
  double bounds = 0;
  int num_undetermined = 0;
  for (int seed = 1; seed <= num_robots; ++seed) {
    test::Rng rng(seed);
    Trial trial;
    trial.robot = test::random_arm({.num_joints = 7, .share_sliding = 0}, rng);
    trial.samples = test::babble(trial.robot, num_samples,
                                 {.regime = test::Regime::kTag, .with_covariances = true}, rng);
    for (int n = 0; n < experiments::kTestPoses; ++n)
      trial.test_actions.push_back(trial.robot.random_action(rng));
    const int base = trial.root(), end = trial.end_effector();
    if (!sees_base)
      for (ActionPoseSample& sample : trial.samples)
        std::erase_if(sample.parts, [&](const PartObservation& o) { return o.part == base; });
    BodySchema schema = test::true_schema(trial.robot);
    schema.X_CR = trial.robot.X_CR;
    schema.parts = {base, end};
    schema.edges = {trial.robot.true_edge(base, end)};
    const auto moved = [&](const Pose& X) {
      Vector6d step = test::gaussian6(rng);
      step.head<3>() *= 0.005;
      step.tail<3>() *= kDegree;
      return Pose(X * exp(step));
    };
    schema.edges[0].left = moved(schema.edges[0].left);
    for (ScrewJoint& joint : schema.edges[0].joints) joint.X_after = moved(joint.X_after);
    experiments::CramerRao bound(trial.robot, true);
    for (const ActionPoseSample& sample : trial.samples) bound.add(sample);
    for (const Eigen::VectorXd& q : trial.test_actions)
      bounds += (sees_base ? bound.bound(base, end, q) : bound.bound_in_camera(end, q))
                    .topLeftCorner<3, 3>()
                    .trace() /
                experiments::kTestPoses;
    nominal.add(schema, trial, !sees_base);
    const std::clock_t begin = std::clock();
    const Refinement result = refine(schema, refiner_samples(trial.samples), {}, {});
    refined.seconds += seconds_since(begin);
    refined.add(result.schema, trial, !sees_base);
    num_undetermined += static_cast<int>(result.undetermined.size());
  }
  const double bound_mm = 1e3 * std::sqrt(bounds / num_robots);
  std::printf("| %s | %d | %d | %.3f | %.3f | %.3f | %.2f | %.1f | %d | %.0f |\n",
              sees_base ? "base and end" : "end alone", num_samples, num_robots, bound_mm,
              nominal.rms_mm(), refined.rms_mm(), refined.rms_mm() / bound_mm, refined.coverage(),
              num_undetermined, 1e3 * refined.seconds / num_robots);
  std::fflush(stdout);
}

void run_nominal(int num_robots) {
  std::printf(
      "Arms of seven joints, tag noise, base and end seen or the end alone; the model as built is "
      "off by 5 mm and 1° per axis and link. Rms over robots and test poses of the end's position "
      "in the base's frame, or in the camera's where the base was never seen; coverage of the "
      "predicted ellipsoids of 95 %%; edges with a direction that the samples do not tell.\n\n"
      "| seen | N | robots | bound mm | as built mm | refined mm | refined / bound | coverage %% | "
      "undetermined | ms |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const bool sees_base : {true, false})
    for (const int size : {30, 60, 100}) refine_nominal(sees_base, size, num_robots);
}

std::filesystem::path copy_of(const std::filesystem::path& rig, const std::string& name) {
  const auto folder = std::filesystem::temp_directory_path() / name;
  std::filesystem::remove_all(folder);
  std::filesystem::copy(rig, folder, std::filesystem::copy_options::recursive);
  return folder;
}

/// A copy of a rig whose joints go where they are told: tags and lens alone are off.
std::filesystem::path without_backlash(const std::filesystem::path& rig) {
  const auto folder = copy_of(rig, "refinement_rig");
  std::ifstream in(folder / "robot.yaml");
  std::string text, line;
  while (std::getline(in, line)) {
    for (const char* key : {"backlash_deg:", "droop_percent:"})
      if (const auto at = line.find(key); at != std::string::npos)
        line = line.substr(0, at) + key + " 0";
    text += line + "\n";
  }
  in.close();
  std::ofstream(folder / "robot.yaml") << text;
  return folder;
}

struct Seen {
  std::vector<RefinerSample> samples;
  std::vector<ActionPoseSample> truth, held_out;
};

/// `first`: so many samples of the run are passed over.
Seen run_of(const std::filesystem::path& rig, int seed, bool is_ideal, int num_samples,
            int first = 0) {
  test::RenderedRun run(rig, seed, {}, std::nullopt, is_ideal);
  for (int n = 0; n < first; ++n) run.next();
  Seen seen;
  for (int n = 0; n < num_samples; ++n) {
    const test::RenderedRun::Step step = run.next();
    seen.samples.push_back(refiner_sample(step.message));
    ActionPoseSample exact = step.sample;
    exact.parts.clear();
    for (const auto& [part, X_CB] : step.truth) {
      PartObservation& observation = exact.parts.emplace_back();
      observation.part = part;
      observation.X_CB = X_CB;
    }
    if (exact.purpose == Purpose::kTest) seen.held_out.push_back(exact);
    seen.truth.push_back(std::move(exact));
  }
  return seen;
}

/// Root mean squares over seeds and tags of how far a tag is from where it truly is, relative to
/// the others of its part that were seen as often.
struct TagErrors {
  std::vector<double> position_m, rotation_rad, focal;

  void add(const RigCalibration& found, const Robot& truth,
           const std::vector<RefinerSample>& seen) {
    std::map<int, int> num_seen;
    for (const RefinerSample& sample : seen)
      for (const TagSight& sight : sample.tags) ++num_seen[sight.tag];
    focal.push_back(std::abs(found.camera.fx / truth.lens.fx - 1));
    for (const TagPlacement& one : truth.markers.tags)
      for (const TagPlacement& other : truth.markers.tags) {
        if (one.part != other.part || one.id >= other.id) continue;
        if (std::min(num_seen[one.id], num_seen[other.id]) < 10) continue;
        const Pose expected = one.X_BM->inverse() * *other.X_BM;
        const Vector6d error =
            log(expected.inverse() * found.markers.find(one.id)->X_BM->inverse() *
                *found.markers.find(other.id)->X_BM);
        // Of one tag: a difference has the errors of two.
        position_m.push_back(error.head<3>().norm() / std::sqrt(6));
        rotation_rad.push_back(error.tail<3>().norm() / std::sqrt(6));
      }
  }
  std::string text() const {
    if (position_m.empty()) return "–";
    const auto rms = [](const std::vector<double>& values) {
      double sum = 0;
      for (const double value : values) sum += value * value;
      return std::sqrt(sum / static_cast<double>(values.size()));
    };
    char buffer[100];
    std::snprintf(buffer, sizeof buffer, "%.3f mm, %.3f°, f %.3f %%", rms(position_m) * 1e3,
                  rms(rotation_rad) / kDegree, rms(focal) * 100);
    return buffer;
  }
};

struct RigRow {
  std::vector<double> aligned_m, aligned_rad, unaligned_m, scale, px, seconds;
  std::vector<double> squared;  ///< d² of the true pose by the predicted covariance, unaligned
  TagErrors tags;

  void add_errors(const BodySchema& schema, const Seen& seen, int end_effector) {
    const JudgedErrors errors = judge(schema, seen.held_out, seen.truth);
    for (const PartErrors& part : errors.aligned_parts)
      if (part.part == end_effector) {
        aligned_m.push_back(part.position_median_m);
        aligned_rad.push_back(part.rotation_median_rad);
      }
    for (const PartErrors& part : errors.parts)
      if (part.part == end_effector) unaligned_m.push_back(part.position_median_m);
    if (errors.alignment) scale.push_back(errors.alignment->scale);
    for (const ActionPoseSample& exact : seen.held_out) {
      const auto predicted = schema.predict(schema.root, end_effector, exact.action);
      const Pose truth = exact.find(schema.root)->X_CB.inverse() * exact.find(end_effector)->X_CB;
      squared.push_back(
          squared_mahalanobis(log(predicted->X_AB.inverse() * truth), predicted->covariance));
    }
  }
  void print(const std::string& name) const {
    const auto of = [](const std::vector<double>& values) {
      return values.empty() ? NAN : median(values);
    };
    const auto known = [&](const std::vector<double>& values) {
      return values.empty() ? std::string("–") : fmt::format("{:.3f}", median(values));
    };
    const double worst =
        aligned_m.empty() ? NAN : *std::max_element(aligned_m.begin(), aligned_m.end());
    std::printf("| %s | %.4f mm, %.4f° | %.4f mm | %.3f mm | %.5f | %.1f | %s | %s | %s |\n",
                name.c_str(), of(aligned_m) * 1e3, of(aligned_rad) / kDegree, worst * 1e3,
                of(unaligned_m) * 1e3, of(scale), of(squared), known(px).c_str(),
                tags.text().c_str(), known(seconds).c_str());
    std::fflush(stdout);
  }
};

void refine_rig(const std::string& name, const std::filesystem::path& folder, bool is_ideal,
                int num_seeds, int num_samples) {
  const RigCalibration rig = load_calibration(folder);
  const RigNoise noise = load_noise(folder, is_ideal ? "ideal_noise.yaml" : "noise.yaml");
  const Signals signals = load_signals(folder);
  const auto learned_from = [&](const Seen& seen) {
    std::vector<ActionPoseSample> training;
    for (const RefinerSample& sample : seen.samples)
      if (is_learned_from(sample.sample)) training.push_back(sample.sample);
    LearnOptions learning;
    learning.root = signals.root_part;
    learning.measurement = noise.measurement;
    return learn(signals.signals, training, learning).schema;
  };
  RigRow learned, refined, all, next;
  for (int seed = 1; seed <= num_seeds; ++seed) {
    const Seen seen = run_of(folder, seed, is_ideal, num_samples);
    Robot truth = load_robot(folder, signals, rig.markers);
    if (!is_ideal) truth = with_calibration_error(truth, seed);
    const std::clock_t begin = std::clock();
    const BodySchema schema = learned_from(seen);
    learned.seconds.push_back(seconds_since(begin));
    learned.add_errors(schema, seen, signals.end_effector_part);
    for (const bool is_all : {false, true}) {
      RefineOptions options;
      options.placements = options.intrinsics = is_all;
      options.measurement = noise.measurement;
      options.corner_noise = {noise.corner_noise_px, noise.small_tag_noise_px};
      const std::clock_t refining = std::clock();
      const Refinement result = refine(schema, seen.samples, rig, options);
      RigRow& row = is_all ? all : refined;
      row.add_errors(result.schema, seen, signals.end_effector_part);
      row.seconds.push_back(seconds_since(refining));
      row.px.push_back(result.after.px_rms.value_or(NAN));
      if (!is_all) learned.px.push_back(result.before.px_rms.value_or(NAN));
      row.tags.add(result.rig, truth, seen.samples);
      if (!is_all || is_ideal) continue;
      const auto adopted = copy_of(folder, "refinement_adopted");
      write_proposed_files(result.rig, adopted);
      const Seen more = run_of(adopted, seed, false, num_samples, num_samples);
      next.add_errors(learned_from(more), more, signals.end_effector_part);
    }
  }
  learned.print(name + ", learned");
  refined.print(name + ", refined");
  all.print(name + ", with placements and intrinsics");
  if (!is_ideal) next.print(name + ", these adopted, learned from the next samples");
}

void run_rig(const std::filesystem::path& rig, int num_seeds, int num_samples) {
  std::printf(
      "%s, %d samples, every fifth TEST, %d seeds. End effector against the truth: median over "
      "TEST actions aligned (CONTRACT: one transform a frame, one scale), median and worst seed; "
      "unaligned; scale; median of d² of the truth, unaligned, by the predicted covariance (χ²₆: "
      "5.3). Corners of TEST samples; tags relative to others of their part, per axis, "
      "and focal length, rms.\n\n"
      "| case | aligned | worst seed | unaligned | scale | d² | corners px | tags, focal length | "
      "s |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- |\n",
      rig.filename().c_str(), num_samples, num_seeds);
  refine_rig("ideal", rig, true, num_seeds, num_samples);
  refine_rig("tags and lens", without_backlash(rig), false, num_seeds, num_samples);
  refine_rig("also backlash and droop", rig, false, num_seeds, num_samples);
}

void run_recording(const std::string& file) {
  const Recording recording = load_recording(file);
  std::vector<ActionPoseSample> training, held_out;
  for (std::size_t n = 0; n < recording.samples.size(); ++n)
    (n % 10 < 7 ? training : held_out).push_back(recording.samples[n]);
  LearnOptions options;
  options.measurement = recording.measurement;
  const BodySchema schema = learn(recording.signals, training, options).schema;
  RefineOptions refining;
  refining.measurement = recording.measurement;
  if (!recording.has_noise) refining.measurement.noise = schema.noise;
  std::vector<RefinerSample> samples = refiner_samples(training);
  for (RefinerSample& seen : refiner_samples(held_out)) {
    seen.sample.purpose = Purpose::kTest;
    samples.push_back(seen);
  }
  BodySchema screws = schema;
  for (Edge& edge : screws.edges) edge.residual_gp.reset();
  std::printf(
      "%s: %zu instants fitted, %zu held out. Screws alone, and with the Gaussian process that the "
      "learner finds in what they leave.\n\n"
      "| part | edges | learned rms mm | learned rms ° | refined rms mm | refined rms ° |\n"
      "| --- | --- | --- | --- | --- | --- |\n",
      std::filesystem::path(file).filename().c_str(), training.size(), held_out.size());
  for (const auto& [name, start] :
       {std::pair<const char*, const BodySchema*>{"screws", &screws}, {"as learned", &schema}}) {
    const Refinement result = refine(*start, samples, {}, refining);
    for (std::size_t p = 0; p < result.after.parts.size(); ++p) {
      const PartErrors &before = result.before.parts[p], &after = result.after.parts[p];
      std::printf("| %d | %s | %.3f | %.4f | %.3f | %.4f |\n", after.part, name,
                  before.position_rms_m * 1e3, before.rotation_rms_rad / kDegree,
                  after.position_rms_m * 1e3, after.rotation_rms_rad / kDegree);
    }
  }
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("the refiner beside the learner");
  app.require_subcommand(1);
  int num_robots = 100, num_seeds = 10, num_samples = 100;
  std::string rig, file;
  std::vector<std::string> kinds{"a", "c", "d"}, noise{"tag", "flips", "chapter"};
  std::vector<int> sizes{10, 20, 30, 50, 100};
  CLI::App* robots = app.add_subcommand("robots", "random robots beside the Cramér–Rao bound");
  robots->add_option("--robots", num_robots);
  robots->add_option("--kinds", kinds, "chapter_robot()");
  robots->add_option("--samples", sizes);
  robots->add_option("--noise", noise)->check(CLI::IsMember({"tag", "flips", "chapter"}));
  CLI::App* nominal = app.add_subcommand("nominal", "models as built, base and end seen");
  nominal->add_option("--robots", num_robots);
  CLI::App* rigs = app.add_subcommand("rig", "a rig from rendered images");
  rigs->add_option("RIG", rig)->required();
  rigs->add_option("--seeds", num_seeds);
  rigs->add_option("--samples", num_samples);
  CLI::App* recording = app.add_subcommand("recording", "a CSV, 70 % of it for training");
  recording->add_option("CSV", file)->required();
  CLI11_PARSE(app, argc, argv);
  if (*robots) run_robots(kinds, noise, sizes, num_robots);
  if (*nominal) run_nominal(num_robots);
  if (*rigs) run_rig(rig, num_seeds, num_samples);
  if (*recording) run_recording(file);
}
