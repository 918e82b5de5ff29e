#include "processes/model_monitor/health/visibility_watch.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <set>

namespace bodyschema {
namespace {

/// Sightings below which a part's visibility is not known.
constexpr int kFewestSightings = 10;

double log_beta(double a, double b) { return std::lgamma(a) + std::lgamma(b) - std::lgamma(a + b); }

}  // namespace

std::vector<VisibilityWatch::Finding> VisibilityWatch::look(const std::vector<int>& parts,
                                                            const ActionPoseSample& seen,
                                                            const ActionPoseSample& used,
                                                            const MovedTags& moved) {
  std::vector<Finding> findings;
  for (const int part : parts) {
    // A tag that lies somewhere is none; one that moved is.
    std::set<int> tags;
    for (const auto* observations : {&seen.parts, &seen.contradictions})
      for (const PartObservation& o : *observations)
        if (o.part == part)
          std::ranges::copy_if(o.tags, std::inserter(tags, tags.end()),
                               [&](int tag) { return !moved.is_lying(tag); });
    const bool is_seen =
        used.find(part) || std::ranges::any_of(tags, [&](int tag) { return moved.has_moved(tag); });
    count(part, kAnyTag, is_seen, &findings);
    // An arm that holds still or is led shows one side of its parts for as long.
    if (!is_seen || seen.purpose == Purpose::kControl) continue;
    auto& of_part = counts_[part];
    for (const int tag : tags) of_part[tag];
    if (of_part.size() < 3) continue;  // its only tag is the part's marker
    for (const auto& [tag, _] : of_part)
      if (tag != kAnyTag && !moved.has_moved(tag)) count(part, tag, tags.contains(tag), &findings);
  }
  return findings;
}

void VisibilityWatch::count(int part, int tag, bool is_seen, std::vector<Finding>* findings) {
  Count& c = counts_[part][tag];
  if (is_seen) {
    // What is seen again need not be seen as often as before.
    if (c.is_missing) {
      findings->push_back({part, tag, false, c.num_missed});
      c = {};
    }
    c.num_asked += c.num_missed + 1;
    c.num_missed = 0;
    ++c.num_seen;
    return;
  }
  ++c.num_missed;
  if (c.is_missing || c.num_seen < kFewestSightings) return;
  std::size_t num = 0;
  for (const auto& [_, of_part] : counts_) num += of_part.size();
  // What was in sight in its first ten samples is not known to be seen always.
  const double a = c.num_seen + 0.5, b = c.num_asked - c.num_seen + 0.5;
  const double chance = std::exp(log_beta(a + 1, b + c.num_missed) - log_beta(a, b));
  if (chance * static_cast<double>(num) > false_alarm_rate_) return;
  c.is_missing = true;
  findings->push_back({part, tag, true, c.num_missed});
}

int VisibilityWatch::lose(int part, int num_missed) {
  Count& c = counts_[part][kAnyTag];
  c.is_missing = true;
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
