#include <gtest/gtest.h>
#include <pty.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <regex>
#include <string>

#include "common/config/calibration_id.h"
#include "common/config/proposed_calibration.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/support/text_of.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;
using test::text_of;

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
    const int status =
        std::system((command(flags) + " >'" + out.string() + "' 2>&1 </dev/null").c_str());
    said_ = text_of(out);
    return WEXITSTATUS(status);
  }
  /// The same on a terminal; at the question `meanwhile` happens, then `answer` is typed.
  int adopt_asked(
      const std::string& answer, const std::function<void()>& meanwhile = [] {}) {
    int terminal = -1;
    const pid_t child = ::forkpty(&terminal, nullptr, nullptr, nullptr);
    if (child == 0) {
      ::execl("/bin/sh", "sh", "-c", command(rig_flag()).c_str(), nullptr);
      ::_exit(127);
    }
    said_.clear();
    bool is_answered = false;
    char bytes[4096];
    // Reading fails when the program is gone.
    for (ssize_t n = 0; (n = ::read(terminal, bytes, sizeof bytes)) > 0;) {
      said_.append(bytes, static_cast<std::size_t>(n));
      if (is_answered || !says("[y/N] ")) continue;
      meanwhile();
      is_answered = ::write(terminal, answer.data(), answer.size()) > 0;
    }
    ::close(terminal);
    int status = 0;
    ::waitpid(child, &status, 0);
    EXPECT_TRUE(is_answered) << said_;
    return WEXITSTATUS(status);
  }
  std::string command(const std::string& flags) const {
    return "cd '" + folder_.path().string() + "' && '" BODYSCHEMA_PROGRAM "' adopt '" +
           run_.string() + "' " + flags;
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
  EXPECT_TRUE(says("focal length x  1104.60 → 1107.90 px (+0.299 %)")) << said_;
  EXPECT_TRUE(says("points of the image move by")) << said_;
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

TEST_F(AdoptProgramTest, RefusesFilesOfTwoRefinements) {
  const auto mark = [&](const std::string& name, const std::string& id) {
    const std::string text = text_of(proposed_ / name);
    std::ofstream(proposed_ / name) << kProposalMark << " " << id << "\n" << text;
  };
  mark("markers.yaml", "1");
  mark("camera_info.yaml", "2");
  expect_refusal("two refinements");
  mark("camera_info.yaml", "1");
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  EXPECT_TRUE(is_adopted());
}

TEST_F(AdoptProgramTest, AsksOnATerminal) {
  for (const std::string answer : {"n\n", "\n", "\x04"}) {
    EXPECT_EQ(adopt_asked(answer), 0) << said_;
    EXPECT_TRUE(says("Write these into " + rig_.string() + "? [y/N] ")) << said_;
    EXPECT_TRUE(says("Nothing was written")) << said_;
    EXPECT_TRUE(is_untouched());
  }
  EXPECT_EQ(adopt_asked("y\n"), 0) << said_;
  EXPECT_TRUE(says("are not mixed with new ones")) << said_;
  EXPECT_TRUE(is_adopted());
}

TEST_F(AdoptProgramTest, WritesWhatItHasShown) {
  const std::string shown = text_of(proposed_ / "markers.yaml");
  EXPECT_EQ(adopt_asked(
                "y\n", [&] { edit(proposed_ / "markers.yaml", "size_m: 0.0804", "size_m: 0.09"); }),
            0);
  EXPECT_EQ(text_of(rig_ / "markers.yaml"), shown);
}

TEST_F(AdoptProgramTest, WritesNothingOverAnEditThatItHasNotShown) {
  EXPECT_EQ(adopt_asked("y\n", [&] { edit(rig_ / "camera_info.yaml", "1104.6", "1100"); }), 1);
  EXPECT_TRUE(says("was changed in the meantime; nothing was written")) << said_;
  EXPECT_EQ(text_of(rig_ / "markers.yaml"), text_of(run_ / "config" / "markers.yaml"));
  EXPECT_FALSE(fs::exists(rig_ / "markers.yaml.before"));
}

TEST_F(AdoptProgramTest, AProposalMayBeOfTagsOrOfTheLensAlone) {
  fs::remove(proposed_ / "camera_info.yaml");
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  EXPECT_TRUE(says("lens as before")) << said_;
  EXPECT_EQ(text_of(rig_ / "markers.yaml"), text_of(proposed_ / "markers.yaml"));
  EXPECT_EQ(text_of(rig_ / "camera_info.yaml"), text_of(run_ / "config" / "camera_info.yaml"));
  EXPECT_FALSE(fs::exists(rig_ / "camera_info.yaml.before"));
}

TEST_F(AdoptProgramTest, OtherWordsForTheSameValuesAreNoChange) {
  fs::copy(run_ / "config" / "markers.yaml", proposed_ / "markers.yaml",
           fs::copy_options::overwrite_existing);
  std::ofstream(proposed_ / "markers.yaml", std::ios::app) << "# as proposed\n";
  std::ofstream(rig_ / "camera_info.yaml", std::ios::app) << "# by hand\n";
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  EXPECT_TRUE(says("tags as before")) << said_;
  EXPECT_EQ(text_of(rig_ / "markers.yaml"), text_of(run_ / "config" / "markers.yaml"));
  EXPECT_EQ(text_of(rig_ / "camera_info.yaml"), text_of(proposed_ / "camera_info.yaml"));
}

TEST_F(AdoptProgramTest, FindsTheRigOfTheRunByItsName) {
  fs::create_directory(folder_ / "config");
  fs::rename(rig_, folder_ / "config" / "mine");
  std::ofstream(run_ / "result.json") << R"({"rig": "mine"})";
  EXPECT_EQ(adopt("--yes"), 0) << said_;
  EXPECT_EQ(text_of(folder_ / "config" / "mine" / "markers.yaml"),
            text_of(proposed_ / "markers.yaml"));
  for (const std::string result : {R"({"rig": "yours"})", R"({"rig": 3})", "{"}) {
    std::ofstream(run_ / "result.json") << result;
    EXPECT_EQ(adopt("--yes"), 1);
    EXPECT_TRUE(says("give --rig")) << said_;
  }
}

TEST_F(AdoptProgramTest, WritesTheCalibrationThatTheRigNames) {
  fs::create_directory(folder_ / "lenses");
  fs::rename(rig_ / "camera_info.yaml", folder_ / "lenses" / "real.yaml");
  fs::create_symlink("../lenses/real.yaml", rig_ / "lens.yaml");
  edit(rig_ / "camera.yaml", "calibration: camera_info.yaml", "calibration: lens.yaml");
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  EXPECT_TRUE(fs::is_symlink(rig_ / "lens.yaml"));
  EXPECT_EQ(text_of(folder_ / "lenses" / "real.yaml"), text_of(proposed_ / "camera_info.yaml"));
  EXPECT_TRUE(fs::exists(folder_ / "lenses" / "real.yaml.before"));
}

TEST_F(AdoptProgramTest, OldFilesAreNoOddityOfTheRig) {
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 0) << said_;
  const fs::path out = folder_ / "said";
  std::system(("'" BODYSCHEMA_PROGRAM "' rig '" + rig_.string() + "' >'" + out.string() + "' 2>&1")
                  .c_str());
  said_ = text_of(out);
  EXPECT_TRUE(says("OK: 5 parts")) << said_;
  EXPECT_FALSE(says("before")) << said_;
}

TEST_F(AdoptProgramTest, RefusesARigThatIsNoLongerTheRuns) {
  edit(rig_ / "markers.yaml", "id: 4, size_m: 0.08", "id: 4, size_m: 0.09");
  expect_refusal((rig_ / "markers.yaml").string() + ": is no longer that of the run");
  EXPECT_TRUE(says("markers.yaml (tag 4 differs), nor the proposed one (tags 4 and 8 differ)"))
      << said_;
  EXPECT_FALSE(says((rig_ / "camera_info.yaml").string())) << said_;
  edit(rig_ / "markers.yaml", "id: 5, size_m: 0.08", "id: 5, size_m: 0.09");
  edit(rig_ / "camera_info.yaml", "1104.6, 0.0, 645.2", "1104.6, 0.0, 646.2");
  expect_refusal((rig_ / "camera_info.yaml").string() + ": is no longer that of the run");
  EXPECT_TRUE(says("(tags 4 and 5 differ), nor")) << said_;
  EXPECT_TRUE(says("(centre differs), nor the proposed one (focal length and centre differ)"))
      << said_;
}

TEST_F(AdoptProgramTest, RefusesOtherTagsAndOtherCameras) {
  const std::string good = text_of(proposed_ / "markers.yaml");
  edit(proposed_ / "markers.yaml", "id: 8, ", "id: 88, ");
  expect_refusal("tag 8 is missing; the run had no tag 88");
  EXPECT_TRUE(is_untouched());
  std::ofstream(proposed_ / "markers.yaml") << good;
  edit(proposed_ / "markers.yaml", "(id: 8, .*)part: 3", "$1part: 4");
  expect_refusal("tag 8 is on part 4, in the run on part 3");
  std::ofstream(proposed_ / "markers.yaml") << good;
  edit(proposed_ / "markers.yaml", "tag36h11", "tag25h9");
  expect_refusal("markers.yaml:3: family: 'tag25h9'");
  std::ofstream(proposed_ / "markers.yaml") << good;
  edit(proposed_ / "camera_info.yaml", "image_width: 1280", "image_width: 1290");
  expect_refusal("holds for images of 1290×960 px, the run's have 1280×960 px");
  EXPECT_TRUE(is_untouched());
}

TEST_F(AdoptProgramTest, RefusesARunWhoseSamplesWereSeenThroughAnotherLens) {
  fs::copy(BODYSCHEMA_LOGS "/arm2_15.lcmlog", run_ / "samples.lcmlog");
  // Told by its full path it has no copy in the run.
  const fs::path lens = folder_ / "lens.yaml";
  fs::copy(rig_ / "camera_info.yaml", lens);
  for (const fs::path& config : {rig_, run_ / "config"})
    edit(config / "camera.yaml", "calibration: camera_info.yaml",
         "calibration: '" + lens.string() + "'");
  EXPECT_EQ(adopt(rig_flag()), 0) << said_;
  edit(lens, "1104.6", "1103.1");
  expect_refusal("samples.lcmlog: the samples were not seen through");
}

TEST_F(AdoptProgramTest, LeavesTheRunsCopyOfItsRigAsItIs) {
  EXPECT_EQ(adopt("--rig '" + (run_ / "config").string() + "' --yes"), 1);
  EXPECT_TRUE(says("is the rig as the run had it")) << said_;
  EXPECT_FALSE(fs::exists(run_ / "config" / "markers.yaml.before"));
}

TEST_F(AdoptProgramTest, SaysWhatIsMissing) {
  EXPECT_EQ(adopt("--yes"), 1);
  EXPECT_TRUE(says("give --rig")) << said_;
  fs::remove_all(proposed_);
  EXPECT_EQ(adopt(rig_flag() + "--yes"), 1);
  EXPECT_TRUE(says("refiner.yaml")) << said_;
  EXPECT_TRUE(is_untouched());
  fs::rename(run_, folder_ / "gone");
  EXPECT_EQ(adopt("--yes"), 1);
  EXPECT_TRUE(says("there is no such folder of a run")) << said_;
}

}  // namespace
}  // namespace bodyschema
