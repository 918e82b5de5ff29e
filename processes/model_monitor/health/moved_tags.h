#pragma once

#include <cstdint>
#include <map>
#include <set>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/model_monitor/likelihood/reading_distance.h"
#include "processes/model_monitor/likelihood/tree_filter.h"

namespace bodyschema {

/// Finds tags that moved on their part, or fell off it and lie in sight, where others of the part
/// stayed. A tag has moved once it was seen in one wrong place again and again (on the part, or
/// lying in the room), never in the right one, and other tags of the part in theirs. Where these,
/// too, are now here and now there, or a change of the body that was found meanwhile explains it
/// all, the body is wrong. A tag that moved or was lost is back once it is seen in its place again,
/// or where a babbling arm shows the part for long by such tags alone that move with it.
class MovedTags {
 public:
  /// `moved`: those known already.
  explicit MovedTags(const std::vector<MovedTag>& moved);

  struct Finding {
    int part = 0;
    int tag = 0;
    std::int64_t since = 0;  ///< first sample that showed it there
    int num_sightings = 0;
    bool is_on_part = false;  ///< moved on it; else it was lost, and maybe lies in sight
    bool is_back = false;     ///< it is where it was, or all that there is
  };
  /// `schema`: the body before anything was wrong; `standing`: as it is now thought to be. Of a
  /// sample of the past no tag is taken for back because it is alone.
  std::vector<Finding> look(const ActionPoseSample& sample, const BodySchema& schema,
                            const BodySchema& standing, const MeasurementModel& measurement,
                            bool is_past = false);
  /// Samples of the past: what they say of those known.
  void look_back(const ActionPoseSample& sample, const BodySchema& schema,
                 const MeasurementModel& measurement);
  /// Another schema than before is right: of those that are in their places nothing is known.
  void begin_anew();
  /// It is not seen any more.
  void lose(int tag) { tracks_[tag] = {.has_moved = true}; }
  bool has_moved(int tag) const;
  /// Of those that have: it was seen last where it lies in the room while the part moves.
  bool is_lying(int tag) const;

 private:
  struct Track {
    std::int64_t since = 0;  ///< of the present run of sightings alike
    int num_alike = 0;       ///< in the wrong place or, once moved, in the right one
    /// Of the part's sightings since by other tags: log-likelihood ratio of this tag having moved
    /// to the body being wrong there [nats].
    double others = 0;
    int num_unexplained = 0;  ///< sightings since that the body as it then stood did not explain
    /// The first of that run: the part as seen; and in its own frame.
    Pose X_CB = Pose::Identity(), X_BS = Pose::Identity();
    bool has_moved = false;
    bool is_on_part = false;  ///< and moves with it
    bool is_lying = false;    ///< and did not when it was seen last
  };
  /// What a sample shows of a part: every pose that its tags have it in.
  struct Reading {
    const PartObservation* seen = nullptr;
    ReadingDistance distance;
    double far_off = 0;         ///< d² from the body before anything was wrong
    bool is_explained = false;  ///< by the body as it is now thought to be
  };
  /// Whether such tags alone show the part for long: they are taken for back.
  bool are_alone(const std::vector<Reading>& readings, const ActionPoseSample& sample, bool is_past,
                 std::vector<Finding>* findings);
  void look_in_place(const Reading& reading, std::int64_t sample_index,
                     std::vector<Finding>* findings);
  /// `is_contradicted`: another tag is in its place in the same picture.
  void look_elsewhere(const Reading& reading, const Pose& X_CB, bool is_contradicted,
                      std::int64_t sample_index, std::vector<Finding>* findings);
  /// The part was seen elsewhere, not by one of its moved tags.
  void count_elsewhere(const PartObservation& seen);

  std::map<int, Track> tracks_;            ///< by tag
  std::map<int, std::set<int>> in_sight_;  ///< the tags of every part that were ever seen
  std::map<int, int> num_alone_;           ///< sightings of every part in a row by moved tags alone
};

}  // namespace bodyschema
