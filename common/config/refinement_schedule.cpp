#include "common/config/refinement_schedule.h"

#include "common/config/yaml.h"

namespace bodyschema {

std::int64_t refine_every(const Yaml& refiner) {
  return refiner.integer("refine_every", 1, 1'000'000);
}

}  // namespace bodyschema
