#pragma once

#include <Eigen/Geometry>
#include <filesystem>
#include <string>
#include <vector>

#include "common/bus/arguments.h"
#include "common/schema/body_schema.h"
#include "processes/console/views/json.h"
#include "processes/structure_learner/command_lag.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {

/// Reads a schema file: a log with one BODY_SCHEMA; of several the last counts.
/// @throws std::runtime_error.
BodySchema load_schema(const std::filesystem::path& file);

/// Reads a recording; what keeps it from being whole, and hints, are said on stderr.
/// @throws RecordingError.
Recording load_and_warn(const std::string& file);

std::string delay_text(const CommandDelay& delay);

/// Reads a recording whose actions are those of the schema, in its order, as load_and_warn(). Where
/// its poses come after their commands each gets the command that brought it there, and that is
/// said on stderr. @throws std::runtime_error.
Recording load_for(const std::string& file, const BodySchema& schema);

/// Of a schema whose last sample is not in the recording: forget_when_it_changed().
void forget_changes_of_another(const Recording& recording, BodySchema* schema);

/// Adds `--noise POS_M ROT_DEG`.
void add_noise(Arguments& command, std::vector<double>& numbers, const std::string& more = "");
/// Its two numbers. @throws as refuse_argument() where they are not above 0 or no noise of a
/// marker, and may be in another unit.
Noise noise_given(const std::vector<double>& numbers);

/// W X Y Z of an option, of a norm within 1 % of 1, normalized. @throws as refuse_argument().
Eigen::Quaterniond unit_quaternion(const std::string& option, const std::vector<double>& wxyz);

/// @throws std::invalid_argument if `out` would be written over one of `inputs`, or cannot be
/// written; `option` stands in the error.
void check_out(const std::string& out, const std::vector<std::string>& inputs,
               const std::string& option = "--out");

/// A file that a command writes: its option and what was given, "" where nothing was.
struct OutFile {
  std::string option, file;
};
/// check_out() of each. @throws std::invalid_argument also if two of them are one file.
void check_outs(const std::vector<OutFile>& outs, const std::vector<std::string>& inputs);

/// Prints the result of a command.
void print(bool as_json, const Json& json, const std::string& text);

}  // namespace bodyschema
