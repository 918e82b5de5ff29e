#include "common/geometry/instantiations.h"

namespace Eigen {

BODYSCHEMA_INSTANTIATIONS()

}  // namespace Eigen
