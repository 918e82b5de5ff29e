#include "processes/controller/reachable_box.h"

#include <algorithm>
#include <functional>
#include <random>
#include <vector>

#include "common/kinematics/kinematic_path.h"

namespace bodyschema {
namespace {

constexpr int kNumActions = 1000, kNumClimbs = 10;
constexpr double kFirstStep = 0.1, kLastStep = 1e-6;  // of a signal's range

using Height = std::function<double(const Eigen::VectorXd& shares)>;

// Where `height` is greatest near `shares` of the ranges.
Eigen::VectorXd top_near(Eigen::VectorXd shares, const Height& height) {
  double top = height(shares);
  for (double step = kFirstStep; step > kLastStep;) {
    bool is_higher = false;
    for (Eigen::Index s = 0; s < shares.size(); ++s) {
      for (const double direction : {-1.0, 1.0}) {
        Eigen::VectorXd tried = shares;
        tried(s) = std::clamp(shares(s) + direction * step, 0.0, 1.0);
        const double reached = height(tried);
        if (reached <= top) continue;
        top = reached;
        shares = tried;
        is_higher = true;
      }
    }
    if (!is_higher) step /= 2;
  }
  return shares;
}

}  // namespace

Eigen::AlignedBox3d reachable_box(const BodySchema& schema, int part) {
  Eigen::AlignedBox3d box;
  const auto path = KinematicPath::between(schema, schema.root, part);
  if (!path) return box;
  const auto num_signals = static_cast<Eigen::Index>(schema.signals.size());
  Eigen::VectorXd lower(num_signals), range(num_signals);
  for (Eigen::Index s = 0; s < num_signals; ++s) {
    const Signal& signal = schema.signals[static_cast<std::size_t>(s)];
    lower(s) = signal.lower;
    range(s) = signal.upper - signal.lower;
  }
  const auto position = [&](const Eigen::VectorXd& shares) -> Eigen::Vector3d {
    return path->predict(lower + range.cwiseProduct(shares)).translation();
  };

  std::vector<Eigen::VectorXd> starts;
  std::mt19937_64 rng(1);
  for (int n = 0; n < kNumActions; ++n) {
    starts.push_back(Eigen::VectorXd::NullaryExpr(
        num_signals, [&] { return 0x1p-53 * static_cast<double>(rng() >> 11); }));
    box.extend(position(starts.back()));
  }
  for (int axis = 0; axis < 3; ++axis) {
    for (const double side : {-1.0, 1.0}) {
      const Height height = [&](const Eigen::VectorXd& shares) {
        return side * position(shares)(axis);
      };
      std::partial_sort(starts.begin(), starts.begin() + kNumClimbs, starts.end(),
                        [&](const auto& a, const auto& b) { return height(a) > height(b); });
      for (int n = 0; n < kNumClimbs; ++n) box.extend(position(top_near(starts[n], height)));
    }
  }
  return box;
}

}  // namespace bodyschema
