#pragma once

#include <array>
#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <vector>

#include "processes/model_monitor/changes/body_change.h"
#include "processes/model_monitor/hypotheses/action_discrepancy.h"
#include "processes/model_monitor/likelihood/tree_filter.h"

namespace bodyschema {

/// An edge that changes all the time: T(t) in one of its links, linear in the number of samples.
struct Drift {
  int part = 0;
  int link = 0;                            ///< as BodyChange::at
  Pose T = Pose::Identity();               ///< now
  Matrix6d covariance = Matrix6d::Zero();  ///< of T, right perturbation
  Vector6d rate = Vector6d::Zero();        ///< of log T a sample
  Matrix6d rate_covariance = Matrix6d::Zero();
  double significance = 0;  ///< squared Mahalanobis distance of the rate from standing still
  /// Probability that it has ended, and the last sample in which it moved if it has.
  double has_ended = 0;
  std::int64_t last_moved = -1;

  /// The edge with the drift as of now. Until the next sample it goes on: that is in the
  /// covariance.
  BodySchema applied_to(const BodySchema& before) const;
};

/// A drift from standing still: T(t) = Exp(rate · (t − begin)), 1 before.
struct BegunDrift {
  Drift drift;
  std::int64_t begin = 0;
  /// log of the prior of what was fitted, its odds, and the width of the likelihood's peak
  /// (Laplace) [nats].
  double log_prior = 0;
  /// Of the place's measurements over no change at all, log_prior included [nats].
  double gain = 0;
  /// Of the measurements that were found wrong most, and the newest, are as it says.
  bool is_good = false;

  /// Σ log p(observations) over the samples under `before` with the drift.
  double log_likelihood(const BodySchema& before, const MeasurementModel& measurement,
                        const std::vector<const ActionPoseSample*>& samples) const;
};

/// The drifts that began about sample `since` of the edges to `parts`, one each where there are
/// enough measurements, that with the most gain first. `before` is the body as it was until then;
/// samples from before bound the begin.
std::vector<BegunDrift> begun_drifts(const BodySchema& before, const MeasurementModel& measurement,
                                     const std::vector<int>& parts,
                                     const std::vector<const ActionPoseSample*>& samples,
                                     std::int64_t since);

/// Finds what is too small, or changes too slowly, for a CUSUM, by means of the virtual
/// measurements of every edge, and of every marker in its part, over the newest samples.
///
/// Follows what drifts: the mean, by their probabilities, of a straight line through the newest
/// measurements and of lines that ended some samples ago.
class DriftWatch {
 public:
  explicit DriftWatch(double false_alarm_rate);

  /// The sample as `filter` sees it, of the schema as it stands. Along a path errors of the model
  /// repeat: unless `counts_near`, of what is nearly one place the first sample counts.
  void add(const TreeFilter& filter, const TreeFilter::Instant& instant, const BodySchema& schema,
           const Eigen::VectorXd& displacements, std::int64_t sample_index,
           bool counts_near = true);
  /// Measurements of the edge to a part that are older than this say nothing of the present one.
  void forget(int part, std::int64_t before);
  void forget_all();
  /// Measures the edge to a part anew in these samples, and forgets all else. `schema` is right for
  /// the other edges.
  void look_again(const BodySchema& schema, const MeasurementModel& measurement, int part,
                  const std::vector<const ActionPoseSample*>& samples);

  /// An edge, or marker, that is not where the schema has it.
  struct Moved {
    ElementId element;
    std::int64_t since = 0;  ///< first sample of the newest ones whose mean shows it most
    bool is_sure = false;    ///< by the rate of false alarms; else it is worth an explanation
  };
  /// The element that has moved most, if any has, once worth() is known. `schema` is the one that
  /// stands.
  std::optional<Moved> moved(const BodySchema& schema) const;
  /// Independent samples that one is worth: MeasurementModel::worth, of the markers' noise; unknown
  /// as long as few were added. The correlations of residuals some samples apart, ρ_k = ρ₁ φ^(k −
  /// 1), add up to 1 + 2 ρ₁ / (1 − φ) samples for one; and more where the variance of all markers
  /// is below what is assumed, since it is the variance of the mean that counts.
  std::optional<double> worth() const;
  /// The standard deviations that are assumed of the markers are so many times what they were.
  void rescale_noise(double factor);
  /// How far the pose of an edge's part is from where `schema` has it, in the newest measurements.
  struct Spread {
    Matrix6d second_moment = Matrix6d::Zero();  ///< of ξ, right perturbation, without the farthest
    std::size_t size = 0, num_off = 0;          ///< measurements; those that noise does not explain
  };
  Spread spread(const BodySchema& schema, int part) const;
  /// T(t) of an edge from its newest measurements: the better of the two sides. std::nullopt if
  /// there are fewer than four.
  std::optional<Drift> follow(const BodySchema& schema, int part) const;

 private:
  struct Measured {
    std::int64_t sample_index = 0;
    Eigen::VectorXd displacements;
    VirtualMeasurement of;
    Matrix6d systematic;  ///< what the other edges' models contribute to its covariance
  };
  using Measure = std::optional<VirtualMeasurement> (TreeFilter::*)(const TreeFilter::Instant&,
                                                                    int node) const;
  static std::optional<Measured> measure(const TreeFilter& filter,
                                         const TreeFilter::Instant& instant,
                                         const TreeFilter::Instant& exact, int node, Measure how);
  /// Offset ξ that a link shows, log of T in it; what of its covariance is the model's is apart.
  struct Reading {
    Vector6d xi;
    Matrix6d information;
    Matrix6d model;
  };
  /// Sums of readings of a link.
  struct Mean {
    Matrix6d information = Matrix6d::Zero(), model = Matrix6d::Zero();
    Vector6d sum = Vector6d::Zero();
    std::size_t size = 0;
    void add(const Reading& reading);
  };
  /// By link of the edge; of a marker, or the camera's pose, one.
  static std::vector<Reading> readings(const BodySchema& schema, const ElementId& element,
                                       const Measured& measured);
  /// log of the chance of a mean so far from what the model says, or from that of the readings
  /// before: in all directions, or along `twist`. `discrepancy`: of their actions.
  static double log_chance(const Mean& newest, const Mean* before, double worth, double discrepancy,
                           const std::optional<Vector6d>& twist);
  void correlate(const ElementId& tag);
  const std::deque<Measured>* find(const ElementId& element, std::size_t fewest) const;

  const double log_sure_;
  std::map<ElementId, std::deque<Measured>> measured_;
  ActionDiscrepancy actions_;
  Eigen::VectorXd last_;  ///< displacements of the sample that was added last
  std::map<ElementId, std::vector<Mean>> before_;  ///< of what is older, by link, under schema_
  BodySchema schema_;
  /// Sums of products of a marker's whitened residuals, some samples apart; they fade.
  struct Products {
    Vector6d sum = Vector6d::Zero();
    double products = 0, squares = 0, size = 0;
    void add(const Vector6d& residual, const Vector6d& earlier);
  };
  std::map<ElementId, std::array<Products, 2>> products_;  ///< at kLags
};

}  // namespace bodyschema
