#include <gtest/gtest.h>
#include <sys/wait.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <regex>
#include <sstream>
#include <string>

#include "common/config/calibration_id.h"
#include "tests/common/bus/bus_test_support.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;

std::string text_of(const fs::path& file) {
  std::stringstream text;
  text << std::ifstream(file).rdbuf();
  return text.str();
}

void edit(const fs::path& file, const std::string& from, const std::string& to) {
  const std::string text = text_of(file);
  const std::string edited = std::regex_replace(text, std::regex(from), to);
  ASSERT_NE(edited, text) << from;
  std::ofstream(file) << edited;
}

/// A run of arm2 in which a refiner found another lens, and tag 8 elsewhere and larger.
class AdoptProgramTest : public testing::Test {
 protected:
  AdoptProgramTest() {
    fs::copy(BODYSCHEMA_CONFIG "/arm2", rig_);
    fs::create_directories(proposed_);
    fs::copy(rig_, run_ / "config");
    for (const std::string name : {"markers.yaml", "camera_info.yaml"})
      fs::copy(rig_ / name, proposed_ / name);
    edit(proposed_ / "markers.yaml", "id: 8, size_m: 0.08, part: 3, placement: .position_m: .0.056",
         "id: 8, size_m: 0.0804, part: 3, placement: {position_m: [0.0575");
    edit(proposed_ / "camera_info.yaml", "1104.6", "1107.9");
  }

  /// Exit code; stdout and stderr in said_.
  int adopt(const std::string& flags) {
    const fs::path out = folder_ / "said";
    const std::string command = "'" BODYSCHEMA_PROGRAM "' adopt '" + run_.string() + "' " + flags +
                                " >'" + out.string() + "' 2>&1 </dev/null";
    const int status = std::system(command.c_str());
    said_ = text_of(out);
    return WEXITSTATUS(status);
  }
  std::string rig_flag() const { return "--rig '" + rig_.string() + "' "; }
  bool says(const std::string& words) const { return said_.find(words) != std::string::npos; }
  bool is_adopted() const {
    return text_of(rig_ / "markers.yaml") == text_of(proposed_ / "markers.yaml") &&
           text_of(rig_ / "camera_info.yaml") == text_of(proposed_ / "camera_info.yaml");
  }
  bool is_untouched() const {
    for (const std::string name : {"markers.yaml", "camera_info.yaml"})
      if (text_of(rig_ / name) != text_of(run_ / "config" / name)) return false;
    return !fs::exists(rig_ / "markers.yaml.before");
  }
  void expect_refusal(const std::string& words) {
    EXPECT_EQ(adopt(rig_flag() + "--yes"), 1);
    EXPECT_TRUE(says(words)) << said_;
    EXPECT_FALSE(is_adopted());
  }

  test::TemporaryFolder folder_;
  const fs::path rig_ = folder_ / "rig", run_ = folder_ / "run", proposed_ = run_ / "proposed";
  std::string said_;
};

TEST_F(AdoptProgramTest, ShowsWhatIsAnotherAndWritesNothingUnasked) {
  EXPECT_EQ(adopt(rig_flag()), 0);
  EXPECT_TRUE(says("    8     3       1.500      0.000    +0.500")) << said_;
  EXPECT_TRUE(says("1104.60 → 1107.90 px")) << said_;
  EXPECT_TRUE(says("15 tags as before")) << said_;
  EXPECT_TRUE(says("--yes")) << said_;
  EXPECT_TRUE(is_untouched());
}

TEST_F(AdoptProgramTest, WritesWithConsentAndKeepsTheOldFiles) {
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  EXPECT_TRUE(is_adopted());
  for (const std::string name : {"markers.yaml", "camera_info.yaml"})
    EXPECT_EQ(text_of(rig_ / (name + ".before")), text_of(run_ / "config" / name));
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0);
  EXPECT_TRUE(says("already")) << said_;
  // The old files are still the old ones.
  EXPECT_EQ(text_of(rig_ / "markers.yaml.before"), text_of(run_ / "config" / "markers.yaml"));
}

TEST_F(AdoptProgramTest, FinishesWhatWasCutShort) {
  fs::copy(proposed_ / "markers.yaml", rig_ / "markers.yaml", fs::copy_options::overwrite_existing);
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  EXPECT_TRUE(is_adopted());
}

TEST_F(AdoptProgramTest, RefusesARigThatIsNotTheRuns) {
  edit(rig_ / "markers.yaml", "id: 4, size_m: 0.08", "id: 4, size_m: 0.09");
  expect_refusal("is not what the run");
}

TEST_F(AdoptProgramTest, RefusesOtherTagsAndOtherCameras) {
  const std::string good = text_of(proposed_ / "markers.yaml");
  edit(proposed_ / "markers.yaml", "id: 8, ", "id: 88, ");
  expect_refusal("another tag 8");
  std::ofstream(proposed_ / "markers.yaml") << good;
  edit(proposed_ / "camera_info.yaml", "image_width: 1280", "image_width: 1290");
  expect_refusal("another camera");
}

TEST_F(AdoptProgramTest, SaysWhatIsMissing) {
  EXPECT_EQ(adopt("--yes"), 1);
  EXPECT_TRUE(says("give --rig")) << said_;
  fs::remove(proposed_ / "camera_info.yaml");
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 1);
  EXPECT_TRUE(says("refiner.yaml")) << said_;
  EXPECT_TRUE(is_untouched());
}

}  // namespace
}  // namespace bodyschema
