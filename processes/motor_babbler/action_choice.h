#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <map>
#include <set>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// An action that was taken, and which parts were seen at it.
struct SeenAction {
  std::int64_t sample_index = 0;
  bool is_learned_from = true;  ///< false of TEST and CONTROL samples
  Eigen::VectorXd action;       ///< one value per signal, command units
  std::set<int> parts;
};

/// Probability that the camera sees a part at an action: the mean of a Beta distribution whose
/// counts are the past actions, each weighted by its similarity to this one for that part.
///
/// For a part that is connected to the root, actions are similar that show the camera the part from
/// similar directions (Gaussian weight, 15°). The side that a marker shows decides whether it is
/// seen; that is two numbers, however many signals move the part, and the schema predicts them also
/// for actions at which the part was not seen. For other parts, actions are similar with similar
/// signals, all of them, since it is unknown which move the part. Occlusion by other parts is
/// covered as far as it depends on these.
class VisibilityModel {
 public:
  /// Every past action has one value per signal of the schema.
  VisibilityModel(const BodySchema& schema, const std::vector<SeenAction>& past);

  /// 0..1 for every part of the schema, unconnected ones included.
  std::map<int, double> probabilities(const Eigen::VectorXd& action) const;

 private:
  struct View {
    std::map<int, Eigen::Vector3d> directions;  ///< from the part to the camera, in its frame, unit
    Eigen::VectorXd x;                          ///< signals, −1..1 over their ranges
    std::set<int> parts;                        ///< seen at it
  };
  View view_at(const Eigen::VectorXd& action) const;

  const BodySchema schema_;
  std::vector<View> past_;
};

/// Index of the candidate with the largest expected information; the first of equals.
///
/// The expected information of an action is a sum over the edges, each times the probability that
/// both of its parts are seen, of the growth of log det of the information [nats ×2] (D-optimality,
/// first order) on
///   - the parameters of the edge: log det(I + Σ⁻¹ J C Jᵀ), with C their covariance after the past
///     actions, those after the schema's last sample included, and Σ the noise of a relative pose;
///   - the residual of the edge: six coefficients of each of (1, x_s, x_s²) of every signal s, that
///     is 6 log(1 + φᵀ(Λ + Σ_past φφᵀ)⁻¹φ). These reveal a false model, so a design that is best
///     for the edges as they are must not leave them unobserved (potential
///     terms: DuMouchel and Jones, A simple Bayesian modification of D-optimal designs, 1994).
/// A part without an edge counts with the second alone: actions explore where it may be seen and
/// was not tried yet.
///
/// A pure function. `past` in order of sample_index; there must be a candidate, and actions have
/// one value per signal of the schema.
/// @throws std::invalid_argument otherwise.
std::size_t choose_action(const BodySchema& schema, const std::vector<SeenAction>& past,
                          const std::vector<Eigen::VectorXd>& candidates);

}  // namespace bodyschema
