#include "common/schema/sample.h"

#include <algorithm>
#include <set>
#include <utility>

namespace bodyschema {

Matrix6d covariance_of_other(const PartObservation& observation, const Matrix6d& covariance) {
  Matrix6d T = Matrix6d::Identity();
  T.topLeftCorner<3, 3>() =
      observation.X_CB_other->linear().transpose() * observation.X_CB.linear();
  return T * covariance * T.transpose();
}

const PartObservation* ActionPoseSample::find(int part) const {
  const auto it = std::lower_bound(parts.begin(), parts.end(), part,
                                   [](const PartObservation& o, int id) { return o.part < id; });
  return it == parts.end() || it->part != part ? nullptr : &*it;
}

namespace {

bool rests_on(const PartObservation& observation, const std::function<bool(int tag)>& is_such) {
  return std::any_of(observation.tags.begin(), observation.tags.end(), is_such);
}

}  // namespace

const PartObservation* ActionPoseSample::find_without(const std::function<bool(int tag)>& is_such,
                                                      int part) const {
  const PartObservation* agreed = find(part);
  if (agreed && !rests_on(*agreed, is_such)) return agreed;
  const PartObservation* only = nullptr;
  for (const PartObservation& o : contradictions) {
    if (o.part != part || rests_on(o, is_such)) continue;
    if (only) return nullptr;
    only = &o;
  }
  return only;
}

void ActionPoseSample::leave_out(const std::function<bool(int tag)>& is_such) {
  std::set<int> ids;
  for (const auto* observations : {&parts, &contradictions})
    for (const PartObservation& o : *observations) ids.insert(o.part);
  std::vector<PartObservation> left;
  for (const int part : ids)
    if (const PartObservation* o = find_without(is_such, part)) left.push_back(*o);
  parts = std::move(left);
  std::erase_if(contradictions, [&](const PartObservation& o) {
    const PartObservation* believed = find(o.part);
    return rests_on(o, is_such) || (believed && believed->tags == o.tags);
  });
}

std::vector<double> numbers_of(const ActionPoseSample& sample) {
  std::vector<double> result(sample.action.begin(), sample.action.end());
  for (const PartObservation& o : sample.parts) {
    result.push_back(o.part);
    const auto X = o.X_CB.matrix();
    result.insert(result.end(), X.reshaped().begin(), X.reshaped().end());
  }
  return result;
}

}  // namespace bodyschema
