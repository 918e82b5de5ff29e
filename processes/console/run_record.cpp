#include "processes/console/run_record.h"

#include <algorithm>
#include <cmath>
#include <ranges>

#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/text/clock.h"

namespace bodyschema {
namespace {

constexpr std::size_t kMostPoints = 800;
constexpr std::size_t kMostPictures = 8;
constexpr std::size_t kMostVersions = 256;
constexpr std::size_t kMostEvents = 2000;

/// Without how far one has come that goes on: "drift arm 0.5 deg per action, 3 deg so far".
std::string name_of_fault(const std::string& fault) {
  return fault.ends_with(" so far") ? fault.substr(0, fault.rfind(", ")) : fault;
}

bool is_acceptance(const health_event_t& event) {
  return event.event_kind == health_event_t::EVENT_SCHEMA_ACCEPTED;
}

void add(std::vector<RunRecord::Picture>* pictures, const RunRecord::Picture& picture) {
  const auto has_more = [](const auto& a, const auto& b) {
    return a.markers.num_markers > b.markers.num_markers;
  };
  pictures->insert(std::upper_bound(pictures->begin(), pictures->end(), picture, has_more),
                   picture);
  if (pictures->size() > kMostPictures) pictures->pop_back();
}

}  // namespace

double quantile(std::vector<double> values, double q) {
  const auto index =
      static_cast<std::ptrdiff_t>(std::lround(q * static_cast<double>(values.size() - 1)));
  std::nth_element(values.begin(), values.begin() + index, values.end());
  return values[static_cast<std::size_t>(index)];
}

double RunRecord::at_s(std::int64_t received_us) const {
  return begin_us_ ? seconds(received_us - *begin_us_) : 0;
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
  if (const auto info = message_of(event, kProcessInfo)) {
    note_receipt(-1);
    on_process_info(*info, event.event_utime);
  } else if (const auto image = message_of(event, kCameraImage)) {
    on_image(image->utime, {file, byte});
    if (note_receipt(image->utime)) image_received_.insert(image->utime, event.event_utime);
  } else if (const auto markers = message_of(event, kMarkerPoses)) {
    if (note_receipt(markers->utime)) markers_received_.insert(markers->utime, event.event_utime);
    on_markers(*markers);
  } else if (const auto camera = message_of(event, kCameraInfo)) {
    note_receipt(camera->utime);
    camera_info_ = camera;
  } else if (const auto sample = message_of(event, kSample)) {
    watch_.on_sample(*sample);
    if (!note_receipt(sample->utime)) return;
    sample_received_.insert(sample->utime, event.event_utime);
    Action* action = action_of({sample->source, sample->epoch, sample->action_id});
    if (action != nullptr && !action->sampled) action->sampled = event.event_utime;
  } else if (const auto command = message_of(event, kActionCommand)) {
    note_receipt(command->utime);
    if (command->kind == action_command_t::KIND_MOVE) {
      const ActionKey key{command->source, command->epoch, command->action_id};
      actions_.insert(hash_of(key), {.key = key, .sent = event.event_utime});
    }
  } else if (const auto status = message_of(event, kMotionStatus)) {
    note_receipt(status->utime);
    Action* action = action_of({status->source, status->epoch, status->action_id});
    if (action == nullptr) return;
    if (!action->answered) action->answered = event.event_utime;
    if (!action->settled && status->state == motion_status_t::STATE_SETTLED)
      action->settled = event.event_utime;
  } else if (const auto state = message_of(event, kSimState)) {
    note_receipt(state->utime);
    watch_.on_sim_state(*state);
    on_faults(*state, event.event_utime);
  } else if (const auto schema = message_of(event, kBodySchema)) {
    note_receipt(schema->utime);
    watch_.on_body_schema(*schema);
    on_version(*schema);
  } else if (const auto proposal = message_of(event, kLearnedSchema)) {
    note_receipt(proposal->utime);
    learned_ = from_message(*proposal);
  } else if (const auto health = message_of(event, kModelHealth)) {
    note_receipt(health->utime);
    watch_.on_model_health(*health);
    health_ = health;
    for (const health_event_t& item : health->events) on_health_event(item);
  }
}

void RunRecord::on_faults(const sim_state_t& state, std::int64_t received_us) {
  std::vector<std::string> faults;
  for (const std::string& fault : state.faults) faults.push_back(name_of_fault(fault));
  if (faults != (faults_.empty() ? std::vector<std::string>() : faults_.back().faults))
    faults_.push_back({at_s(received_us), state.utime, state.action_id, std::move(faults)});
}

std::int64_t RunRecord::hash_of(const ActionKey& key) {
  const auto& [source, epoch, action_id] = key;
  return static_cast<std::int64_t>(std::hash<std::string>()(source)) ^ (epoch << 20) ^ action_id;
}

RunRecord::Action* RunRecord::action_of(const ActionKey& key) {
  Action* action = actions_.find(hash_of(key));
  return action != nullptr && action->key == key ? action : nullptr;
}

void RunRecord::on_version(const body_schema_t& schema) {
  if (!versions_.try_emplace(schema.schema_version, from_message(schema)).second) return;
  ++num_versions_;
  if (versions_.size() <= kMostVersions) return;
  // Every other one goes, but for the first and the last of each body.
  const auto body_of = [](const auto& version) { return version->second.changes.size(); };
  bool is_kept = true;
  for (auto version = std::next(versions_.begin()); std::next(version) != versions_.end();) {
    is_kept = !is_kept || body_of(version) != body_of(std::prev(version)) ||
              body_of(version) != body_of(std::next(version));
    version = is_kept ? std::next(version) : versions_.erase(version);
  }
  if (versions_.size() > kMostVersions) versions_.erase(versions_.begin());
}

void RunRecord::on_health_event(const health_event_t& event) {
  // After a restart of the monitor the numbers begin again.
  const auto [added, is_new] =
      events_.try_emplace({event.event_sample, event.event_number, event.event_text}, event);
  if (!is_new) return;
  // The newest of acceptances in a row says it all.
  if (is_acceptance(event)) {
    const auto next = std::next(added);
    if (added != events_.begin() && is_acceptance(std::prev(added)->second))
      events_.erase(std::prev(added));
    if (next != events_.end() && is_acceptance(next->second)) events_.erase(added);
  }
  if (events_.size() > kMostEvents) events_.erase(events_.begin());
}

void RunRecord::on_image(std::int64_t utime, const Place& place) {
  const auto awaited = std::ranges::find_if(
      awaited_, [&](const Picture& picture) { return picture.markers.utime == utime; });
  if (awaited == awaited_.end()) {
    image_places_.insert(utime, place);
    return;
  }
  add(&pictures_, {awaited->markers, place});
  awaited_.erase(awaited);
}

void RunRecord::on_process_info(const process_info_t& info, std::int64_t received_us) {
  Track& track = tracks_[{info.process_name, info.host, info.pid}];
  track.process.newest = info;
  const double period_s = seconds(info.utime - track.last_utime);
  // The first one has nothing to be compared with; a clock that was set back begins anew.
  if (track.last_utime == 0 || period_s < 0) {
    track.last_utime = info.utime;
    track.last_cpu_us = info.cpu_us;
    return;
  }
  if (period_s < track.period_s) return;
  const double used_s = seconds(info.cpu_us - track.last_cpu_us);
  track.process.load.push_back({.at_s = at_s(received_us),
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
  if (markers.num_markers == 0) return;
  for (const auto* known : {&pictures_, &awaited_}) {
    for (const Picture& picture : *known)
      if (picture.markers.utime == markers.utime) return;
  }
  const Place* place = image_places_.find(markers.utime);
  add(place != nullptr ? &pictures_ : &awaited_, {markers, place != nullptr ? *place : Place{}});
}

std::vector<health_event_t> RunRecord::events() const {
  const auto events = std::views::values(events_);
  return {events.begin(), events.end()};
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
    latency.seconds.push_back(seconds(to - from));
  };
  for (const auto& [utime, received] : image_received_) {
    if (const auto* markers = markers_received_.find(utime)) add(seen, received, *markers);
    if (const auto* sample = sample_received_.find(utime)) add(sampled, received, *sample);
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

double RunRecord::duration_s() const { return at_s(end_us_); }

}  // namespace bodyschema
