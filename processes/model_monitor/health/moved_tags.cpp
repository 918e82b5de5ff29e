#include "processes/model_monitor/health/moved_tags.h"

#include <algorithm>
#include <cmath>

namespace bodyschema {
namespace {

constexpr double kSame = ReadingDistance::kSame, kOther = ReadingDistance::kOther;
/// Of the tag in the wrong place, and of others in the right one: an outlier repeats itself rarely.
constexpr int kSightings = 3;
/// Log-likelihood ratios of a tag having moved to the body being wrong, of a sighting by another
/// tag in its place and elsewhere: it is elsewhere as often as there are outliers (3 %,
/// docs/results.md), or half of the time (chosen: a body that is wrong shows by some
/// actions only).
const double kInPlace = std::log(0.97 / 0.5), kElsewhere = std::log(0.03 / 0.5);
/// Of a sighting of the tag itself while another of the part is in its place in the same picture:
/// were the body wrong, that one would be an outlier.
const double kContradicted = std::log(0.97 / 0.03);
/// Sightings of a part in a row, all by tags set aside that move with it, after which they are what
/// there is of it.
constexpr int kAlone = 30;

}  // namespace

MovedTags::MovedTags(const std::vector<MovedTag>& moved) {
  for (const MovedTag& tag : moved)
    if (tag.until < 0) tracks_[tag.tag] = {.since = tag.since, .has_moved = true};
}

bool MovedTags::has_moved(int tag) const {
  const auto track = tracks_.find(tag);
  return track != tracks_.end() && track->second.has_moved;
}

bool MovedTags::is_lying(int tag) const {
  const auto track = tracks_.find(tag);
  return track != tracks_.end() && track->second.has_moved && track->second.is_lying;
}

void MovedTags::look_back(const ActionPoseSample& sample, const BodySchema& schema,
                          const MeasurementModel& measurement) {
  // Before they moved they were where they should be.
  ActionPoseSample after = sample;
  after.leave_out([&](int tag) {
    const auto track = tracks_.find(tag);
    return track != tracks_.end() && track->second.has_moved &&
           sample.sample_index < track->second.since;
  });
  // They were not back by then, whatever the noise is now thought to be, and no other had moved.
  for (const Finding& finding : look(after, schema, schema, measurement, true))
    if (finding.is_back)
      tracks_[finding.tag] = {
          .num_alike = kSightings - 1, .has_moved = true, .is_on_part = finding.is_on_part};
  begin_anew();
}

void MovedTags::begin_anew() {
  std::erase_if(tracks_, [](const auto& track) { return !track.second.has_moved; });
}

std::vector<MovedTags::Finding> MovedTags::look(const ActionPoseSample& sample,
                                                const BodySchema& schema,
                                                const BodySchema& standing,
                                                const MeasurementModel& measurement, bool is_past) {
  std::vector<Finding> findings;
  const auto X_RB = schema.predict_all(sample.action);
  const auto standing_X_RB = standing.predict_all(sample.action);
  std::map<int, std::vector<Reading>> readings_of;
  for (const auto* observations : {&sample.parts, &sample.contradictions}) {
    for (const PartObservation& seen : *observations) {
      const auto predicted = X_RB.find(seen.part);
      if (seen.tags.empty() || !seen.has_rotation || predicted == X_RB.end()) continue;
      Reading reading{&seen, ReadingDistance(measurement.covariance(seen))};
      const auto from = [&](const Pose& X) {
        const double d2 = reading.distance(X, seen.X_CB);
        return seen.X_CB_other ? std::min(d2, reading.distance(X, *seen.X_CB_other)) : d2;
      };
      reading.far_off = from(schema.X_CR * predicted->second);
      const auto by_standing = standing_X_RB.find(seen.part);
      reading.is_explained =
          by_standing != standing_X_RB.end() && from(standing.X_CR * by_standing->second) < kSame;
      readings_of[seen.part].push_back(reading);
    }
  }
  for (const auto& [part, readings] : readings_of) {
    if (are_alone(readings, sample, is_past, &findings)) continue;
    std::set<int> in_sight;
    for (const Reading& r : readings) in_sight.insert(r.seen->tags.begin(), r.seen->tags.end());
    in_sight_[part].insert(in_sight.begin(), in_sight.end());
    const auto in_place =
        std::ranges::find_if(readings, [](const Reading& r) { return r.far_off < kSame; });
    if (in_place != readings.end()) {
      for (const int tag : in_sight_[part]) {
        const auto track = tracks_.find(tag);
        if (track == tracks_.end() || in_sight.contains(tag)) continue;
        track->second.others += kInPlace;
        track->second.num_unexplained += !in_place->is_explained;
      }
    }
    for (const Reading& reading : readings) {
      if (reading.far_off < kSame)
        look_in_place(reading, sample.sample_index, &findings);
      else if (reading.far_off > kOther)
        look_elsewhere(reading, schema.X_CR * X_RB.at(part), in_place != readings.end(),
                       sample.sample_index, &findings);
    }
  }
  return findings;
}

bool MovedTags::are_alone(const std::vector<Reading>& readings, const ActionPoseSample& sample,
                          bool is_past, std::vector<Finding>* findings) {
  std::vector<int> shown_by;
  for (const Reading& reading : readings) {
    const std::vector<int>& tags = reading.seen->tags;
    if (std::ranges::any_of(tags, [this](int tag) { return is_lying(tag); })) continue;
    if (std::ranges::none_of(tags, [this](int tag) { return has_moved(tag); })) {
      num_alone_[reading.seen->part] = 0;
      return false;
    }
    shown_by.insert(shown_by.end(), tags.begin(), tags.end());
  }
  if (shown_by.empty() || sample.purpose == Purpose::kControl) return false;
  const int part = readings.front().seen->part;
  int& num = num_alone_[part];
  if (++num < kAlone) return false;
  num = is_past ? kAlone - 1 : 0;  // it was not given up by then
  if (is_past) return false;
  for (const int tag : shown_by)
    if (has_moved(tag) && tracks_.erase(tag))
      findings->push_back({part, tag, sample.sample_index, kAlone, false, true});
  return true;
}

void MovedTags::look_in_place(const Reading& reading, std::int64_t sample_index,
                              std::vector<Finding>* findings) {
  for (const int tag : reading.seen->tags) {
    const auto track = tracks_.find(tag);
    if (track == tracks_.end()) continue;
    track->second.is_lying = false;
    if (!track->second.has_moved) {
      tracks_.erase(track);
    } else if (++track->second.num_alike == kSightings) {
      findings->push_back(
          {reading.seen->part, tag, sample_index, kSightings, track->second.is_on_part, true});
      tracks_.erase(track);
    }
  }
}

void MovedTags::look_elsewhere(const Reading& reading, const Pose& X_CB, bool is_contradicted,
                               std::int64_t sample_index, std::vector<Finding>* findings) {
  const PartObservation& seen = *reading.seen;
  if (seen.tags.size() > 1) {
    if (std::ranges::none_of(seen.tags, [this](int tag) { return has_moved(tag); }))
      count_elsewhere(seen);
    return;
  }
  const int tag = seen.tags.front();
  Track& track = tracks_[tag];
  const Pose X_BS = X_CB.inverse() * seen.X_CB;
  const bool is_alike_on_part = reading.distance(track.X_BS, X_BS) < kSame;
  const bool is_alike_in_room = reading.distance(track.X_CB, seen.X_CB) < kSame;
  const double contradiction = is_contradicted ? kContradicted : 0;
  if (track.has_moved) {
    track.num_alike = 0;
    track.is_on_part |= is_alike_on_part && !is_alike_in_room;
    if (is_alike_on_part != is_alike_in_room) track.is_lying = is_alike_in_room;
    track.X_BS = X_BS;
    track.X_CB = seen.X_CB;
  } else if (track.num_alike == 0 || !(is_alike_on_part || is_alike_in_room)) {
    track = {sample_index, 1, contradiction, !reading.is_explained, seen.X_CB, X_BS};
    if (!is_contradicted) count_elsewhere(seen);
  } else {
    ++track.num_alike;
    track.others += contradiction;
    track.num_unexplained += !reading.is_explained;
    if (std::min(track.num_alike, track.num_unexplained) < kSightings ||
        track.others < (kSightings - 0.5) * kInPlace)
      return;
    findings->push_back({seen.part, tag, track.since, track.num_alike, is_alike_on_part});
    track.has_moved = true;
    track.is_on_part = is_alike_on_part;
    track.is_lying = is_alike_in_room && !is_alike_on_part;
    track.num_alike = 0;
  }
}

void MovedTags::count_elsewhere(const PartObservation& seen) {
  for (const int tag : in_sight_[seen.part])
    if (const auto track = tracks_.find(tag);
        track != tracks_.end() && seen.tags != std::vector<int>{tag})
      track->second.others += kElsewhere;
}

}  // namespace bodyschema
