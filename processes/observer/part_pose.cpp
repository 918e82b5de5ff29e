#include "processes/observer/part_pose.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace bodyschema {
namespace {

/// Covariance of a tag's corners about their positions by markers.yaml, seen from X_CM: of their
/// measurement, of the tag's place on its part and of its size.
Matrix8d covariance_of(const SeenTag& tag, const TagCalibration& calibration, const Pose& X_CM) {
  const std::vector<Eigen::Vector3d> p_MP = tag_corners(tag.size_m);
  Eigen::Matrix<double, Eigen::Dynamic, 6> J;
  if (!reprojection_residual(X_CM, p_MP, tag.corners, &J)) return tag.corner_covariance_px2;
  Vector6d variances;
  variances << Eigen::Vector3d::Constant(std::pow(calibration.position_m, 2)),
      Eigen::Vector3d::Constant(std::pow(calibration.rotation_rad, 2));
  // A corner of a larger print moves as if the tag were moved by its own vector to the corner.
  Eigen::Matrix<double, 8, 1> of_size;
  for (int c = 0; c < 4; ++c)
    of_size.segment<2>(2 * c) = J.block<2, 3>(2 * c, 0) * p_MP[c] * calibration.size_share;
  const double sigma2 = std::pow(tag.corners[0].sigma_px, 2);
  return tag.corner_covariance_px2 +
         sigma2 * (J * variances.asDiagonal() * J.transpose() + of_size * of_size.transpose());
}

/// The corners of tags with their covariances about the positions by markers.yaml.
struct Points {
  std::vector<Eigen::Vector3d> p_BP;
  std::vector<ImagePoint> measured;
  Eigen::MatrixXd whitener;
};

Points points_of(const std::vector<SeenTag>& tags, const TagCalibration& calibration,
                 const Pose& X_CB) {
  Points points;
  const auto size = static_cast<Eigen::Index>(8 * tags.size());
  points.whitener = Eigen::MatrixXd::Zero(size, size);
  for (const SeenTag& tag : tags) {
    const auto row = static_cast<Eigen::Index>(2 * points.measured.size());
    const Matrix8d covariance = covariance_of(tag, calibration, X_CB * tag.X_BM);
    points.whitener.block<8, 8>(row, row) = whitener_of(covariance);
    for (const Eigen::Vector3d& p_MP : tag_corners(tag.size_m))
      points.p_BP.push_back(tag.X_BM * p_MP);
    for (ImagePoint corner : tag.corners) {
      corner.sigma_px = sigma_px(covariance);
      points.measured.push_back(corner);
    }
  }
  return points;
}

/// All local minima reached from the tags' hypotheses, best first.
std::vector<PoseFit> minima_of(const std::vector<SeenTag>& tags,
                               const TagCalibration& calibration) {
  std::vector<PoseFit> minima;
  for (const SeenTag& tag : tags) {
    for (const Pose& X_CM : tag.X_CM) {
      const Pose start = X_CM * tag.X_BM.inverse();
      const Points points = points_of(tags, calibration, start);
      const auto fit = fit_pose(start, points.p_BP, points.measured, &points.whitener);
      if (!fit) continue;
      const auto same = [&](const PoseFit& m) { return is_same_minimum(m.X_CB, fit->X_CB); };
      if (std::none_of(minima.begin(), minima.end(), same)) minima.push_back(*fit);
    }
  }
  std::stable_sort(minima.begin(), minima.end(),
                   [](const PoseFit& a, const PoseFit& b) { return a.rms_sigma < b.rms_sigma; });
  return minima;
}

/// Largest rms [px] of one tag under the common pose.
double worst_tag_error(const Pose& X_CB, const std::vector<SeenTag>& tags) {
  double worst = 0;
  for (const SeenTag& tag : tags) {
    const auto residual =
        reprojection_residual(X_CB * tag.X_BM, tag_corners(tag.size_m), tag.corners, nullptr);
    if (!residual) return std::numeric_limits<double>::infinity();
    worst = std::max(worst, std::sqrt(residual->squaredNorm() / 8) * tag.corners[0].sigma_px);
  }
  return worst;
}

/// Takes the tags that disagree with the others out of `tags`, and returns them. `minima`: of those
/// that stay, none if not even one fits.
std::vector<SeenTag> take_out_disagreeing(const PartPoseOptions& options,
                                          std::vector<SeenTag>* tags,
                                          std::vector<PoseFit>* minima) {
  std::vector<SeenTag> disagreeing;
  *minima = minima_of(*tags, options.calibration);
  while (!minima->empty() && worst_tag_error((*minima)[0].X_CB, *tags) > options.max_tag_error_px) {
    if (tags->size() == 1) {
      minima->clear();
      break;
    }
    // The tag with the largest residual need not be the wrong one: it may be the only right one far
    // from the others. So each is left out in turn.
    double least_rms = std::numeric_limits<double>::infinity();
    std::size_t culprit = 0;
    std::vector<PoseFit> without_culprit;
    for (std::size_t i = 0; i < tags->size(); ++i) {
      std::vector<SeenTag> others = *tags;
      others.erase(others.begin() + static_cast<std::ptrdiff_t>(i));
      std::vector<PoseFit> without = minima_of(others, options.calibration);
      if (without.empty() || without[0].rms_sigma >= least_rms) continue;
      least_rms = without[0].rms_sigma;
      culprit = i;
      without_culprit = std::move(without);
    }
    disagreeing.push_back(std::move((*tags)[culprit]));
    tags->erase(tags->begin() + static_cast<std::ptrdiff_t>(culprit));
    *minima = std::move(without_culprit);
  }
  return disagreeing;
}

std::optional<PartPose> pose_from(const std::vector<PoseFit>& minima,
                                  const std::vector<SeenTag>& tags,
                                  const PartPoseOptions& options) {
  if (minima.empty()) return std::nullopt;
  const auto covariance = covariance_from(minima[0].information);
  if (!covariance) return std::nullopt;
  PartPose result;
  result.X_CB = minima[0].X_CB;
  result.covariance = *covariance;
  for (const SeenTag& tag : tags) result.tags.push_back(tag.id);
  const auto other = std::find_if(minima.begin() + 1, minima.end(), [&](const PoseFit& m) {
    return rotation_angle(result.X_CB.inverse() * m.X_CB) >= options.min_other_rotation_rad;
  });
  if (other == minima.end()) return result;
  // Errors far below the noise are not informative, and 0 would make any ratio infinite.
  constexpr double kLeast = 1e-2;
  const double ratio = std::max(other->rms_sigma, kLeast) / std::max(minima[0].rms_sigma, kLeast);
  if (ratio <= options.max_error_ratio) {
    result.X_CB_other = other->X_CB;
    result.error_ratio = ratio;
  }
  return result;
}

}  // namespace

PartPoses solve_part_pose(std::vector<SeenTag> tags, const PartPoseOptions& options) {
  PartPoses result;
  std::vector<PoseFit> minima;
  for (const SeenTag& tag : take_out_disagreeing(options, &tags, &minima)) {
    std::vector<SeenTag> alone{tag};
    std::vector<PoseFit> of_it;
    take_out_disagreeing(options, &alone, &of_it);
    if (auto pose = pose_from(of_it, alone, options))
      result.contradictions.push_back(std::move(*pose));
  }
  result.agreed = pose_from(minima, tags, options);
  if (result.agreed && tags.size() == 1 && !result.contradictions.empty()) {
    result.contradictions.push_back(std::move(*result.agreed));
    result.agreed.reset();
  }
  std::sort(result.contradictions.begin(), result.contradictions.end(),
            [](const PartPose& a, const PartPose& b) { return a.tags < b.tags; });
  return result;
}

}  // namespace bodyschema
