#pragma once

#include <optional>

#include "common/estimation/student_t.h"
#include "processes/model_monitor/changes/learned.h"

namespace bodyschema {

/// Heavy-tailed: of a squared distance, above that of a typical right prediction [nats].
inline double student_cost(double squared_distance) {
  return robust_cost(squared_distance) - robust_cost(6);
}

/// The measurements as one form of a learned edge takes them: k functions of the signals, seen n
/// times.
struct ProcessTargets {
  BodyChange change;
  Edge edge;                                      ///< without the functions
  Eigen::Matrix<double, 6, Eigen::Dynamic> into;  ///< 6×k: ρ of the functions' values
  Eigen::MatrixXd y;                              ///< k×n
  Eigen::VectorXd noise = {};                     ///< k, variances
  Eigen::VectorXd scales = {};                    ///< n: of the noise of each measurement
  /// n: log density of what the functions say nothing of, and its squared distance.
  Eigen::VectorXd log_rest = {}, distance_rest = {};
  /// n: student_cost() of what stood.
  Eigen::VectorXd old_cost = {};

  Eigen::Index num_functions() const { return y.rows(); }
  Eigen::Index num_samples() const { return y.cols(); }
};

/// The signals of a learned change: one or two.
std::vector<int> signals_of(const BodyChange& change);

/// The targets' functions as Gaussian processes: length scales and variances by marginal likelihood
/// on a grid, without the measurements that the others make less likely than an outlier. `typical`:
/// k, the functions' typical variances; `x`: D×n, displacements of the signals; `half_ranges`: D.
/// std::nullopt if the processes say nothing of the measurements that they were not told.
std::optional<LearnedEdge> fit_process(const ProcessTargets& targets,
                                       const Eigen::VectorXd& typical, const Eigen::MatrixXd& x,
                                       const Eigen::VectorXd& half_ranges, double outlier_rate);

}  // namespace bodyschema
