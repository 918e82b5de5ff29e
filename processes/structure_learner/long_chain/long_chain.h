#pragma once

#include <optional>
#include <vector>

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// Largest number of joints of a chain that is searched for.
inline constexpr int kMaxChainJoints = 12;

/// Independent poses a joint below which no chain of three or more is looked for.
inline constexpr int kPosesPerJoint = 3;

/// A right model costs 4 to 7 nats a frame.
inline constexpr double kRightCost = 8;

/// Signals in the order of the joints, or not.
enum class JointOrder { kListed, kUnknown };

/// A chain through all of `signals`, fitted to a pair's poses: rotations first, then the positions,
/// which are linear given the rotations, then all together; of positions alone what turns is found
/// from these. In the listed order, with one angle per
/// command unit for all joints or with angles of their own, and reversed; where it is unknown, in
/// an order that is searched for. `noise`: of one rotation of the pair, or position where it has
/// positions alone, per axis [rad, m]; a chain that leaves no more ends the search. Signals that
/// move nothing get joints that move next to nothing. std::nullopt: too few frames, no signal or
/// too many.
std::optional<Fit> fit_long_chain(const PairData& pair, const NormalizedActions& actions,
                                  const std::vector<int>& signals, JointOrder order, double noise);

/// What a joint more must explain [nats]: more than chance (Schwarz 1978), and more than what is
/// below the noise of every single sight.
double price_of_joint(const PairData& pair);

/// Without the joints that do not pay, one by one, the least first: what a joint explains must be
/// more than its parameters are worth by chance (Schwarz 1978) and, for a sight, more than
/// `kLeastPay`.
Fit without_idle_joints(Fit fit, const PairData& pair, const NormalizedActions& actions);

/// Joints that hardly turn slide where the poses do not say otherwise: a small turn about an axis
/// far away moves alike.
Fit with_pure_slides(Fit fit, const PairData& pair, const NormalizedActions& actions);

/// Exchanges neighbouring joints of two signals while that lowers the cost, and numbers those whose
/// order the poses leave open, as where one signal rests while the other moves:
/// LocalModel::Joint::order_group. Joints that commute have no order.
Fit with_settled_order(Fit fit, const PairData& pair, const NormalizedActions& actions);

}  // namespace bodyschema
