#pragma once

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <string>

namespace bodyschema::test {

/// A copy of a simulated rig with target tag 40 of 0.12 m, which faces the camera at `p_CM` ("x, y,
/// z" [m], camera's frame). Removed at the end.
class TargetRig {
 public:
  TargetRig(const std::filesystem::path& rig, const std::string& p_CM)
      : folder_(std::filesystem::temp_directory_path() /
                ("target_rig_" + std::to_string(getpid()))) {
    std::filesystem::remove_all(folder_);
    std::filesystem::copy(rig, folder_, std::filesystem::copy_options::recursive);
    add("markers.yaml", "{id: 40, size_m: 0.12}");
    add("robot.yaml", "{id: 40, size_m: 0.12, X_CM: {position_m: [" + p_CM + "]}}");
  }
  ~TargetRig() { std::filesystem::remove_all(folder_); }
  TargetRig(const TargetRig&) = delete;

  const std::filesystem::path& folder() const { return folder_; }

 private:
  void add(const std::string& file, const std::string& tag) const {
    std::ofstream(folder_ / file, std::ios::app) << "\ntarget_tags:\n  - " << tag << "\n";
  }

  const std::filesystem::path folder_;
};

}  // namespace bodyschema::test
