#include "processes/console/views/adoption_view.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <set>
#include <vector>

#include "common/camera/lens.h"
#include "common/geometry/angle.h"
#include "common/text/text.h"
#include "processes/camera/camera.h"

namespace bodyschema {
namespace {

/// "a", "a and b", "a, b and c".
std::string enumerated(const std::vector<std::string>& words) {
  if (words.size() < 2) return words.empty() ? "" : words.front();
  return fmt::format("{} and {}", fmt::join(words.begin(), words.end() - 1, ", "), words.back());
}

std::string differ(const std::vector<std::string>& what, bool is_one) {
  return what.empty() ? "" : enumerated(what) + (is_one ? " differs" : " differ");
}

bool is_same(const TagPlacement& one, const TagPlacement& other) {
  return calibration_id(Markers{"", {one}}, {}) == calibration_id(Markers{"", {other}}, {});
}

bool is_same(double one, double other, double unit) {
  return std::llround(one / unit) == std::llround(other / unit);
}

double coefficient(const CameraCalibration& camera, std::size_t n) {
  return n < camera.distortion.size() ? camera.distortion[n] : 0;
}

std::string size_text(const CameraCalibration& camera) {
  return fmt::format("{}×{} px", camera.width, camera.height);
}

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
  if (num_same == static_cast<int>(before.tags.size())) return "  tags as before\n";
  if (num_same > 0) text += fmt::format("  {} as before\n", counted(num_same, "tag"));
  return text;
}

/// OpenCV's names in OpenCV's order.
std::string coefficient_name(CameraCalibration::Model model, std::size_t n) {
  constexpr std::array kPerspective = {"k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"};
  return model == CameraCalibration::Model::kFisheye ? fmt::format("k{}", n + 1)
                                                     : kPerspective.at(n);
}

/// How far the points of an image move that are seen along the same rays, over a grid of the image.
std::string shifts_text(const CameraCalibration& before, const CameraCalibration& after) {
  const Lens was(make_info(before, 0)), is(make_info(after, 0));
  constexpr int kSteps = 8;
  double sum_px = 0, largest_px = 0;
  int count = 0;
  for (int i = 0; i <= kSteps; ++i) {
    for (int j = 0; j <= kSteps; ++j) {
      const Eigen::Vector2d p_px((before.width - 1.0) * i / kSteps,
                                 (before.height - 1.0) * j / kSteps);
      const auto point = was.straighten(p_px);
      if (!point) continue;
      const double shift_px = (is.project(point->ray) - p_px).norm();
      sum_px += shift_px;
      largest_px = std::max(largest_px, shift_px);
      ++count;
    }
  }
  if (count == 0) return "";
  return fmt::format("  points of the image move by {:.2f} px on average, {:.2f} px at most\n",
                     sum_px / count, largest_px);
}

std::string lens_text(const CameraCalibration& before, const CameraCalibration& after) {
  if (lens_values_that_differ(before, after).empty()) return "  lens as before\n";
  std::string text;
  const auto add = [&](const char* name, double was, double is, const std::string& change) {
    if (was != is) text += fmt::format("  {:<15} {:.2f} → {:.2f} px ({})\n", name, was, is, change);
  };
  const auto larger = [](double was, double is) {
    return fmt::format("{:+.3f} %", 100 * (is / was - 1));
  };
  const auto moved = [](double was, double is) { return fmt::format("{:+.2f}", is - was); };
  add("focal length x", before.fx, after.fx, larger(before.fx, after.fx));
  add("focal length y", before.fy, after.fy, larger(before.fy, after.fy));
  add("centre x", before.cx, after.cx, moved(before.cx, after.cx));
  add("centre y", before.cy, after.cy, moved(before.cy, after.cy));
  for (std::size_t n = 0; n < std::max(before.distortion.size(), after.distortion.size()); ++n) {
    const double was = coefficient(before, n), is = coefficient(after, n);
    if (was != is)
      text += fmt::format("  distortion {:<4} {:.5f} → {:.5f}\n", coefficient_name(after.model, n),
                          was, is);
  }
  return text + shifts_text(before, after);
}

}  // namespace

std::string adoption_text(const RigCalibration& before, const RigCalibration& after) {
  return tags_text(before.markers, after.markers) + lens_text(before.camera, after.camera);
}

std::string tags_that_differ(const Markers& one, const Markers& other) {
  std::set<int> ids;
  for (const Markers* markers : {&one, &other})
    for (const TagPlacement& tag : markers->tags) ids.insert(tag.id);
  std::vector<std::string> names;
  for (const int id : ids) {
    const TagPlacement *a = one.find(id), *b = other.find(id);
    if (!a || !b || !is_same(*a, *b)) names.push_back(std::to_string(id));
  }
  std::vector<std::string> what;
  if (one.family != other.family) what.push_back("the family");
  if (!names.empty()) what.push_back((names.size() == 1 ? "tag " : "tags ") + enumerated(names));
  return differ(what, what.size() == 1 && names.size() < 2);
}

std::string lens_values_that_differ(const CameraCalibration& one, const CameraCalibration& other) {
  constexpr double kPixel = 1e-6, kFraction = 1e-9;  // those of calibration_id()
  const auto is_fisheye = [](const CameraCalibration& camera) {
    return camera.model == CameraCalibration::Model::kFisheye;
  };
  std::vector<std::string> what;
  if (one.width != other.width || one.height != other.height) what.push_back("image size");
  if (!is_same(one.fx, other.fx, kPixel) || !is_same(one.fy, other.fy, kPixel))
    what.push_back("focal length");
  if (!is_same(one.cx, other.cx, kPixel) || !is_same(one.cy, other.cy, kPixel))
    what.push_back("centre");
  bool is_distortion_same = is_fisheye(one) == is_fisheye(other);
  for (std::size_t n = 0; n < std::max(one.distortion.size(), other.distortion.size()); ++n)
    is_distortion_same &= is_same(coefficient(one, n), coefficient(other, n), kFraction);
  if (!is_distortion_same) what.push_back("distortion");
  return differ(what, what.size() == 1);
}

std::string other_tags_text(const Markers& recorded, const Markers& proposed) {
  std::vector<std::string> reasons;
  if (proposed.family != recorded.family)
    reasons.push_back(
        fmt::format("the tags are of {}, the run's of {}", proposed.family, recorded.family));
  for (const TagPlacement& tag : recorded.tags) {
    const TagPlacement* other = proposed.find(tag.id);
    if (!other)
      reasons.push_back(fmt::format("tag {} is missing", tag.id));
    else if (other->part != tag.part)
      reasons.push_back(fmt::format("tag {} is on part {}, in the run on part {}", tag.id,
                                    other->part, tag.part));
    else if (other->X_BM.has_value() != tag.X_BM.has_value())
      reasons.push_back(fmt::format("tag {} has {} placement, in the run it has {}", tag.id,
                                    other->X_BM ? "a" : "no", tag.X_BM ? "one" : "none"));
  }
  for (const TagPlacement& tag : proposed.tags)
    if (!recorded.find(tag.id)) reasons.push_back(fmt::format("the run had no tag {}", tag.id));
  return fmt::format("{}", fmt::join(reasons, "; "));
}

std::string other_camera_text(const CameraCalibration& recorded,
                              const CameraCalibration& proposed) {
  if (proposed.width != recorded.width || proposed.height != recorded.height)
    return fmt::format("holds for images of {}, the run's have {}", size_text(proposed),
                       size_text(recorded));
  if (proposed.model != recorded.model)
    return fmt::format("its distortion_model is {}, the run's is {}",
                       distortion_model_name(proposed.model),
                       distortion_model_name(recorded.model));
  return "";
}

}  // namespace bodyschema
