#include "processes/controller/tag_track.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

TagTrack::Sight sight(const Eigen::Vector3d& p_CM, double sd_m = 0.001) {
  return {p_CM, sd_m * sd_m * Eigen::Matrix3d::Identity()};
}

const Eigen::Vector3d kPlace(0.1, -0.2, 1.5), kElsewhere(0.1, -0.2, 1.58);

TEST(TagTrack, KnowsATagOnceTwoFramesAgree) {
  TagTrack track;
  EXPECT_FALSE(track.is_known());
  EXPECT_EQ(track.account(), "is not seen");
  track.see(sight(kPlace));
  EXPECT_FALSE(track.is_known());
  EXPECT_EQ(track.account(), "is seen in 1 frame");
  track.see(sight(kPlace));
  EXPECT_TRUE(track.is_known());
  EXPECT_LT((track.p_CM() - kPlace).norm(), 1e-9);
}

TEST(TagTrack, ItsMeanIsWeightedByTheCovariances) {
  TagTrack track;
  track.see(sight(kPlace, 0.001));
  track.see(sight(kPlace + Eigen::Vector3d(0.005, 0, 0), 0.002));
  EXPECT_LT((track.p_CM() - kPlace - Eigen::Vector3d(0.001, 0, 0)).norm(), 1e-9);
}

TEST(TagTrack, ATagThatIsLostAndSeenAgainThereIsWhereItWas) {
  TagTrack track;
  for (int n = 0; n < 2; ++n) track.see(sight(kPlace));
  track.see(std::nullopt);
  EXPECT_FALSE(track.is_known());
  EXPECT_EQ(track.account(), "is not seen");
  track.see(sight(kPlace));
  EXPECT_TRUE(track.is_known());
  EXPECT_EQ(track.place(), 0);
}

TEST(TagTrack, ATagThatMovesBeyondTheNoiseIsInAnotherPlace) {
  TagTrack track;
  for (int n = 0; n < 100; ++n) track.see(sight(kPlace));
  track.see(sight(kPlace + Eigen::Vector3d(0.003, 0, 0)));
  EXPECT_EQ(track.place(), 0);
  track.see(sight(kElsewhere));
  EXPECT_EQ(track.place(), 1);
  EXPECT_FALSE(track.is_known());
  EXPECT_EQ(track.account(), "moved by 80 mm");
  track.see(sight(kElsewhere));
  EXPECT_TRUE(track.is_known());
  EXPECT_LT((track.p_CM() - kElsewhere).norm(), 1e-9);
}

TEST(TagTrack, AMoveWithinTheNoiseIsForgottenWithTheOldFrames) {
  TagTrack track;
  for (int n = 0; n < 1000; ++n) track.see(sight(kPlace));
  const Eigen::Vector3d near = kPlace + Eigen::Vector3d(0.004, 0, 0);
  for (int n = 0; n < 5 * TagTrack::kWindow; ++n) track.see(sight(near));
  EXPECT_EQ(track.place(), 0);
  EXPECT_LT((track.p_CM() - near).norm(), 1e-4);
}

}  // namespace
}  // namespace bodyschema
