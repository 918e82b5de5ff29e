#include "common/schema/sample.h"

#include <algorithm>

namespace bodyschema {

const PartObservation* ActionPoseSample::find(int part) const {
  const auto it = std::lower_bound(parts.begin(), parts.end(), part,
                                   [](const PartObservation& o, int id) { return o.part < id; });
  return it == parts.end() || it->part != part ? nullptr : &*it;
}

}  // namespace bodyschema
