#pragma once

#include <complex>
#include <vector>

#include "processes/structure_learner/screen.h"

namespace bodyschema {

/// The largest joint that is looked for [rad per half range]: 4.5 turns over the range; of one
/// signal alone 25, where so many frames tell one turn from another: that some turn explains 40
/// angles at random to kLeastScanPower has the chance 320 exp(−40 · 0.6²), 2 in 10 000.
inline constexpr double kMostTurn = 14, kMostTurnOfOne = 80;
inline constexpr std::size_t kFewestWideScanFrames = 40;
/// Between two turns of a scan: 14° at the ends of the range when the truth is midway.
inline constexpr double kTurnStep = 0.5;
/// With fewer frames than this some turn of so many explains any angles.
inline constexpr int kFewestScanFrames = 12;

/// AnglesAboutAxis::Turns::power below which a scan has found nothing: with 30 % of wild readings
/// the true turn has 0.7 and what these add or take.
inline constexpr double kLeastScanPower = 0.6;

/// Frames prepared for the closed-form starts.
struct StartFrames {
  std::vector<int> sample;
  std::vector<Eigen::Matrix3d> R;
  std::vector<Eigen::Vector3d> p;
};
StartFrames start_frames(const PairData& pair);

/// The rotations of relative motions about their principal axis.
struct PrincipalAxis {
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();  ///< in frame j
  std::vector<double> along;                        ///< [rad]
  std::vector<double> across;                       ///< squared, over the variance
};
/// Motions far off the axis down-weighted.
PrincipalAxis principal_axis(const RelativeMotions& motions, double variance);
/// In units of variance of a relative motion, for the median; that of χ²₂ is 1.4, of χ²₁ 0.45.
inline constexpr double kAxisGate = 8;

/// R_t = R_before R_z(ψ_t) R_after: the angles about one axis, by frame, as e^{iψ}. Nothing is
/// unwrapped, so they may go round any number of times.
class AnglesAboutAxis {
 public:
  /// `axis` in frame j.
  AnglesAboutAxis(const StartFrames& frames, const Eigen::Vector3d& axis);

  struct Turns {
    double a = 0, b = 0;  ///< [rad per half range]
    double phase = 0;     ///< ψ at q = 0
    double power = 0;  ///< |mean of e^{i(ψ − a q_a − b q_b)}|: 1 if these explain all angles
  };
  /// The turns of largest power up to kMostTurn, or kMostTurnOfOne, either way: a periodogram at
  /// arbitrary times (Lomb, Scargle), of the angles on one signal (`b` −1) or on the sum of two.
  /// Power 0 where other turns do as well, as with commands in few equal steps.
  Turns scan(const NormalizedActions& actions, int a, int b) const;

  const Eigen::Matrix3d& before() const { return before_; }
  const Eigen::Matrix3d& after() const { return after_; }

 private:
  std::vector<int> samples_;
  Eigen::Matrix3d before_, after_;
  std::vector<std::complex<double>> phasors_;
};

/// k = 1, for joints that turn more than screen_one_joint() can follow, best first; none where the
/// pair does not turn about one axis.
std::vector<Start> screen_wide_joint(const PairData& pair, const NormalizedActions& actions,
                                     const RelativeMotions& motions);

}  // namespace bodyschema
