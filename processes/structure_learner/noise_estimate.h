#pragma once

#include <optional>
#include <vector>

#include "processes/structure_learner/long_chain/long_chain.h"

namespace bodyschema {

/// A richer model must leave this share of the product of position and rotation deviations. Of the
/// soft trunk's parts models leave 0.01 to 0.3 of what rigid pairs leave, of a recording without a
/// valid model 0.99 and more (trunk_c11, trunk_adiabatic4).
inline constexpr double kExplained = 0.5;

/// Below this no measurement is believed: 0.1 mm and 0.02° per axis.
inline constexpr Noise kNoiseFloor{1e-4, 3.4906585e-4};

/// Above this it is no measurement but motion that no model explains: four times the noise of the
/// chapter's markers. Without a ceiling, poses at random would pass for a rigid body badly seen.
inline constexpr Noise kNoiseCeiling{0.1, 0.41887902};

/// As noisy as any tag or tracker: what models leave above it is motion, too. Chosen, above the 3
/// mm and 1° of tags, below the 30 to 46 mm and 9 to 15° of two joints fitted to a real arm of
/// seven (16 subsets of arm7_ends.csv), which a Gaussian process would then explain well.
inline constexpr Noise kLoudestMarker{0.01, 0.05235988};
bool is_above_any_marker(const Noise& noise);

/// Where the noise of a marker is known from.
enum class NoiseSource {
  kGiven,        ///< told by the user
  kCovariances,  ///< of the observations, their mean
  kRepeats,      ///< estimated from poses seen again under the same action
  kFrames,       ///< of a stream that no model explains: a few times what jumps between frames
  kResiduals,    ///< estimated from what the best models leave
  kAssumed,      ///< the data do not tell it
};

struct SourcedNoise : Noise {
  NoiseSource source = NoiseSource::kAssumed;
};

/// Noise per axis of one marker, for data that bring neither noise nor covariances.
///
/// From repeats where an action recurs at least five times, unless it is a stream that rests:
/// residuals of each part's pose to its robust mean over the repeats. Else from the best models of
/// a minimum spanning tree over the parts: their pooled residuals, each without the frame (a
/// Gaussian process: the block) that it judges. Models of one joint, two and many compete, and a
/// Gaussian process on the signals that it needs: the residual of a model is noise only where no
/// richer one leaves far less. Through medians, so that outliers do not count (of a stream, which
/// rests for much of its time, the upper quartile); position and rotation apart (the rotation noise
/// of part i reaches the position of z_ij through the lever arm). The estimate is returned 1.2 ×
/// too large: too small a noise rejects true models, too large a noise by that factor costs nearly
/// nothing. Never below kNoiseFloor or above kNoiseCeiling. What no model explains is motion, not
/// noise, where it is above kLoudestMarker: then that is assumed. Of a stream, the jitter from
/// frame to frame is a lower bound and no more, unless no model explains its motion, or what the
/// best one leaves is above kLoudestMarker: then that is not taken for noise. Parts whose pose
/// never changes a bit define the frame of the others and say nothing. std::nullopt: too few data.
std::optional<SourcedNoise> estimate_noise(const std::vector<ActionPoseSample>& samples,
                                           int num_signals, int max_signals = kMaxChainJoints);

}  // namespace bodyschema
