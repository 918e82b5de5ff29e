// Read once by the compiler instead of once a source: what nearly all of them include. Sources still
// include what they use, so that they compile without it (-DBODYSCHEMA_PRECOMPILE=OFF).
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Dense>

#include "common/geometry/pose.h"
