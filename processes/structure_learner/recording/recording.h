#pragma once

#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/camera/tag_sight.h"
#include "common/estimation/measurement_model.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// A fault of a recording: "FILE:LINE:COLUMN: what was expected".
class RecordingError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Action–pose samples from a file, anyone's.
struct Recording {
  /// Names from the header, limits from the data (CSV) or the recorded schema (log).
  std::vector<Signal> signals;
  /// sample_index counts the instants of the file from 0.
  std::vector<ActionPoseSample> samples;
  /// Of a log: what each instant shows of single tags, by sample_index; of a CSV empty.
  std::vector<std::vector<TagSight>> sights;
  /// Whether the file says how noisy each observation is.
  bool has_noise = false;
  /// Whether the poses are those of camera markers, recorded by our observer.
  bool is_log = false;
  /// measurement_of() a log; of a CSV with fixed_parts() and without a systematic error.
  MeasurementModel measurement;
  /// Damage of a log, for people: "" if it is whole. Samples before the damage were read.
  std::string damage;
  /// Oddities of a CSV, for people: read as they stand, but like another unit or order.
  std::vector<std::string> hints;

  /// Samples that are learned from, as the structure learner does: TRAIN and PROBE of the retained
  /// set (retained_samples.h). A CSV has TRAIN only.
  std::vector<ActionPoseSample> training() const;
};

/// Reads SAMPLE from an LCM log, or a CSV with the header
///
///   t,q1,…,qm,part,x,y,z,qw,qx,qy,qz[,sp_m,sr_deg]
///
/// one row per instant and seen part: t [s], action signals, part id, position [m], unit quaternion
/// of the part in the reference frame, its four cells empty where only the position is known (then
/// sr_deg may be empty as well); optionally the standard deviations per axis of position [m]
/// and rotation [deg]. Rows with equal t are one instant, wherever they stand, and have one action.
/// Either may be packed by gzip; "-" is stdin.
/// @throws RecordingError.
Recording load_recording(const std::filesystem::path& file);

/// The measurement model of the noise.yaml in `config/` beside a log, as a run's folder has it;
/// else with kTagSystematic. @throws ConfigError.
MeasurementModel measurement_of(const std::filesystem::path& log);

/// The signals of samples of which nothing is known but their numbers: called q1, q2, …, with the
/// range that they were seen in as limits. All samples have as many signals as the first.
std::vector<Signal> observed_signals(const std::vector<ActionPoseSample>& samples);

/// The samples with their actions in the order of a schema's `signals`: of a CSV by the columns'
/// names, which must be the same; a log has values alone, of which there must be as many.
/// @throws std::invalid_argument.
std::vector<ActionPoseSample> samples_by_signals(const Recording& recording,
                                                 const std::vector<Signal>& signals);

/// The CSV reader alone; `name` stands in errors.
Recording parse_csv(const std::string& text, const std::string& name);

/// A rotation's standard deviation so small beside the position's that radians seem to be meant:
/// the marker would be 4 m wide.
bool looks_like_radians(const Noise& noise);

/// Signs of other units or another order than a CSV's: positions that spread over more than
/// 10 m, standard deviations above 0.1 m or in radians, rotations that make a body of the parts
/// only when read as x y z w. No evidence, no hint; none changes what is read.
std::vector<std::string> hints_of(const Recording& recording);

/// Adds a hint for each part seen with and without orientation: the rarer kind is left out.
void add_mixture_hint(Recording& recording);

}  // namespace bodyschema
