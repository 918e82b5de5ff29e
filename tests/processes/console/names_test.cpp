#include "processes/console/names.h"

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/schema/body_schema.h"

namespace bodyschema {
namespace {

TEST(NamesTest, TheLastNumberOfEachKindHasTheLastName) {
  EXPECT_STREQ(name_in(kPhases, process_info_t::PHASE_ENDED), kPhases.back());
  EXPECT_STREQ(name_in(kMotionStates, motion_status_t::STATE_HOLDING), kMotionStates.back());
  EXPECT_STREQ(name_in(kControlStates, control_status_t::CONTROL_RELEASED), kControlStates.back());
  EXPECT_STREQ(name_in(kEdgeStates, schema_edge_t::EDGE_PROVISIONAL), kEdgeStates.back());
  EXPECT_STREQ(name_in(kEdgeStateWords, EdgeState::kSuspect), "suspect");
  EXPECT_STREQ(name_in(kUnconnectedReasons, Unconnected::kNoValidModel), "no valid model");
  EXPECT_STREQ(name_in(kHealthEvents, health_event_t::EVENT_PROBE_WANTED), kHealthEvents.back());
  EXPECT_STREQ(name_in(kFindingStates, finding_t::FINDING_ASIDE), "aside");
  EXPECT_THROW(name_in(kPhases, -1), std::out_of_range);
}

}  // namespace
}  // namespace bodyschema
