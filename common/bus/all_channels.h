#pragma once

#include "common/bus/channels.h"

namespace bodyschema {

/// Calls visit(channel) for every channel of the contract.
template <class Visit>
void for_each_channel(Visit visit) {
  visit(kActionCommand);
  visit(kBodySchema);
  visit(kCameraImage);
  visit(kCameraInfo);
  visit(kControlStatus);
  visit(kFaultCommand);
  visit(kLearnedSchema);
  visit(kMarkerPoses);
  visit(kModelHealth);
  visit(kMotionStatus);
  visit(kPoseTarget);
  visit(kProcessInfo);
  visit(kRefinedSchema);
  visit(kSample);
  visit(kSampleRequest);
  visit(kSimState);
}

}  // namespace bodyschema
