#include "processes/model_monitor/visibility_watch.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace bodyschema {
namespace {

/// Sightings below which a part's visibility is not known.
constexpr int kFewestSightings = 10;

/// Sightings after which something missing is back. Chosen: by them alone, one that now shows half
/// as often as before, as a part that lost one side, is told from one as before at 2⁻⁷ < 1 %.
constexpr int kReturn = 7;

double log_beta(double a, double b) { return std::lgamma(a) + std::lgamma(b) - std::lgamma(a + b); }

}  // namespace

std::vector<VisibilityWatch::Finding> VisibilityWatch::look(const std::vector<int>& parts,
                                                            const ActionPoseSample& seen,
                                                            const ActionPoseSample& used,
                                                            const MovedTags& moved) {
  std::vector<Finding> findings;
  for (const int part : parts) {
    const int num_lying = moved.num_lying(part);
    if (num_lying > num_lying_[part]) begin_anew(part);
    num_lying_[part] = num_lying;
    const PartObservation* observation = seen.find(part);
    // A marker that lies somewhere is none; a tag that moved is still one.
    if (observation &&
        (moved.has_lying(*observation) || (!used.find(part) && !moved.affects(*observation))))
      observation = nullptr;
    count(part, kAnyTag, observation, &findings);
    // An arm that holds still or is led shows one side of its parts for as long.
    if (!observation || seen.purpose == Purpose::kControl) continue;
    const std::vector<int>& tags = observation->tags;
    auto& of_part = counts_[part];
    for (const int tag : tags) of_part[tag];
    if (of_part.size() < 3) continue;  // its only tag is the part's marker
    for (const auto& [tag, _] : of_part)
      if (tag != kAnyTag && !moved.has_moved(tag))
        count(part, tag, std::find(tags.begin(), tags.end(), tag) != tags.end(), &findings);
  }
  return findings;
}

void VisibilityWatch::count(int part, int tag, bool is_seen, std::vector<Finding>* findings) {
  Count& c = counts_[part][tag];
  if (c.is_missing) return count_return(part, tag, is_seen, findings);
  if (is_seen) {
    c.num_asked += c.num_missed + 1;
    c.num_missed = 0;
    ++c.num_seen;
    return;
  }
  ++c.num_missed;
  if (c.num_seen < kFewestSightings || is_by_chance(c)) return;
  c.is_missing = true;
  findings->push_back({part, tag, true, false, c.num_missed});
  if (tag != kAnyTag) begin_anew(part);
}

void VisibilityWatch::count_return(int part, int tag, bool is_seen,
                                   std::vector<Finding>* findings) {
  Count& c = counts_[part][tag];
  c.num_missed = is_seen ? 0 : c.num_missed + 1;
  c.was_seen_again |= is_seen;
  c.num_back += is_seen;
  if (!is_seen && !is_by_chance(c)) c.num_back = c.num_since_back = 0;
  c.num_since_back += c.num_back > 0;
  if (c.num_back < kReturn) return;
  findings->push_back({part, tag, false, c.is_as_before(), c.num_since_back});
  c = {};  // it need not be seen as often as before
}

bool VisibilityWatch::is_by_chance(const Count& c) const {
  const auto num = std::accumulate(
      counts_.begin(), counts_.end(), std::size_t{0},
      [](std::size_t sum, const auto& of_part) { return sum + of_part.second.size(); });
  return c.chance_of_misses() * static_cast<double>(num) > false_alarm_rate_;
}

double VisibilityWatch::Count::chance_of_misses() const {
  // What was in sight in its first ten samples is not known to be seen always.
  const double a = num_seen + 0.5, b = num_asked - num_seen + 0.5;
  return std::exp(log_beta(a + 1, b + num_missed) - log_beta(a, b));
}

bool VisibilityWatch::Count::is_as_before() const {
  const double v = (num_seen + 0.5) / (num_asked + 1);
  return num_back * std::log(2) + (num_since_back - num_back) * std::log((1 - v) / (1 - v / 2)) > 0;
}

void VisibilityWatch::begin_anew(int part) {
  Count& c = counts_[part][kAnyTag];
  // That a tag is lost says why the part was missed, if others show it.
  if (!c.is_missing || c.was_seen_again) c = {};
}

int VisibilityWatch::lose(int part, int num_missed) {
  Count& c = counts_[part][kAnyTag];
  c.is_missing = true;
  c.num_back = c.num_since_back = 0;
  return c.num_missed += num_missed;
}

bool VisibilityWatch::is_missing(int part) const {
  const auto it = counts_.find(part);
  if (it == counts_.end()) return false;
  const auto any = it->second.find(kAnyTag);
  return any != it->second.end() && any->second.is_missing;
}

std::vector<int> VisibilityWatch::missing_parts() const {
  std::vector<int> parts;
  for (const auto& [part, _] : counts_)
    if (is_missing(part)) parts.push_back(part);
  return parts;
}

void VisibilityWatch::forget_tags() {
  for (auto& [part, tags] : counts_)
    std::erase_if(tags, [](const auto& of_tag) { return of_tag.first != kAnyTag; });
}

void VisibilityWatch::tell_tags_again() {
  for (auto& [part, tags] : counts_)
    for (auto& [tag, of_tag] : tags)
      if (tag != kAnyTag) of_tag.is_missing = false;
}

}  // namespace bodyschema
