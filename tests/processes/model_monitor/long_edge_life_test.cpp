// Arms of which base and hand alone are seen: what breaks inside the one edge.

#include <gtest/gtest.h>

#include <algorithm>

#include "processes/model_monitor/health/health_words.h"
#include "tests/support/long_arm.h"

namespace bodyschema {
namespace {

using Kind = AdaptationEvent::Kind;
using test::LongArm;
using test::LongFault;

constexpr int kBlock = 60;

struct Case {
  const char* name;
  LongFault fault;
  int at;
  test::LongArmOptions options;
  const char* words;  ///< of what is confirmed in the end
};

class LongEdgeLife : public testing::TestWithParam<Case> {};

TEST_P(LongEdgeLife, AFaultInsideAnEdgeIsNamedRepairedAndTakenBack) {
  const Case& c = GetParam();
  LongArm arm(c.options, c.fault, c.at, 3);
  const test::LongLife life = live(&arm, 3 * kBlock);
  std::string log, confirmed;
  for (const AdaptationEvent& event : life.events) {
    const std::string words = text_of(event, arm.engineered().signals);
    log += std::to_string(event.sample_index) + " " + words + "\n";
    EXPECT_GE(event.sample_index, kBlock) << log;
    if (event.kind == Kind::kRecovered && event.sample_index < 2 * kBlock) {
      EXPECT_TRUE(arm.is_named_by(event)) << words;
      confirmed = words;
    }
  }
  SCOPED_TRACE(log);
  EXPECT_NE(confirmed.find(c.words), std::string::npos);
  const double most = 1.5 * life.error[kBlock - 1];
  EXPECT_LE(life.samples_until_right(1, kBlock, 0.03), 5);
  EXPECT_LE(life.samples_until_right(1, kBlock, most), 20);
  EXPECT_LE(life.samples_until_right(2, kBlock, most), 5);
}

constexpr test::LongArmOptions kSix{.num_joints = 6}, kSeven{.num_joints = 7, .slides = 3},
    kFine{.num_joints = 7, .is_fine = true};
INSTANTIATE_TEST_SUITE_P(
    AdaptationTest, LongEdgeLife,
    testing::Values(Case{"stuck", LongFault::kStuck, 2, kSix, "q3 (1→2) stuck at"},
                    Case{"stuck_slide", LongFault::kStuck, 3, kSeven, "q4 (1→2) stuck at"},
                    Case{"offset", LongFault::kOffset, 0, kSeven, "q1 (1→2) off by"},
                    Case{"gain", LongFault::kGain, 4, kSix, "q5 (1→2) goes 0."},
                    Case{"bend", LongFault::kBend, 2, kSix, "1→2 bent or exchanged behind q3 by"},
                    Case{"bend_fine", LongFault::kBend, 4, kFine,
                         "1→2 bent or exchanged behind q5 by"},
                    Case{"base", LongFault::kBase, 0, kSeven, "1→2 bent or exchanged by"},
                    Case{"tool", LongFault::kTool, 0, kSix, ""}),
    [](const auto& info) { return std::string(info.param.name); });

TEST(LongEdgeStream, AHealthyLongEdgeIsLeftAlone) {
  for (const test::LongArmOptions& options : {kSix, kSeven, kFine}) {
    LongArm arm(options, LongFault::kNone, 0, 5);
    const test::LongLife life = live(&arm, 300);
    EXPECT_TRUE(life.events.empty());
  }
}

}  // namespace
}  // namespace bodyschema
