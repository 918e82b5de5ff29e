// Accuracy of steering: random reachable positions served on the bus of
// a group that has learned its body, judged against the simulator's noise-free truth. The positions
// are the body schema's own forward kinematics of random actions, so the arm collides at some. With
// calibration errors it counts after aligning too (evaluation.h), on the truth of all rests on the
// way. Prints Markdown.
//
//   ./run --keep --samples 60 && ./run exec build/bin/targets --rig-folder logs/current/config

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <optional>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/bus.h"
#include "common/bus/convert.h"
#include "common/config/rig.h"
#include "common/estimation/evaluation.h"
#include "common/text/clock.h"
#include "common/text/pose_text.h"
#include "processes/console/target_follower.h"

using namespace bodyschema;

namespace {

Eigen::VectorXd random_action(const std::vector<Signal>& signals, std::mt19937_64& engine) {
  Eigen::VectorXd action(signals.size());
  for (std::size_t i = 0; i < signals.size(); ++i) {
    action[static_cast<Eigen::Index>(i)] =
        std::uniform_real_distribution<double>(signals[i].lower, signals[i].upper)(engine);
  }
  return action;
}

/// X_WB of every part, noise-free, as one observation each.
ActionPoseSample true_sample(const sim_state_t& state, const Eigen::VectorXd& action) {
  ActionPoseSample sample;
  sample.action = action;
  for (std::size_t k = 0; k < state.true_part.size(); ++k)
    sample.parts.push_back({.part = state.true_part[k], .X_CB = from_message(state.X_WB[k])});
  return sample;
}

/// X_RB by an instant of the truth.
std::optional<Pose> relative_pose(const ActionPoseSample& truth, int root, int part) {
  const PartObservation *of_root = truth.find(root), *of_part = truth.find(part);
  if (!of_root || !of_part) return std::nullopt;
  return of_root->X_CB.inverse() * of_part->X_CB;
}

/// Where a part was to be and where it came to, both in the root's frame.
struct Arrival {
  Pose X_RB_wanted, X_RB_true;
};

double median(std::vector<double> values) {
  if (values.empty()) return NAN;
  std::sort(values.begin(), values.end());
  const std::size_t half = values.size() / 2;
  return values.size() % 2 ? values[half] : (values[half - 1] + values[half]) / 2;
}

std::string size_text(const Pose& X) {
  return pose_text(X.translation().norm(), Eigen::AngleAxisd(X.linear()).angle(), 2);
}

std::string millimetres(double m) {
  char text[32];
  std::snprintf(text, sizeof text, "%.2f mm", m * 1e3);
  return m < 0 || std::isnan(m) ? "–" : text;
}

}  // namespace

int main(int argc, char** argv) {
  std::string in = default_url(), rig_folder;
  int count = 20;
  std::uint64_t seed = 1;
  double timeout_s = 60, limit_mm = INFINITY;
  CLI::App app("Random targets for the end effector of a group that runs");
  app.add_option("--in", in, "URL of the bus");
  app.add_option("--rig-folder", rig_folder, "The rig's configuration")->required();
  app.add_option("--count", count, "Number of targets")->check(CLI::PositiveNumber);
  app.add_option("--seed", seed, "Of the targets");
  app.add_option("--timeout", timeout_s, "Of one target [s]")->check(CLI::PositiveNumber);
  app.add_option(
      "--limit-mm", limit_mm,
      "Exit code 1 if the median error (aligned, unless --ideal) is larger or fewer than half "
      "were reached");
  CLI11_PARSE(app, argc, argv);
  try {
    const Signals signals = load_signals(rig_folder);
    const int part = signals.end_effector_part;
    Bus bus(in, in);
    std::optional<BodySchema> schema;
    std::optional<sim_state_t> state;
    TargetFollower* follower = nullptr;
    bus.subscribe<body_schema_t>(kBodySchema,
                                 [&](const body_schema_t& m) { schema = from_message(m); });
    bus.subscribe<sim_state_t>(kSimState, [&](const sim_state_t& m) { state = m; });
    std::vector<ActionPoseSample> truth;
    bus.subscribe<sample_t>(kSample, [&](const sample_t& m) {
      if (state && state->action_id == m.action_id)
        truth.push_back(true_sample(*state, from_message(m).action));
    });
    bus.subscribe<control_status_t>(kControlStatus, [&](const control_status_t& m) {
      if (follower) follower->on_control_status(m);
    });
    bus.subscribe<process_info_t>(kProcessInfo, [&](const process_info_t& m) {
      if (follower) follower->on_process_info(m);
    });
    bus.subscribe<motion_status_t>(kMotionStatus, [&](const motion_status_t& m) {
      if (follower) follower->on_motion_status(m);
    });
    const auto wait = [&](const char* what, auto is_there) {
      const std::int64_t end_us = clock_us() + 10'000'000;
      while (!is_there()) {
        if (clock_us() > end_us) throw std::runtime_error(std::string("no ") + what + " for 10 s");
        bus.handle(std::chrono::milliseconds(50));
      }
    };
    wait("BODY_SCHEMA", [&] { return schema.has_value(); });
    wait("SIM_STATE", [&] { return state.has_value(); });

    const std::int64_t epoch = wall_clock_us();
    std::mt19937_64 engine(seed);
    std::vector<double> errors_m, observed_m;
    std::vector<Arrival> arrivals;
    std::int64_t target_id = 0;
    int num_refused = 0, num_held = 0;
    std::printf(
        "| target | x y z | result | moves | by the schema | as seen | true |\n"
        "| --- | --- | --- | --- | --- | --- | --- |\n");
    for (int i = 0; i < count; ++i) {
      const auto X_RB = schema->predict(schema->root, part, random_action(signals.signals, engine));
      if (!X_RB) throw std::runtime_error("the end effector is not connected to the root");
      const Eigen::Vector3d p_RT = X_RB->X_AB.translation();
      pose_target_t target{};
      target.utime = target.epoch = epoch;
      target.sender = "targets";
      target.target_id = target_id++;
      target.target_kind = pose_target_t::KIND_POSITION;
      target.target_part = part;
      std::copy(p_RT.begin(), p_RT.end(), target.position_m);
      target.keep_s = -1;
      TargetFollower here(target, std::llround(timeout_s * 1e6));
      follower = &here;
      while (here.end() == TargetFollower::End::kOpen) {
        if (const auto message = here.on_tick(clock_us())) bus.publish(kPoseTarget, *message);
        bus.handle(std::chrono::milliseconds(20));
      }
      const control_status_t& status = here.status();
      double error_m = NAN;
      std::string result = "reached";
      if (here.end() == TargetFollower::End::kAsked || here.end() == TargetFollower::End::kMissed) {
        wait("SIM_STATE of the arm at the target", [&] { return state->utime >= status.utime; });
        if (const auto X_RB_true = relative_pose(true_sample(*state, {}), schema->root, part)) {
          error_m = (X_RB_true->translation() - p_RT).norm();
          errors_m.push_back(error_m);
          Pose wanted = X_RB->X_AB;
          if (!truth.empty())
            wanted = schema->predict(schema->root, part, truth.back().action)->X_AB;
          wanted.translation() = p_RT;
          arrivals.push_back({wanted, *X_RB_true});
        }
        if (status.observed_error_m >= 0) observed_m.push_back(status.observed_error_m);
      } else if (here.end() == TargetFollower::End::kTimedOut) {
        ++num_held;
        result = "no end: " + here.diagnosis();
      } else {
        const bool is_refused = status.control_state == control_status_t::CONTROL_REFUSED;
        ++(is_refused ? num_refused : num_held);
        result = (is_refused ? "refused: " : "held: ") + status.why;
      }
      std::printf("| %d | %.3f %.3f %.3f | %s | %d | %s | %s | %s |\n", i, p_RT.x(), p_RT.y(),
                  p_RT.z(), result.c_str(), status.num_moves,
                  millimetres(status.predicted_error_m).c_str(),
                  millimetres(status.observed_error_m).c_str(), millimetres(error_m).c_str());
      std::fflush(stdout);
    }
    follower = nullptr;
    pose_target_t release{};
    release.utime = release.epoch = epoch;
    release.sender = "targets";
    release.target_id = target_id;
    release.target_kind = pose_target_t::KIND_RELEASE;
    release.target_part = -1;
    TargetFollower given_back(release, 5'000'000);
    follower = &given_back;
    while (given_back.end() == TargetFollower::End::kOpen) {
      if (const auto message = given_back.on_tick(clock_us())) bus.publish(kPoseTarget, *message);
      bus.handle(std::chrono::milliseconds(20));
    }
    const double worst_m =
        errors_m.empty() ? NAN : *std::max_element(errors_m.begin(), errors_m.end());
    std::vector<double> aligned_m;
    const auto alignment = align(*schema, truth);
    if (alignment)
      for (const Arrival& a : arrivals)
        aligned_m.push_back(
            (alignment->aligned(part, a.X_RB_wanted).translation() - a.X_RB_true.translation())
                .norm());
    std::printf(
        "\n| targets | reached | refused | held | median | max | aligned, median | as seen, median "
        "|\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- |\n"
        "| %d | %zu | %d | %d | %s | %s | %s | %s |\n",
        count, errors_m.size(), num_refused, num_held, millimetres(median(errors_m)).c_str(),
        millimetres(worst_m).c_str(), millimetres(median(aligned_m)).c_str(),
        millimetres(median(observed_m)).c_str());
    if (alignment)
      std::printf("\nAligned by %s at the root, %s at the part, scale %.4f.\n",
                  size_text(alignment->X_RS).c_str(), size_text(alignment->X_PB.at(part)).c_str(),
                  alignment->scale);
    const bool is_good = 2 * errors_m.size() >= static_cast<std::size_t>(count) &&
                         median(state->is_ideal ? errors_m : aligned_m) * 1e3 <= limit_mm;
    return std::isinf(limit_mm) || is_good ? 0 : 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "targets: %s\n", error.what());
    return 1;
  }
}
