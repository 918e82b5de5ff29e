#include "processes/model_monitor/moved_tags.h"

#include <algorithm>
#include <cmath>

#include "processes/model_monitor/reading_distance.h"

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
/// Sightings of a part in a row, all by tags set aside, after which they are what there is of it.
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

bool MovedTags::affects(const PartObservation& observation) const {
  return std::any_of(observation.tags.begin(), observation.tags.end(),
                     [this](int tag) { return has_moved(tag); });
}

void MovedTags::look_back(const ActionPoseSample& sample, const BodySchema& schema,
                          const MeasurementModel& measurement) {
  // Before they moved they were where they should be.
  ActionPoseSample after = sample;
  std::erase_if(after.parts, [&](const PartObservation& o) {
    return std::any_of(o.tags.begin(), o.tags.end(), [&](int tag) {
      const auto track = tracks_.find(tag);
      return track != tracks_.end() && track->second.has_moved &&
             sample.sample_index < track->second.since;
    });
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
                                                const MeasurementModel& measurement) {
  return look(sample, schema, standing, measurement, false);
}

std::vector<MovedTags::Finding> MovedTags::look(const ActionPoseSample& sample,
                                                const BodySchema& schema,
                                                const BodySchema& standing,
                                                const MeasurementModel& measurement, bool is_past) {
  std::vector<Finding> findings;
  const auto X_RB = schema.predict_all(sample.action);
  const auto standing_X_RB = standing.predict_all(sample.action);
  for (const PartObservation& seen : sample.parts) {
    const auto predicted = X_RB.find(seen.part);
    if (seen.tags.empty() || predicted == X_RB.end()) continue;
    const Pose X_CB = schema.X_CR * predicted->second;
    const ReadingDistance distance(measurement.covariance(seen));
    const auto from = [&](const Pose& X) {
      const double d2 = distance(X, seen.X_CB);
      return seen.X_CB_other ? std::min(d2, distance(X, *seen.X_CB_other)) : d2;
    };
    const double far_off = from(X_CB);
    const auto by_standing = standing_X_RB.find(seen.part);
    const bool is_explained =
        by_standing != standing_X_RB.end() && from(standing.X_CR * by_standing->second) < kSame;

    if (int& num = num_affected_[seen.part]; !affects(seen)) {
      num = 0;
    } else if (sample.purpose != Purpose::kControl && ++num >= kAlone && is_past) {
      num = kAlone - 1;  // it was not given up by then
    } else if (num >= kAlone) {
      num = 0;
      for (const int tag : seen.tags) {
        const auto track = tracks_.find(tag);
        if (track == tracks_.end() || !track->second.has_moved) continue;
        findings.push_back({seen.part, tag, sample.sample_index, kAlone, false, true});
        tracks_.erase(track);
      }
      continue;
    }
    std::vector<int>& siblings = of_[seen.part];
    for (const int tag : seen.tags)
      if (std::find(siblings.begin(), siblings.end(), tag) == siblings.end())
        siblings.push_back(tag);
    if (far_off < kSame) {
      for (const int tag : siblings) {
        const auto track = tracks_.find(tag);
        if (track == tracks_.end()) continue;
        const bool is_seen = std::find(seen.tags.begin(), seen.tags.end(), tag) != seen.tags.end();
        if (!is_seen) {
          track->second.others += kInPlace;
          track->second.num_unexplained += !is_explained;
        } else if (!track->second.has_moved) {
          tracks_.erase(track);
        } else if (++track->second.num_alike == kSightings) {
          findings.push_back(
              {seen.part, tag, sample.sample_index, kSightings, track->second.is_on_part, true});
          tracks_.erase(track);
        }
      }
    } else if (far_off > kOther && seen.tags.size() == 1) {
      Track& track = tracks_[seen.tags.front()];
      const Pose X_BS = X_CB.inverse() * seen.X_CB;
      const bool is_alike_on_part = distance(track.X_BS, X_BS) < kSame;
      const bool is_alike_in_room = distance(track.X_CB, seen.X_CB) < kSame;
      if (track.has_moved) {
        track.num_alike = 0;
        track.is_on_part |= is_alike_on_part && !is_alike_in_room;
        track.X_BS = X_BS;
        track.X_CB = seen.X_CB;
      } else if (track.num_alike == 0 || !(is_alike_on_part || is_alike_in_room)) {
        track = {sample.sample_index, 1, 0, !is_explained, seen.X_CB, X_BS};
        count_elsewhere(seen);
      } else {
        ++track.num_alike;
        track.num_unexplained += !is_explained;
        if (std::min(track.num_alike, track.num_unexplained) < kSightings ||
            track.others < (kSightings - 0.5) * kInPlace)
          continue;
        findings.push_back(
            {seen.part, seen.tags.front(), track.since, track.num_alike, is_alike_on_part});
        track.has_moved = true;
        track.is_on_part = is_alike_on_part;
        track.num_alike = 0;
      }
    } else if (far_off > kOther && !affects(seen)) {
      count_elsewhere(seen);
    }
  }
  return findings;
}

void MovedTags::count_elsewhere(const PartObservation& seen) {
  for (const int tag : of_[seen.part])
    if (const auto track = tracks_.find(tag);
        track != tracks_.end() && seen.tags != std::vector<int>{tag})
      track->second.others += kElsewhere;
}

}  // namespace bodyschema
