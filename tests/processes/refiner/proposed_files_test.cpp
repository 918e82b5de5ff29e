#include "processes/refiner/proposed_files.h"

#include <gtest/gtest.h>

#include "tests/support/temporary_folder.h"

namespace bodyschema {
namespace {

TEST(ProposedFiles, KeepTheTargetTags) {
  const test::TemporaryFolder folder;
  RigCalibration rig;
  rig.markers = {"tag36h11", {{3, 0.08, 1, std::nullopt}}, {{40, 0.12}, {41, 0.1}}};
  rig.camera.width = rig.camera.height = 100;
  write_proposed_files(rig, folder.path());
  const Markers read = load_markers(folder.path());
  EXPECT_EQ(read.ids(), rig.markers.ids());
  EXPECT_EQ(read.size_m(40), 0.12);
  EXPECT_TRUE(read.is_target(41));
}

}  // namespace
}  // namespace bodyschema
