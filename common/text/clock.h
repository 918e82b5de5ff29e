#pragma once

#include <chrono>
#include <cstdint>

namespace bodyschema {

/// Time of `Clock` since its epoch [us].
template <class Clock>
std::int64_t now_us() {
  return std::chrono::duration_cast<std::chrono::microseconds>(Clock::now().time_since_epoch())
      .count();
}
/// [s] of microseconds.
constexpr double seconds(std::int64_t us) { return static_cast<double>(us) * 1e-6; }
/// A clock that never runs backwards [us].
inline std::int64_t clock_us() { return now_us<std::chrono::steady_clock>(); }
/// [us since 1970]
inline std::int64_t wall_clock_us() { return now_us<std::chrono::system_clock>(); }

}  // namespace bodyschema
