#include "processes/refiner/sample_selection.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <stdexcept>
#include <utility>

#include "common/config/calibration_id.h"
#include "common/kinematics/kinematic_tree.h"

namespace bodyschema {
namespace {

bool is_finite(const RefinerSample& seen) {
  if (!seen.sample.action.allFinite()) return false;
  for (const PartObservation& o : seen.sample.parts)
    if (!o.X_CB.matrix().allFinite() || !o.covariance.allFinite()) return false;
  return std::all_of(seen.tags.begin(), seen.tags.end(), [](const TagSight& sight) {
    return sight.corners_px.allFinite() && sight.covariance_px2.allFinite();
  });
}

void check(const BodySchema& schema, const std::vector<RefinerSample>& samples) {
  if (schema.edges.empty())
    throw std::invalid_argument("the schema connects no parts: there is nothing to refine");
  if (samples.empty()) throw std::invalid_argument("there are no samples");
  for (const RefinerSample& seen : samples) {
    const auto refuse = [&](const std::string& why) {
      throw std::invalid_argument(fmt::format("sample {} {}", seen.sample.sample_index, why));
    };
    if (seen.sample.action.size() != std::ssize(schema.signals))
      refuse(fmt::format("has {} action signals, the schema {}", seen.sample.action.size(),
                         schema.signals.size()));
    if (!is_finite(seen)) refuse("has numbers that are not finite");
  }
}

void check_calibration(const std::vector<RefinerSample>& samples,
                       const std::vector<RefinerSample>& held_out,
                       const std::optional<RigCalibration>& rig, const RefineOptions& options) {
  const char* const asked = options.placements ? "placements" : "intrinsics";
  const bool is_asked = options.placements || options.intrinsics;
  if (is_asked && !rig)
    throw std::invalid_argument(
        fmt::format("{} are refined against a rig's files: none given (--rig)", asked));
  if (is_asked && !has_corners(samples))
    throw std::invalid_argument(
        fmt::format("{} are refined by the tags' corners, which the samples do not have", asked));
  const std::int64_t id = rig ? calibration_id(rig->markers, rig->camera) : calibration_of(samples);
  for (const auto* all : {&samples, &held_out})
    for (const RefinerSample& seen : *all)
      if (seen.sample.calibration_id != 0 && seen.sample.calibration_id != id)
        throw std::invalid_argument(
            fmt::format("sample {} was seen through another calibration of tags and lens than the "
                        "{}: its markers.yaml or camera calibration is another",
                        seen.sample.sample_index, rig ? "rig's" : "first one"));
}

void leave_out_repetitions(std::vector<RefinerSample>* samples, std::vector<std::string>* held) {
  std::set<std::vector<double>> met;
  const auto removed = std::erase_if(*samples, [&](const RefinerSample& seen) {
    std::vector<double> numbers = numbers_of(seen.sample);
    for (const TagSight& sight : seen.tags) {
      numbers.push_back(sight.tag);
      numbers.insert(numbers.end(), sight.corners_px.begin(), sight.corners_px.end());
    }
    return !met.insert(std::move(numbers)).second;
  });
  if (removed > 0)
    held->push_back(fmt::format("{} samples that repeat others exactly: not fitted", removed));
}

void leave_out_those_without_corners(std::vector<RefinerSample>* samples,
                                     std::vector<std::string>* held) {
  const auto removed =
      std::erase_if(*samples, [](const RefinerSample& seen) { return seen.tags.empty(); });
  if (removed > 0) held->push_back(fmt::format("{} samples without corners: not fitted", removed));
}

/// By part of the tree, the first sample that all edges on its way are valid at.
std::map<int, std::int64_t> valid_since(const BodySchema& schema) {
  std::map<int, std::int64_t> result;
  const KinematicTree tree(schema.edges, schema.root);
  for (const KinematicTree::Node& node : tree.nodes())
    result[node.part] = node.parent < 0 ? 0
                                        : std::max(result.at(tree.nodes()[node.parent].part),
                                                   schema.edges[node.edge].valid_since_sample);
  return result;
}

/// What samples show of a schema: by their tags if there is a rig.
class ShownBody {
 public:
  ShownBody(const BodySchema& schema, const RigCalibration* rig)
      : schema_(schema), rig_(rig), valid_since_(valid_since(schema)) {}

  /// Takes from a sample what was seen of another body. Returns whether there was some.
  bool leave_out_old(RefinerSample* seen) const {
    const std::int64_t index = index_of(*seen);
    const auto is_old = [&](int part) {
      const auto since = valid_since_.find(part);
      return since != valid_since_.end() && index < since->second;
    };
    const auto num_tags = std::erase_if(seen->tags, [&](const TagSight& sight) {
      const TagPlacement* tag = rig_ ? rig_->markers.find(sight.tag) : nullptr;
      return has_moved(schema_.moved_tags, sight.tag, index) || (tag && is_old(tag->part));
    });
    drop_moved_tags(schema_.moved_tags, &seen->sample);
    const auto num_parts =
        std::erase_if(seen->sample.parts, [&](const PartObservation& o) { return is_old(o.part); });
    return num_tags + num_parts > 0;
  }

  bool is_seen_in(const RefinerSample& seen, bool but_root = false) const {
    const auto is_wanted = [&](int part) {
      return valid_since_.contains(part) && !(but_root && part == schema_.root);
    };
    if (!rig_) return std::ranges::any_of(seen.sample.parts, is_wanted, &PartObservation::part);
    return std::ranges::any_of(seen.tags, [&](const TagSight& sight) {
      const TagPlacement* tag = rig_->markers.find(sight.tag);
      return tag && is_wanted(tag->part);
    });
  }

 private:
  const BodySchema& schema_;
  const RigCalibration* const rig_;
  const std::map<int, std::int64_t> valid_since_;
};

void tell_unknown_parts(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                        std::vector<std::string>* left_out) {
  std::set<int> unknown;
  for (const RefinerSample& seen : samples)
    for (const PartObservation& o : seen.sample.parts)
      if (!schema.has_part(o.part)) unknown.insert(o.part);
  for (const int part : unknown)
    left_out->push_back(fmt::format("part {}: the schema does not have it", part));
}

}  // namespace

bool has_corners(const std::vector<RefinerSample>& samples) {
  return std::any_of(samples.begin(), samples.end(),
                     [](const RefinerSample& seen) { return !seen.tags.empty(); });
}

/// Of the first sample that tells it; 0: none does.
std::int64_t calibration_of(const std::vector<RefinerSample>& samples) {
  const auto telling = std::ranges::find_if(
      samples, [](const RefinerSample& seen) { return seen.sample.calibration_id != 0; });
  return telling == samples.end() ? 0 : telling->sample.calibration_id;
}

SampleSelection select_samples(const BodySchema& schema, std::vector<RefinerSample> samples,
                               const std::optional<RigCalibration>& rig,
                               const RefineOptions& options) {
  check(schema, samples);
  std::ranges::stable_sort(samples, {}, index_of);
  SampleSelection result;
  for (RefinerSample& seen : samples) {
    if (is_learned_from(seen.sample)) result.training.push_back(seen);
    if (seen.sample.purpose == Purpose::kTest) result.held_out.push_back(std::move(seen));
  }
  if (result.training.empty()) throw std::invalid_argument("there are no TRAIN samples");
  check_calibration(result.training, result.held_out, rig, options);
  const bool fits_corners = options.placements || options.intrinsics;
  if (fits_corners) leave_out_those_without_corners(&result.training, &result.left_out);
  leave_out_repetitions(&result.training, &result.left_out);
  tell_unknown_parts(schema, result.training, &result.left_out);

  const ShownBody body(schema, rig ? &*rig : nullptr);
  int num_old = 0;
  for (RefinerSample& seen : result.training) num_old += body.leave_out_old(&seen) ? 1 : 0;
  if (num_old > 0)
    result.left_out.push_back(
        fmt::format("what {} samples show of the body before it changed: not fitted", num_old));
  for (RefinerSample& seen : result.held_out) body.leave_out_old(&seen);
  std::erase_if(result.held_out, [](const RefinerSample& seen) {
    return seen.sample.parts.empty() && seen.tags.empty();
  });
  const ShownBody fitted(schema, fits_corners ? &*rig : nullptr);
  const auto num_empty = std::erase_if(
      result.training, [&](const RefinerSample& seen) { return !fitted.is_seen_in(seen); });
  if (result.training.empty())
    throw std::invalid_argument(
        num_old > 0    ? "all samples are of the body before it changed: give some from then on"
        : fits_corners ? "no sample shows a tag of the rig on a part of the schema"
                       : "no sample shows a part that the schema connects to its root");
  if (std::ranges::none_of(result.training, [&](const RefinerSample& seen) {
        return fitted.is_seen_in(seen, true);
      }))
    throw std::invalid_argument("the samples show no part of the schema but its root");
  if (num_empty > 0)
    result.left_out.push_back(
        fmt::format("{} samples that show nothing of the schema: not fitted", num_empty));
  return result;
}

}  // namespace bodyschema
