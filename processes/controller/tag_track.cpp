#include "processes/controller/tag_track.h"

#include <Eigen/Cholesky>
#include <cmath>

#include "common/estimation/chi_square.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

/// Beyond this squared distance the tag was moved: one frame of 100 000 at rest is taken for it.
const double kMoved = chi_square_quantile(3, 1e-5);

}  // namespace

Eigen::Vector3d TagTrack::p_CM() const { return information_.ldlt().solve(weighted_); }

void TagTrack::see(const std::optional<Sight>& sight) {
  is_seen_ = sight.has_value();
  if (!sight) return;
  if (num_frames_ > 0) {
    const Eigen::Vector3d off = sight->p_CM - p_CM();
    // The frames' errors are mostly the same: their mean is not taken to be better than one.
    const Eigen::Matrix3d covariance = sight->covariance + num_frames_ * information_.inverse();
    if (off.dot(covariance.ldlt().solve(off)) > kMoved) {
      moved_m_ = off.norm();
      ++place_;
      num_frames_ = 0;
      information_.setZero();
      weighted_.setZero();
    }
  }
  if (num_frames_ == kWindow) {
    constexpr double kShare = 1.0 - 1.0 / kWindow;
    information_ *= kShare;
    weighted_ *= kShare;
    --num_frames_;
  }
  const Eigen::Matrix3d information = sight->covariance.inverse();
  information_ += information;
  weighted_ += information * sight->p_CM;
  ++num_frames_;
}

std::string TagTrack::account() const {
  if (!is_seen_) return "is not seen";
  if (place_ > 0) return "moved by " + std::to_string(std::lround(moved_m_ * 1e3)) + " mm";
  return "is seen in " + counted(num_frames_, "frame");
}

}  // namespace bodyschema
