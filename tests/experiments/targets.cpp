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
#include <functional>
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

/// A group that runs, its truth, and the target that it serves.
class Group {
 public:
  explicit Group(const std::string& url) : bus_(url, url) {
    bus_.subscribe<body_schema_t>(kBodySchema,
                                  [this](const body_schema_t& m) { schema_ = from_message(m); });
    bus_.subscribe<sim_state_t>(kSimState, [this](const sim_state_t& m) { state_ = m; });
    bus_.subscribe<sample_t>(kSample, [this](const sample_t& m) {
      if (state_ && state_->action_id == m.action_id)
        truth_.push_back(true_sample(*state_, from_message(m).action));
    });
    bus_.subscribe<control_status_t>(kControlStatus, [this](const control_status_t& m) {
      if (follower_) follower_->on_control_status(m);
    });
    bus_.subscribe<process_info_t>(kProcessInfo, [this](const process_info_t& m) {
      if (follower_) follower_->on_process_info(m);
    });
    bus_.subscribe<motion_status_t>(kMotionStatus, [this](const motion_status_t& m) {
      if (follower_) follower_->on_motion_status(m);
    });
    wait("BODY_SCHEMA", [&] { return schema_.has_value(); });
    wait("SIM_STATE", [&] { return state_.has_value(); });
    epoch_ = wall_clock_us();
  }

  const BodySchema& schema() const { return *schema_; }
  const sim_state_t& state() const { return *state_; }
  /// Of all rests so far.
  const std::vector<ActionPoseSample>& truth() const { return truth_; }

  /// Serves the target to its end, as a new one of one sender.
  const TargetFollower& serve(pose_target_t target, double timeout_s) {
    target.utime = target.epoch = epoch_;
    target.sender = "targets";
    target.target_id = next_id_++;
    follower_.emplace(target, std::llround(timeout_s * 1e6));
    while (follower_->end() == TargetFollower::End::kOpen) {
      if (const auto message = follower_->on_tick(clock_us())) bus_.publish(kPoseTarget, *message);
      bus_.handle(std::chrono::milliseconds(20));
    }
    return *follower_;
  }

  /// @throws std::runtime_error after 10 s.
  void wait(const char* what, const std::function<bool()>& is_there) {
    const std::int64_t end_us = clock_us() + 10'000'000;
    while (!is_there()) {
      if (clock_us() > end_us) throw std::runtime_error(std::string("no ") + what + " for 10 s");
      bus_.handle(std::chrono::milliseconds(50));
    }
  }

 private:
  Bus bus_;
  std::optional<BodySchema> schema_;
  std::optional<sim_state_t> state_;
  std::vector<ActionPoseSample> truth_;
  std::optional<TargetFollower> follower_;
  std::int64_t epoch_ = 0, next_id_ = 0;
};

struct Outcome {
  std::vector<double> errors_m, observed_m;
  std::vector<Arrival> arrivals;
  int num_refused = 0, num_held = 0;
};

/// Brings the part to where a random action would; prints a row.
void steer(int number, int part, const Eigen::VectorXd& action, double timeout_s, Group* group,
           Outcome* outcome) {
  const int root = group->schema().root;
  const auto X_RB = group->schema().predict(root, part, action);
  if (!X_RB) throw std::runtime_error("the end effector is not connected to the root");
  const Eigen::Vector3d p_RT = X_RB->X_AB.translation();
  pose_target_t target{};
  target.target_kind = pose_target_t::KIND_POSITION;
  target.target_part = part;
  std::copy(p_RT.begin(), p_RT.end(), target.position_m);
  target.keep_s = -1;
  const TargetFollower& here = group->serve(target, timeout_s);
  const control_status_t& status = here.status();
  double error_m = NAN;
  std::string result = "reached";
  if (here.end() == TargetFollower::End::kAsked || here.end() == TargetFollower::End::kMissed) {
    group->wait("SIM_STATE of the arm at the target",
                [&] { return group->state().utime >= status.utime; });
    if (const auto X_RB_true = relative_pose(true_sample(group->state(), {}), root, part)) {
      error_m = (X_RB_true->translation() - p_RT).norm();
      outcome->errors_m.push_back(error_m);
      Pose wanted = X_RB->X_AB;
      if (!group->truth().empty())
        wanted = group->schema().predict(root, part, group->truth().back().action)->X_AB;
      wanted.translation() = p_RT;
      outcome->arrivals.push_back({wanted, *X_RB_true});
    }
    if (status.observed_error_m >= 0) outcome->observed_m.push_back(status.observed_error_m);
  } else if (here.end() == TargetFollower::End::kTimedOut) {
    ++outcome->num_held;
    result = "no end: " + here.diagnosis();
  } else {
    const bool is_refused = status.control_state == control_status_t::CONTROL_REFUSED;
    ++(is_refused ? outcome->num_refused : outcome->num_held);
    result = (is_refused ? "refused: " : "held: ") + status.why;
  }
  std::printf("| %d | %.3f %.3f %.3f | %s | %d | %s | %s | %s |\n", number, p_RT.x(), p_RT.y(),
              p_RT.z(), result.c_str(), status.num_moves,
              millimetres(status.predicted_error_m).c_str(),
              millimetres(status.observed_error_m).c_str(), millimetres(error_m).c_str());
  std::fflush(stdout);
}

/// Prints all targets in one row. Median of the errors that count [m].
double summarise(int count, int part, const Group& group, const Outcome& outcome) {
  const std::vector<double>& errors_m = outcome.errors_m;
  const double worst_m =
      errors_m.empty() ? NAN : *std::max_element(errors_m.begin(), errors_m.end());
  std::vector<double> aligned_m;
  const auto alignment = align(group.schema(), group.truth());
  if (alignment)
    for (const Arrival& a : outcome.arrivals)
      aligned_m.push_back(
          (alignment->aligned(part, a.X_RB_wanted).translation() - a.X_RB_true.translation())
              .norm());
  std::printf(
      "\n| targets | reached | refused | held | median | max | aligned, median | as seen, median "
      "|\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- |\n"
      "| %d | %zu | %d | %d | %s | %s | %s | %s |\n",
      count, errors_m.size(), outcome.num_refused, outcome.num_held,
      millimetres(median(errors_m)).c_str(), millimetres(worst_m).c_str(),
      millimetres(median(aligned_m)).c_str(), millimetres(median(outcome.observed_m)).c_str());
  if (alignment)
    std::printf("\nAligned by %s at the root, %s at the part, scale %.4f.\n",
                size_text(alignment->X_RS).c_str(), size_text(alignment->X_PB.at(part)).c_str(),
                alignment->scale);
  return median(group.state().is_ideal ? errors_m : aligned_m);
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
    Group group(in);
    std::mt19937_64 engine(seed);
    Outcome outcome;
    std::printf(
        "| target | x y z | result | moves | by the schema | as seen | true |\n"
        "| --- | --- | --- | --- | --- | --- | --- |\n");
    for (int i = 0; i < count; ++i)
      steer(i, part, random_action(signals.signals, engine), timeout_s, &group, &outcome);
    pose_target_t release{};
    release.target_kind = pose_target_t::KIND_RELEASE;
    release.target_part = -1;
    group.serve(release, 5);
    const double median_m = summarise(count, part, group, outcome);
    const bool is_good = 2 * outcome.errors_m.size() >= static_cast<std::size_t>(count) &&
                         median_m * 1e3 <= limit_mm;
    return std::isinf(limit_mm) || is_good ? 0 : 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "targets: %s\n", error.what());
    return 1;
  }
}
