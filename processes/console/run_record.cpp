#include "processes/console/run_record.h"

#include <algorithm>
#include <cmath>

#include "common/bus/channels.h"
#include "common/bus/convert.h"

namespace bodyschema {
namespace {

constexpr std::size_t kMostPoints = 800;
constexpr std::size_t kMostPictures = 8;

template <class Message>
std::optional<Message> read_as(const Channel<Message>& channel, const LogEvent& event) {
  if (event.channel != channel.name) return std::nullopt;
  return decode<Message>(event.data.data(), event.data.size()).message;
}

/// Without how far one has come that goes on: "drift arm 0.5 deg per action, 3 deg so far".
std::string name_of_fault(const std::string& fault) {
  return fault.ends_with(" so far") ? fault.substr(0, fault.rfind(", ")) : fault;
}

bool has(const std::map<std::int64_t, std::int64_t>& times, std::int64_t utime) {
  return times.contains(utime);
}

}  // namespace

double quantile(std::vector<double> values, double q) {
  const auto index =
      static_cast<std::ptrdiff_t>(std::lround(q * static_cast<double>(values.size() - 1)));
  std::nth_element(values.begin(), values.begin() + index, values.end());
  return values[static_cast<std::size_t>(index)];
}

double RunRecord::seconds(std::int64_t received_us) const {
  return begin_us_ ? static_cast<double>(received_us - *begin_us_) * 1e-6 : 0;
}

void RunRecord::on_event(const LogEvent& event, const std::filesystem::path& file,
                         std::int64_t byte) {
  // Files that our processes write bear the time of measurement, those of a logger the time of
  // receipt. Only the latter tell how long things took.
  const auto note_receipt = [&](std::int64_t utime) {
    if (event.event_utime == utime) return false;
    begin_us_ = std::min(begin_us_.value_or(event.event_utime), event.event_utime);
    end_us_ = std::max(end_us_, event.event_utime);
    return true;
  };
  if (const auto info = read_as(kProcessInfo, event)) {
    note_receipt(-1);
    on_process_info(*info, event.event_utime);
  } else if (const auto image = read_as(kCameraImage, event)) {
    image_places_.insert_or_assign(image->utime, Place{file, byte});
    if (note_receipt(image->utime)) image_received_.try_emplace(image->utime, event.event_utime);
  } else if (const auto markers = read_as(kMarkerPoses, event)) {
    if (note_receipt(markers->utime))
      markers_received_.try_emplace(markers->utime, event.event_utime);
    on_markers(*markers);
  } else if (const auto camera = read_as(kCameraInfo, event)) {
    note_receipt(camera->utime);
    camera_info_ = camera;
  } else if (const auto sample = read_as(kSample, event)) {
    watch_.on_sample(*sample);
    if (!note_receipt(sample->utime)) return;
    sample_received_.try_emplace(sample->utime, event.event_utime);
    const auto action = actions_.find({sample->source, sample->epoch, sample->action_id});
    if (action != actions_.end() && !action->second.sampled)
      action->second.sampled = event.event_utime;
  } else if (const auto command = read_as(kActionCommand, event)) {
    note_receipt(command->utime);
    if (command->kind == action_command_t::KIND_MOVE) {
      actions_.try_emplace({command->source, command->epoch, command->action_id},
                           Action{.sent = event.event_utime});
    }
  } else if (const auto status = read_as(kMotionStatus, event)) {
    note_receipt(status->utime);
    const auto action = actions_.find({status->source, status->epoch, status->action_id});
    if (action == actions_.end()) return;
    if (!action->second.answered) action->second.answered = event.event_utime;
    if (!action->second.settled && status->state == motion_status_t::STATE_SETTLED)
      action->second.settled = event.event_utime;
  } else if (const auto state = read_as(kSimState, event)) {
    note_receipt(state->utime);
    watch_.on_sim_state(*state);
    const std::vector<std::string>& before =
        faults_.empty() ? std::vector<std::string>() : faults_.back().faults;
    std::vector<std::string> faults;
    for (const std::string& fault : state->faults) faults.push_back(name_of_fault(fault));
    if (faults != before)
      faults_.push_back(
          {seconds(event.event_utime), state->utime, state->action_id, std::move(faults)});
  } else if (const auto schema = read_as(kBodySchema, event)) {
    note_receipt(schema->utime);
    watch_.on_body_schema(*schema);
    versions_.try_emplace(schema->schema_version, from_message(*schema));
  } else if (const auto proposal = read_as(kLearnedSchema, event)) {
    note_receipt(proposal->utime);
    learned_ = from_message(*proposal);
  } else if (const auto health = read_as(kModelHealth, event)) {
    note_receipt(health->utime);
    watch_.on_model_health(*health);
    health_ = health;
    // After a restart of the monitor the numbers begin again.
    for (const health_event_t& item : health->events)
      events_.try_emplace({item.event_sample, item.event_number, item.event_text}, item);
  }
}

void RunRecord::on_process_info(const process_info_t& info, std::int64_t received_us) {
  Track& track = tracks_[{info.process_name, info.host, info.pid}];
  track.process.newest = info;
  const double period_s = static_cast<double>(info.utime - track.last_utime) * 1e-6;
  // The first one has nothing to be compared with; a clock that was set back begins anew.
  if (track.last_utime == 0 || period_s < 0) {
    track.last_utime = info.utime;
    track.last_cpu_us = info.cpu_us;
    return;
  }
  if (period_s < track.period_s) return;
  const double used_s = static_cast<double>(info.cpu_us - track.last_cpu_us) * 1e-6;
  track.process.load.push_back({.at_s = seconds(received_us),
                                .cpu_percent = std::max(0.0, 100 * used_s / period_s),
                                .memory_mb = static_cast<double>(info.resident_bytes) * 1e-6});
  track.last_utime = info.utime;
  track.last_cpu_us = info.cpu_us;
  if (track.process.load.size() <= kMostPoints) return;
  // Every other point goes, and from now on they come half as often.
  std::vector<Load>& load = track.process.load;
  for (std::size_t i = 0; 2 * i < load.size(); ++i) load[i] = load[2 * i];
  load.resize((load.size() + 1) / 2);
  track.period_s *= 2;
}

void RunRecord::on_markers(const marker_poses_t& markers) {
  const auto has_more = [](const marker_poses_t& a, const marker_poses_t& b) {
    return a.num_markers > b.num_markers;
  };
  if (markers.num_markers == 0) return;
  for (const marker_poses_t& kept : best_markers_) {
    if (kept.utime == markers.utime) return;
  }
  best_markers_.insert(
      std::upper_bound(best_markers_.begin(), best_markers_.end(), markers, has_more), markers);
  if (best_markers_.size() > kMostPictures) best_markers_.pop_back();
}

std::vector<health_event_t> RunRecord::events() const {
  std::vector<health_event_t> result;
  const auto is_acceptance = [](const health_event_t& event) {
    return event.event_kind == health_event_t::EVENT_SCHEMA_ACCEPTED;
  };
  for (const auto& [key, event] : events_) {
    if (!result.empty() && is_acceptance(result.back()) && is_acceptance(event)) result.pop_back();
    result.push_back(event);
  }
  return result;
}

std::vector<RunRecord::Process> RunRecord::processes() const {
  std::vector<Process> result;
  for (const auto& [key, track] : tracks_) result.push_back(track.process);
  return result;
}

std::vector<RunRecord::Latency> RunRecord::latencies() const {
  Latency seen{"frame → MARKER_POSES", {}}, sampled{"last frame → SAMPLE", {}},
      answered{"ACTION_COMMAND → answer of the driver", {}},
      settled{"ACTION_COMMAND → settled", {}}, cycle{"ACTION_COMMAND → SAMPLE", {}};
  const auto add = [](Latency& latency, std::int64_t from, std::int64_t to) {
    latency.seconds.push_back(static_cast<double>(to - from) * 1e-6);
  };
  for (const auto& [utime, received] : image_received_) {
    if (has(markers_received_, utime)) add(seen, received, markers_received_.at(utime));
    if (has(sample_received_, utime)) add(sampled, received, sample_received_.at(utime));
  }
  for (const auto& [key, action] : actions_) {
    if (action.answered) add(answered, action.sent, *action.answered);
    if (action.settled) add(settled, action.sent, *action.settled);
    if (action.sampled) add(cycle, action.sent, *action.sampled);
  }
  std::vector<Latency> result;
  for (Latency* latency : {&seen, &sampled, &answered, &settled, &cycle}) {
    if (!latency->seconds.empty()) result.push_back(std::move(*latency));
  }
  return result;
}

double RunRecord::duration_s() const { return seconds(end_us_); }

std::vector<RunRecord::Picture> RunRecord::pictures() const {
  std::vector<Picture> result;
  for (const marker_poses_t& markers : best_markers_) {
    const auto place = image_places_.find(markers.utime);
    if (place != image_places_.end()) result.push_back({markers, place->second});
  }
  return result;
}

}  // namespace bodyschema
