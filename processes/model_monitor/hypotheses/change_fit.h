#pragma once

#include <optional>
#include <vector>

#include "common/schema/sample.h"
#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/likelihood/tree_filter.h"

namespace bodyschema {

/// A change with the parameters that the samples since speak for.
struct FittedChange {
  BodyChange change;
  /// A schema of the history that the change starts from, in its place (or, `everywhere`, whole);
  /// of what is learned, one with the learned edge.
  std::optional<BodySchema> origin;
  bool everywhere = false;
  Eigen::VectorXd theta;
  Eigen::MatrixXd covariance;  ///< of θ, Laplace
  /// Of what is learned: the edge at the peak of its posterior, without its uncertainty.
  std::optional<Edge> certain = std::nullopt;
  BodySchema schema;  ///< with the change, and its uncertainty, in it
  /// log ∫ p(observations | θ) p(θ) dθ by Laplace, plus the log prior odds [nats].
  double log_evidence = 0;
  double log_prior = 0;  ///< its share that is not the likelihood at θ
};

/// Whether the schema, or what the change starts from, has the joint that changed.
bool is_possible(const FittedChange& fitted, const BodySchema& schema);
/// `schema` with the fitted change, and its uncertainty, in it.
/// @throws std::invalid_argument, std::out_of_range if it is not possible.
BodySchema with_change(const BodySchema& schema, const FittedChange& fitted);
/// The same without its uncertainty: its width is in log_prior (Laplace).
BodySchema with_certain_change(const BodySchema& schema, const FittedChange& fitted);
/// `schema` with the edge to `part` (root: the camera's pose) of another.
BodySchema with_edge_of(const BodySchema& schema, const BodySchema& other, int part);

/// Σ log p(observations) over the samples under a schema.
double log_likelihood(const BodySchema& schema, const MeasurementModel& measurement,
                      const std::vector<const ActionPoseSample*>& samples);

/// What every sample says of one place, whatever the change there: made once for all its forms.
class PlaceEvidence {
 public:
  PlaceEvidence(const BodySchema& base, const MeasurementModel& measurement,
                const ElementId& element, std::vector<const ActionPoseSample*> samples);

  /// Samples that say something of the place.
  int num_usable() const { return static_cast<int>(measurements_.size()); }
  /// Whitened residuals of the measurements, one after the other: 6N; and ∂/∂θ: 6N×d.
  Eigen::VectorXd residuals(const BodyChange& change, const Eigen::VectorXd& theta,
                            Eigen::MatrixXd* jacobian = nullptr) const;

  /// The most probable θ: Gauss-Newton on the virtual measurements from several starts, with
  /// Student-t weights first and the outlier mixture's then; the evidence is that of all
  /// observations. std::nullopt if there are fewer usable samples than the form needs.
  std::optional<FittedChange> fit(const BodyChange& change) const;
  /// Those of the changes that may be the best one: what the place's own measurements speak clearly
  /// against is not held against all the observations.
  std::vector<FittedChange> fit_likely(const std::vector<BodyChange>& changes) const;
  /// What learn_edge() makes of an edge's place, those of it that may be the best one; of a
  /// marker's nothing.
  std::vector<FittedChange> learn() const;
  /// A schema of the history in this place.
  FittedChange judge_stored(const BodySchema& schema) const;

 private:
  struct State {
    Eigen::VectorXd theta;
    double cost = 0;
    Eigen::MatrixXd H;
  };
  double log_flat_outlier() const;
  double log_inlier(std::size_t n, double squared_distance) const;
  /// −log of prior times likelihood of the place's measurements; `robust`: Student-t.
  double cost(const BodyChange& change, const Eigen::VectorXd& theta, bool robust) const;
  /// θ and the evidence of the place's measurements alone.
  std::optional<FittedChange> fit_place(const BodyChange& change) const;
  /// The evidence of all observations in its stead.
  void judge(FittedChange* fitted) const;
  State climb(const BodyChange& change, Eigen::VectorXd theta) const;

  const BodySchema base_;
  const MeasurementModel measurement_;
  const ElementId element_;
  const std::vector<const ActionPoseSample*> samples_;
  std::vector<PlaceMeasurement> measurements_;
  std::vector<Matrix6d> whitenings_;
  std::vector<double> log_norms_;  ///< log |2πS|^(−½)
};

}  // namespace bodyschema
