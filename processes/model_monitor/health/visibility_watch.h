#pragma once

#include <map>
#include <vector>

#include "common/schema/sample.h"
#include "processes/model_monitor/health/moved_tags.h"

namespace bodyschema {

/// Finds parts, and tags of parts that have several, that have not been seen for longer than chance
/// explains: a run of m misses begins at any sample with probability v (1 − v)^m, v the share of
/// samples that show it: its mean over what v may be (Jeffreys' prior).
class VisibilityWatch {
 public:
  /// `false_alarm_rate`: a sample, over all parts and tags together.
  explicit VisibilityWatch(double false_alarm_rate) : false_alarm_rate_(false_alarm_rate) {}

  static constexpr int kAnyTag = -1;
  struct Finding {
    int part = 0;
    int tag = kAnyTag;
    bool is_missing = false;  ///< else it is seen again
    int num_missed = 0;       ///< samples in a row
  };
  /// `seen`: all of a sample; `used`: without what is not believed. One of the `moved` tags shows
  /// its part as well; these tags are not looked for.
  std::vector<Finding> look(const std::vector<int>& parts, const ActionPoseSample& seen,
                            const ActionPoseSample& used, const MovedTags& moved);
  /// A part that lies somewhere: its marker is missing, and was in the last `num_missed` samples.
  /// Returns the misses in a row so far.
  int lose(int part, int num_missed);
  bool is_missing(int part) const;
  std::vector<int> missing_parts() const;

  /// How often a tag is seen is to be found out anew.
  void forget(int part, int tag) { counts_[part][tag] = {}; }
  /// So of all tags: a body that moves otherwise shows other sides of its parts.
  void forget_tags();
  /// Nobody was told of the tags that were found missing: they are found again.
  void tell_tags_again();

 private:
  struct Count {
    int num_seen = 0, num_asked = 0;  ///< before the present run of misses
    int num_missed = 0;               ///< in a row
    bool is_missing = false;
  };
  void count(int part, int tag, bool is_seen, std::vector<Finding>* findings);

  double false_alarm_rate_;
  std::map<int, std::map<int, Count>> counts_;  ///< by part and tag
};

}  // namespace bodyschema
