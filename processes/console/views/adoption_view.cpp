#include "processes/console/views/adoption_view.h"

#include <fmt/format.h>

#include <algorithm>

#include "common/geometry/angle.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

std::string tags_text(const Markers& before, const Markers& after) {
  std::string text = "  tag  part  moves [mm]  turns [°]  size [%]\n";
  int num_same = 0;
  for (const TagPlacement& was : before.tags) {
    const TagPlacement& is = *after.find(was.id);
    const Pose change = was.X_BM && is.X_BM ? was.X_BM->inverse() * *is.X_BM : Pose::Identity();
    const double moves_mm = 1e3 * change.translation().norm();
    const double turns_deg = rotation_angle(change) / kDegree;
    const double larger_percent = 100 * (is.size_m / was.size_m - 1);
    if (moves_mm < 5e-4 && turns_deg < 5e-4 && std::abs(larger_percent) < 5e-4) {
      ++num_same;
      continue;
    }
    text += fmt::format("  {:>3}  {:>4}  {:>10.3f}  {:>9.3f}  {:>+8.3f}\n", was.id, was.part,
                        moves_mm, turns_deg, larger_percent);
  }
  if (num_same > 0) text += fmt::format("  {} as before\n", counted(num_same, "tag"));
  return text;
}

std::string lens_text(const CameraCalibration& before, const CameraCalibration& after) {
  std::string text;
  const auto add = [&](const char* name, double was, double is) {
    if (was != is)
      text += fmt::format("  {:<15} {:.2f} → {:.2f} px ({:+.3f})\n", name, was, is, is - was);
  };
  add("focal length x", before.fx, after.fx);
  add("focal length y", before.fy, after.fy);
  add("centre x", before.cx, after.cx);
  add("centre y", before.cy, after.cy);
  for (std::size_t n = 0; n < after.distortion.size(); ++n) {
    const double was = n < before.distortion.size() ? before.distortion[n] : 0;
    if (was != after.distortion[n])
      text += fmt::format("  distortion {:<4} {:.5f} → {:.5f}\n", n + 1, was, after.distortion[n]);
  }
  return text.empty() ? "  lens as before\n" : text;
}

}  // namespace

std::string adoption_text(const Markers& before, const Markers& after,
                          const CameraCalibration& lens_before,
                          const CameraCalibration& lens_after) {
  return tags_text(before, after) + lens_text(lens_before, lens_after);
}

}  // namespace bodyschema
