#include "processes/console/run_watch.h"

#include <fmt/format.h>

#include <algorithm>
#include <iterator>
#include <span>

#include "common/bus/convert.h"
#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/console/views/health_view.h"

namespace bodyschema {
namespace {

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
  if (num_samples_ > 0 && message.sample_index <= last_index_) return;
  if (num_samples_++ == 0) first_index_ = message.sample_index;
  last_index_ = message.sample_index;
  auto sample = std::make_shared<const ActionPoseSample>(from_message(message));
  for (const PartObservation& part : sample->parts) ++num_seen_[part.part];
  if (sample->purpose == Purpose::kTest) {
    last_test_index_ = last_index_;
    action_ids_[last_index_] = message.action_id;
  }
  samples_.add(std::move(sample));
  if (action_ids_.size() > most_truths_) forget_truths();
}

SharedSamples RunWatch::retained_since(std::int64_t first) const {
  if (num_samples_ == 0) return {};
  return samples_.between(std::max(first, first_index_), last_index_);
}

std::vector<ActionPoseSample> RunWatch::samples() const {
  std::vector<ActionPoseSample> result;
  for (const auto& sample : retained_since(0)) result.push_back(*sample);
  return result;
}

void RunWatch::on_body_schema(const body_schema_t& schema) { schema_ = from_message(schema); }

void RunWatch::on_learned_schema(const body_schema_t& schema) {
  learned_sample_ = schema.last_sample_index;
  unconnected_ = schema.unconnected;
}

void RunWatch::on_model_health(const model_health_t& health) { health_ = health; }

void RunWatch::on_sim_state(const sim_state_t& state) {
  const Pose X_CW = from_message(state.X_WC).inverse();
  Truth truth{state.action_id, {}};
  for (std::size_t i = 0; i < state.true_part.size(); ++i)
    truth.parts.emplace_back(state.true_part[i], X_CW * from_message(state.X_WB[i]));
  truth_[state.utime] = std::move(truth);
  if (truth_.size() > most_truths_) forget_truths();
}

const RunWatch::Truth* RunWatch::truth_of(const ActionPoseSample& sample) const {
  // Ids count within their source, so the time decides: the newest state before the sample's last
  // frame.
  const auto after = truth_.upper_bound(sample.utime);
  const auto action_id = action_ids_.find(sample.sample_index);
  if (after == truth_.begin() || action_id == action_ids_.end()) return nullptr;
  const Truth& truth = std::prev(after)->second;
  return truth.action_id == action_id->second ? &truth : nullptr;
}

void RunWatch::forget_truths() {
  std::set<const Truth*> needed;
  std::map<std::int64_t, std::int64_t> action_ids;
  std::int64_t newest_utime = 0;
  samples_.for_each([&](const ActionPoseSample& sample) {
    newest_utime = std::max(newest_utime, sample.utime);
    if (const auto id = action_ids_.find(sample.sample_index); id != action_ids_.end())
      action_ids.insert(*id);
    if (const Truth* truth = truth_of(sample)) needed.insert(truth);
  });
  action_ids_ = std::move(action_ids);
  std::erase_if(truth_, [&](const auto& entry) {
    return entry.first <= newest_utime && !needed.contains(&entry.second);
  });
  // So that each of them costs the same, however many stay.
  most_truths_ = std::max(most_truths_, 2 * std::max(truth_.size(), action_ids_.size()));
}

void RunWatch::on_process_info(const process_info_t& info, std::int64_t now_us) {
  processes_[info.process_name] = {info, now_us};
}

bool RunWatch::is_finished() const {
  const auto babbler = processes_.find("motor_babbler");
  return babbler != processes_.end() && babbler->second.info.phase == process_info_t::PHASE_DONE &&
         num_samples_ > 0 && is_judged();
}

bool RunWatch::is_caught_up() const {
  return num_samples_ > 0 && learned_sample_ >= last_index_ && is_judged();
}

bool RunWatch::is_judged() const {
  return last_test_index_ < 0 || (health_ && health_->judged_sample >= last_test_index_);
}

std::map<int, double> RunWatch::visibility() const {
  std::map<int, double> seen;
  for (const auto& [part, count] : num_seen_)
    seen[part] = static_cast<double>(count) / static_cast<double>(num_samples_);
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
    line += fmt::format(" · {}{} left", goal->is_exact ? "" : "at most ", duration(*remaining_s));
  line += fmt::format(" · {:2} parts, each seen in {:3.0f} %", seen.size(), mean * 100);
  const std::size_t edges = schema_ ? schema_->edges.size() : 0;
  line += fmt::format(" · {} of {} edges", edges, seen.empty() ? 0 : seen.size() - 1);
  if (!schema_ || !schema_->complete) {
    constexpr std::size_t kMost = 3;
    const std::span first = std::span(unconnected_).first(std::min(unconnected_.size(), kMost));
    std::string missing = listed(first, [](const unconnected_part_t& part) {
      return fmt::format("part {} ({})", part.unconnected_part,
                         name_in(kUnconnectedReasons, part.reason));
    });
    if (unconnected_.size() > kMost)
      missing += fmt::format(", {} more", unconnected_.size() - kMost);
    line += missing.empty() ? learned_sample_ < 0 ? ", no proposal yet" : ", not judged yet"
                            : ", missing: " + missing;
  }
  if (health_ && health_->worst_position_m >= 0)
    line += fmt::format(" · worst part {} off, as the camera sees it, held out",
                        pose_text(health_->worst_position_m, health_->worst_rotation_rad, 1));
  if (health_) {
    if (const auto verdict = verdict_of(*health_); !verdict.wrong.empty())
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
  return std::ranges::all_of(expected, [&](const std::string& name) {
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
  for (const std::string& name : expected)
    text += fmt::format("  {:<18} {}\n", name,
                        silent_ones.count(name) ? "is silent" : processes_.at(name).info.activity);
  return text;
}

std::int64_t RunWatch::body_since() const {
  return schema_ ? schema_->body_since(schema_->last_sample_index) : 0;
}

std::vector<ActionPoseSample> RunWatch::held_out(std::int64_t since) const {
  std::vector<ActionPoseSample> result;
  for (const auto& retained : retained_since(since)) {
    if (retained->purpose != Purpose::kTest) continue;
    ActionPoseSample sample = *retained;
    if (has_truth()) {
      const Truth* truth = truth_of(sample);
      if (truth == nullptr) continue;
      sample.parts.clear();
      for (const auto& [part, X_CB] : truth->parts) {
        PartObservation& seen = sample.parts.emplace_back();
        seen.part = part;
        seen.X_CB = X_CB;
      }
    }
    result.push_back(std::move(sample));
  }
  return result;
}

}  // namespace bodyschema
