#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <vector>

#include "processes/model_monitor/tree_filter.h"

namespace bodyschema {

/// An edge that changes slowly: T(t) on one side of its model, linear in the number of samples.
struct Drift {
  int part = 0;
  bool left = false;                       ///< T · Δ; else Δ · T
  Pose T = Pose::Identity();               ///< now
  Matrix6d covariance = Matrix6d::Zero();  ///< of T, right perturbation
  Vector6d rate = Vector6d::Zero();        ///< of log T a sample
  Matrix6d rate_covariance = Matrix6d::Zero();
  double significance = 0;  ///< squared Mahalanobis distance of the rate from standing still
};

/// Finds what changes too slowly for a CUSUM: means of the virtual measurements of every edge over
/// the newest samples. The bend of a link by 0.05° a sample is below the noise of each of them, and
/// ten standard deviations of their mean.
class DriftWatch {
 public:
  explicit DriftWatch(double false_alarm_rate);

  /// The sample as `filter` sees it; `filter` has the schema as it stands.
  void add(const TreeFilter& filter, const TreeFilter::Instant& instant,
           const Eigen::VectorXd& displacements, std::int64_t sample_index);
  /// Measurements of the edge to a part that are older than this say nothing of the present one.
  void forget(int part, std::int64_t before);
  void forget_all();

  /// The edge that has moved most, if any has. `schema` is the one that stands.
  std::optional<int> moved_part(const BodySchema& schema) const;
  /// T(t) of an edge from its newest measurements: the better of the two sides.
  std::optional<Drift> follow(const BodySchema& schema, int part) const;

 private:
  struct Measured {
    std::int64_t sample_index = 0;
    Eigen::VectorXd displacements;
    VirtualMeasurement of;
    Matrix6d systematic;  ///< what the other edges' models contribute to its covariance
  };
  const std::deque<Measured>* find(int part) const;

  const double threshold_;
  std::map<int, std::deque<Measured>> measured_;
};

}  // namespace bodyschema
