// dev harness
#include <CLI/CLI.hpp>
#include <chrono>
#include <cstdio>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/recording/recording.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

// Part 1 is the base, part 2 + num_joints − 1 … the hand; all between are hidden.
SyntheticRobot random_arm(int num_joints, bool own_gains, Rng& rng) {
  SyntheticRobot robot;
  robot.X_CR.translation().z() = 2;
  TrueLink base;
  base.part = 1;
  robot.links.push_back(base);
  for (int j = 0; j < num_joints; ++j) {
    TrueLink link;
    link.part = j + 2;
    link.parent = j + 1;
    link.X_before = random_pose(rng, 0.05, 0.2);
    link.X_after = random_pose(rng, 0.05, 0.2);
    if (j % 2) {  // parallel or orthogonal to the one before
      link.X_before.linear() = Eigen::AngleAxisd(uniform(rng, 0, 1) < 0.3 ? 0 : M_PI / 2, Eigen::Vector3d::UnitX()).toRotationMatrix();
      robot.links.back().X_after.linear().setIdentity();
    }
    link.signal = j;
    const double gain = own_gains ? uniform(rng, 0.6, 1.6) * (uniform(rng, 0, 1) < 0.5 ? -1 : 1) : 1;
    double half = 0.5 * uniform(rng, 60, 240) * kDegree / std::abs(gain);
    if (uniform(rng, 0, 1) < 0.1) {
      link.slide = 0.1 * gain;
      half = 1;
    } else {
      link.turn = gain;
    }
    link.hidden = j + 1 < num_joints;
    const double centre = uniform(rng, -0.5, 0.5);
    link.zero = 0;
    robot.signals.push_back({"q" + std::to_string(j + 1), centre - half, centre + half, {}});
    robot.links.push_back(link);
  }
  return robot;
}

std::vector<ActionPoseSample> noisy(const SyntheticRobot& robot, int n, Noise noise, Rng& rng) {
  std::vector<ActionPoseSample> samples = babble(robot, n, {}, rng);
  for (auto& sample : samples)
    for (auto& o : sample.parts) {
      Vector6d e = gaussian6(rng);
      e.head<3>() *= noise.position_m;
      e.tail<3>() *= noise.rotation_rad;
      o.X_CB = o.X_CB * exp(e);
    }
  return samples;
}

double now() {
  return 1e-9 * std::chrono::steady_clock::now().time_since_epoch().count();
}

void report(const std::vector<ActionPoseSample>& samples, int num_signals, Noise noise, int part_i, int part_j, std::vector<int> order) {
  const NormalizedActions actions(samples, num_signals);
  MeasurementModel measurement;
  measurement.noise = noise;
  const PairData pair = make_pair_data(samples, part_i, part_j, measurement, 1000);
  const double t0 = now();
  auto fit = fit_long_chain(pair, actions, order, JointOrder::kUnknown, 1.414 * noise.rotation_rad);
  const double t1 = now();
  if (!fit) { std::printf("none\n"); return; }
  std::printf("cost/frame %.2f  %.2fs  ", fit->cost / pair.size(), t1 - t0);
  *fit = without_idle_joints(*fit, pair, actions);
  *fit = with_settled_order(*fit, pair, actions);
  const double t2 = now();
  std::printf("pruned: cost/frame %.2f %.2fs:", fit->cost / pair.size(), t2 - t1);
  for (auto& j : fit->model.joints) std::printf(" q%d(%.3f,%.3f%s)", j.signal + 1, j.turn, j.slide, j.order_group >= 0 ? " open" : "");
  std::printf("\n");
}

}  // namespace

int main(int argc, char** argv) {
  std::string file;
  int robots = 10, samples = 40, joints = 7;
  bool own = false, scrambled = false;
  CLI::App app;
  app.add_option("--file", file);
  app.add_option("--robots", robots);
  app.add_option("--samples", samples);
  app.add_option("--joints", joints);
  app.add_flag("--own", own);
  app.add_flag("--scrambled", scrambled);
  CLI11_PARSE(app, argc, argv);
  if (!file.empty()) {
    const Recording r = load_recording(file);
    std::vector<int> order;
    for (std::size_t s = 0; s < r.signals.size(); ++s) order.push_back(s);
    report(r.samples, r.signals.size(), {0.001, 0.2 * kDegree}, 0, 1, order);
    std::swap(order[0], order[3]); std::swap(order[1], order[6]); std::swap(order[2], order[4]);
    report(r.samples, r.signals.size(), {0.001, 0.2 * kDegree}, 0, 1, order);
    return 0;
  }
  for (int r = 0; r < robots; ++r) {
    Rng rng(r + 1);
    const SyntheticRobot robot = random_arm(joints, own, rng);
    const auto data = noisy(robot, samples, {0.001, 0.3 * kDegree}, rng);
    std::vector<int> order;
    for (int j = 0; j < joints; ++j) order.push_back(j);
    if (scrambled) std::shuffle(order.begin(), order.end(), rng);
    report(data, joints, {0.001, 0.3 * kDegree}, 1, joints + 1, order);
  }
}
