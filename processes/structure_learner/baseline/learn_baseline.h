#pragma once

#include <optional>
#include <vector>

#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// The chapter's own way from samples to a body schema (Section 3), for comparison: what learn() is
/// measured against.
struct BaselineOptions {
  /// The root part; else the lowest part id seen.
  std::optional<int> root;
  /// Parts that should be there: reported where they were never seen.
  std::vector<int> expected_parts;
  /// Standard deviation σ_z of a relative pose: length of the position's error and angle of the
  /// rotation's. These are the chapter's, for its cameras.
  double sigma_position_m = 0.050;
  double sigma_rotation_rad = 0.26179938779914943654;  // 15°
  /// Largest number of signals in one local model.
  int max_signals = 2;
  /// A pair's instants beyond these are thinned evenly: the time of a fit grows with their cube.
  int max_samples = 100;
  /// As Algorithm 1 does. If not, every layer is evaluated; the structure is the same.
  bool stop_at_first_tree = true;

  /// σ_z of two markers with this noise per axis, the lever arm ignored as the chapter does:
  /// √2·√3 times that of an axis.
  void set_noise(const Noise& marker_noise);
};

struct BaselineResult {
  /// Its edges are matrix GPs. X_CR is the mean of the root's poses.
  BodySchema schema;
  int num_fits = 0;    ///< local models learned
  int num_valid = 0;   ///< of these
  double seconds = 0;  ///< of processor time
};

/// What the quality of a valid local model depends on.
struct ModelScore {
  int num_signals = 0;        ///< k
  double log_likelihood = 0;  ///< s(M): mean of (10) per sample [nats]
};

/// The quality (11) of each of the valid models, made well-defined so that its two properties hold:
/// q(M) = s(M) − kΛ. s is a mean per sample, since sums over different numbers of samples do not
/// compare; Λ = 1 + max s − min s over the models. (With k log(η|D|) of (11) the second property
/// needs likelihoods below 1, and the logarithm of an η that may be negative.)
///   Property 1, k₁ = k₂: the better fit has the higher quality, since q₁ − q₂ = s₁ − s₂.
///   Property 2, k₁ < k₂: the simpler model has the higher quality, since
///     q₁ − q₂ = s₁ − s₂ + (k₂ − k₁)Λ ≥ Λ − (max s − min s) = 1.
/// So quality orders by k first and s second, and a spanning tree of the first layers is never
/// beaten by a model of a later one.
std::vector<double> model_qualities(const std::vector<ModelScore>& valid);

/// Learns the body schema as Section 3.2 does:
///
/// All local models with k signals, k = 0, 1, 2, …, between all pairs of parts are learned (matrix
/// GPs). A model is valid if the mean position error is below 3 σ_z,pos and the mean rotation error
/// below 3 σ_z,rot: "the 3σ confidence interval based on the sensor noise" in the form that Section
/// 5 uses. Errors are leave-one-out: training errors of an interpolating process are zero for every
/// signal set. After each layer, if the valid models span the observed parts, the spanning tree of
/// the highest sum of qualities, (12), is the structure (Algorithm 1).
///
/// Kept as the chapter has it, with what is wrong about it (thresholds on a mean pass every joint
/// of ±90° as rigid at σ_z,rot = 15°; no treatment of outliers).
/// @throws std::invalid_argument if an action does not have one value per signal, or an option is
/// out of range.
BaselineResult learn_baseline(const std::vector<Signal>& signals,
                              const std::vector<ActionPoseSample>& samples,
                              const BaselineOptions& options = {});

}  // namespace bodyschema
