#pragma once

#include <filesystem>
#include <fstream>
#include <string>

#include "tests/support/temporary_folder.h"

namespace bodyschema::test {

/// A copy of a simulated rig with target tag 40 of 0.12 m, which faces the camera at `p_CM` ("x, y,
/// z" [m], camera's frame). Removed at the end.
class TargetRig {
 public:
  TargetRig(const std::filesystem::path& rig, const std::string& p_CM) : folder_(rig) {
    add("markers.yaml", "{id: 40, size_m: 0.12}");
    add("robot.yaml", "{id: 40, size_m: 0.12, X_CM: {position_m: [" + p_CM + "]}}");
  }

  const std::filesystem::path& folder() const { return folder_.path(); }

 private:
  void add(const std::string& file, const std::string& tag) const {
    std::ofstream(folder_ / file, std::ios::app) << "\ntarget_tags:\n  - " << tag << "\n";
  }

  const TemporaryFolder folder_;
};

}  // namespace bodyschema::test
