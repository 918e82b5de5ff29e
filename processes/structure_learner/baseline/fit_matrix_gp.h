#pragma once

#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/matrix_gp.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Learns the chapter's local model (Section 3.1): the hyper-parameters of each of the 12 entries
/// by its own marginal likelihood, about an unknown mean. `inputs` is D×N, the values of `signals`
/// in command units; `poses` the N observed z_ij. Without signals there are the mean and the noise,
/// which is the sample variance.
///
/// The chapter knows no outliers: every sample counts alike.
/// @throws std::invalid_argument on shapes that do not go together, fewer than two samples, values
/// that are not finite.
MatrixGp fit_matrix_gp(const std::vector<int>& signals, const Eigen::MatrixXd& inputs,
                       const std::vector<Pose>& poses);

/// The same of Δ_from,to from samples in which both parts were seen, as an edge.
Edge fit_matrix_gp_edge(int from, int to, const std::vector<int>& signals,
                        const std::vector<const ActionPoseSample*>& samples);

}  // namespace bodyschema
