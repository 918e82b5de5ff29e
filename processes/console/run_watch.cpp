#include "processes/console/run_watch.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iterator>

#include "common/bus/convert.h"
#include "processes/console/health_view.h"

namespace bodyschema {
namespace {

constexpr double kDegrees = 180 / M_PI;
constexpr std::int64_t kSilentUs = 3'000'000;

}  // namespace

std::string last_words(const std::string& log, const std::string& process) {
  const std::size_t end = log.find_last_not_of("\r\n");
  if (end == std::string::npos) return "";
  const std::size_t before = log.rfind('\n', end);
  const std::size_t begin = before == std::string::npos ? 0 : before + 1;
  const std::string line = log.substr(begin, end + 1 - begin);
  const std::string name = process + ": ";
  return line.starts_with(name) ? line.substr(name.size()) : "";
}

void RunWatch::on_sample(const sample_t& message) {
  if (!samples_.empty() && message.sample_index <= samples_.back().sample_index) return;
  samples_.push_back(from_message(message));
  action_ids_.push_back(message.action_id);
}

void RunWatch::on_body_schema(const body_schema_t& schema) { schema_ = from_message(schema); }

void RunWatch::on_learned_schema(const body_schema_t& schema) {
  learned_sample_ = schema.last_sample_index;
  unconnected_ = schema.unconnected;
}

void RunWatch::on_model_health(const model_health_t& health) { health_ = health; }

void RunWatch::on_sim_state(const sim_state_t& state) {
  const Pose X_CW = from_message(state.X_WC).inverse();
  std::vector<PartObservation> parts;
  for (std::size_t i = 0; i < state.true_part.size(); ++i) {
    PartObservation part;
    part.part = state.true_part[i];
    part.X_CB = X_CW * from_message(state.X_WB[i]);
    parts.push_back(part);
  }
  truth_[state.utime] = {state.action_id, std::move(parts)};
}

void RunWatch::on_process_info(const process_info_t& info, std::int64_t now_us) {
  processes_[info.process_name] = {info, now_us};
}

bool RunWatch::is_finished() const {
  const auto babbler = processes_.find("motor_babbler");
  if (babbler == processes_.end() || babbler->second.info.phase != process_info_t::PHASE_DONE) {
    return false;
  }
  return !samples_.empty() && is_judged();
}

bool RunWatch::is_caught_up() const {
  return !samples_.empty() && learned_sample_ >= samples_.back().sample_index && is_judged();
}

bool RunWatch::is_judged() const {
  const auto last_test =
      std::find_if(samples_.rbegin(), samples_.rend(),
                   [](const ActionPoseSample& sample) { return sample.purpose == Purpose::kTest; });
  if (last_test == samples_.rend()) return true;
  return health_ && health_->judged_sample >= last_test->sample_index;
}

std::map<int, double> RunWatch::visibility() const {
  std::map<int, double> seen;
  for (const ActionPoseSample& sample : samples_) {
    for (const PartObservation& part : sample.parts) ++seen[part.part];
  }
  for (auto& [part, share] : seen) share /= static_cast<double>(samples_.size());
  return seen;
}

void Pace::note(double now_s, std::int64_t count) {
  constexpr double kWindow_s = 60;
  if (!points_.empty() && points_.back().second == count) return;
  points_.emplace_back(now_s, count);
  while (points_.size() > 2 && now_s - points_.front().first > kWindow_s) points_.pop_front();
}

std::optional<double> Pace::seconds_for(std::int64_t more) const {
  if (points_.size() < 2) return std::nullopt;
  const auto [from_s, from] = points_.front();
  const auto [to_s, to] = points_.back();
  if (to <= from || to_s <= from_s) return std::nullopt;
  return static_cast<double>(more) * (to_s - from_s) / static_cast<double>(to - from);
}

std::string RunWatch::progress(const std::optional<SampleGoal>& goal,
                               std::optional<double> remaining_s) const {
  const auto seen = visibility();
  double mean = 0;
  for (const auto& [part, share] : seen) mean += share / static_cast<double>(seen.size());
  std::string line = fmt::format("{:4}", num_samples());
  if (goal) line += fmt::format(" of {}{}", goal->is_exact ? "" : "at most ", goal->most);
  line += " samples";
  if (goal && remaining_s && num_samples() < goal->most)
    line += fmt::format(" · {}{:.0f} s left", goal->is_exact ? "" : "at most ", *remaining_s);
  line += fmt::format(" · {:2} parts, each seen in {:3.0f} %", seen.size(), mean * 100);
  const std::size_t edges = schema_ ? schema_->edges.size() : 0;
  line += fmt::format(" · {} of {} edges", edges, seen.empty() ? 0 : seen.size() - 1);
  if (!schema_ || !schema_->complete) {
    constexpr std::size_t kMost = 3;
    static const char* const kReasons[] = {"never seen", "not enough data yet", "no valid model"};
    std::string missing;
    for (std::size_t i = 0; i < std::min(unconnected_.size(), kMost); ++i) {
      missing += fmt::format("{}part {} ({})", i == 0 ? "" : ", ", unconnected_[i].unconnected_part,
                             kReasons[unconnected_[i].reason]);
    }
    if (unconnected_.size() > kMost)
      missing += fmt::format(", {} more", unconnected_.size() - kMost);
    line += missing.empty() ? learned_sample_ < 0 ? ", no proposal yet" : ", not judged yet"
                            : ", missing: " + missing;
  }
  if (health_ && health_->worst_position_m >= 0) {
    line += fmt::format(" · worst part {:.1f} mm {:.2f}° off, as the camera sees it, held out",
                        health_->worst_position_m * 1e3, health_->worst_rotation_rad * kDegrees);
  }
  if (health_) {
    if (const auto verdict = verdict_of(health_->findings); !verdict.wrong.empty())
      line += " · " + verdict.sentence;
  }
  return line;
}

std::set<std::string> RunWatch::silent(const std::set<std::string>& expected,
                                       std::int64_t now_us) const {
  std::set<std::string> silent = expected;
  for (const auto& [name, heard] : processes_) {
    if (now_us - heard.at_us <= kSilentUs) silent.erase(name);
  }
  return silent;
}

bool RunWatch::are_listening(const std::set<std::string>& expected, std::int64_t now_us) const {
  if (!silent(expected, now_us).empty()) return false;
  return std::all_of(expected.begin(), expected.end(), [&](const std::string& name) {
    return processes_.at(name).info.phase != process_info_t::PHASE_STARTING;
  });
}

std::int64_t RunWatch::counter(const std::string& process, const std::string& counter) const {
  const auto heard = processes_.find(process);
  if (heard == processes_.end()) return 0;
  for (const counter_t& item : heard->second.info.counters) {
    if (item.counter_name == counter) return item.count;
  }
  return 0;
}

std::string RunWatch::diagnosis(const std::set<std::string>& expected, std::int64_t now_us) const {
  const std::set<std::string> silent_ones = silent(expected, now_us);
  std::string text;
  for (const std::string& name : expected) {
    text += fmt::format("  {:<18} {}\n", name,
                        silent_ones.count(name) ? "is silent" : processes_.at(name).info.activity);
  }
  return text;
}

std::int64_t RunWatch::body_since() const {
  return schema_ ? schema_->body_since(schema_->last_sample_index) : 0;
}

std::vector<ActionPoseSample> RunWatch::held_out(std::int64_t since) const {
  std::vector<ActionPoseSample> result;
  for (std::size_t i = 0; i < samples_.size(); ++i) {
    if (samples_[i].purpose != Purpose::kTest || samples_[i].sample_index < since) continue;
    ActionPoseSample sample = samples_[i];
    if (has_truth()) {
      // Ids count within their source, so the time decides: the newest state before the sample's
      // last frame.
      const auto after = truth_.upper_bound(sample.utime);
      if (after == truth_.begin()) continue;
      const Truth& truth = std::prev(after)->second;
      if (truth.action_id != action_ids_[i]) continue;
      sample.parts = truth.parts;
    }
    result.push_back(std::move(sample));
  }
  return result;
}

}  // namespace bodyschema
