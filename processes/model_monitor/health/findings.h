#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/changes/change_size.h"

namespace bodyschema {

/// Something that is not as it was in the first complete schema.
struct Finding {
  enum class State : std::int8_t {
    kFound,      ///< nothing explains it yet: the schema is wrong there
    kAdopted,    ///< the schema has it
    kConfirmed,  ///< … and has held since
    kFollowed,   ///< a drift: the schema changes with each sample
    kAside       ///< a marker or tag, missing or moved: left out
  };
  State state = State::kFound;
  int from = -1, to = -1;   ///< parts of an edge; −1 for a part alone or the camera
  int part = -1, tag = -1;  ///< as in AdaptationEvent; a tag's part may be unknown (−1)
  std::string cause = {};   ///< "": not known yet
  ChangeSize size = {};
  std::int64_t since = 0;     ///< first sample that shows it
  std::int64_t found = 0;     ///< sample at which it was found
  std::int64_t adopted = -1;  ///< sample at which the schema took it over
  int num_confirming = 0;     ///< samples since then

  bool is_at(const AdaptationEvent& event) const {
    return from == event.from && to == event.to && part == event.part && tag == event.tag;
  }
};

/// What is wrong with the body until it is as it was, by the events and the adaptation's state.
class Findings {
 public:
  static constexpr std::size_t kMost = 64;

  Findings() = default;
  explicit Findings(std::vector<Finding> known) : findings_(std::move(known)) {}

  /// After adaptation.on_sample() of this sample.
  void update(const Adaptation& adaptation, const std::vector<AdaptationEvent>& events,
              std::int64_t sample_index);
  /// In the order they were found.
  const std::vector<Finding>& all() const { return findings_; }

 private:
  Finding* newest(const AdaptationEvent& event, Finding::State state);
  void hear(const Adaptation& adaptation, const AdaptationEvent& event);
  /// What is known at the event's place in this state.
  void forget(const AdaptationEvent& event, Finding::State state);
  /// `finding`, or what stands there already, is in the schema.
  void adopt(const AdaptationEvent& event, Finding finding);
  /// What was followed or adopted there is confirmed.
  void confirm(const Adaptation& adaptation, const AdaptationEvent& event);
  void agree_with(const Adaptation& adaptation, std::int64_t sample_index);

  std::vector<Finding> findings_;
};

}  // namespace bodyschema
