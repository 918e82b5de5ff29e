#pragma once

#include <filesystem>
#include <string>
#include <vector>

namespace bodyschema {

/// A rig as its processes would read it at start.
struct RigCheck {
  int num_parts = 0;
  int num_signals = 0;
  int num_tags = 0;
  /// Faults that keep a process from starting, or the group from working, each "FILE:LINE: key:
  /// what was expected". Empty: the rig is good, and the numbers hold.
  std::vector<std::string> problems;
  /// Oddities that do no harm: files that no process reads.
  std::vector<std::string> remarks;
};

/// Reads every file of a rig by the loader of the process that it is for, the simulated robot
/// included, and judges them against each other.
RigCheck check_rig(const std::filesystem::path& folder);

/// The folder of a rig: `rig` itself where that is a folder, else config/<rig> here or in the
/// checkout that this program was built in.
/// @throws std::runtime_error naming the rigs that there are.
std::filesystem::path find_rig(const std::string& rig);

/// The name of the rig in result.json of a run; "" where that is not told.
std::string rig_name_of(const std::filesystem::path& run);

/// The folder whose rigs find_rig() knows by their bare names; empty if there is none.
std::filesystem::path rigs_folder();

}  // namespace bodyschema
