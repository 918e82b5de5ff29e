#include "processes/model_monitor/changes/drift.h"

#include "tests/processes/model_monitor/changed_arm.h"

namespace bodyschema {
namespace {

class DriftChangeTest : public ChangedArm {
 protected:
  DriftChangeTest() : ChangedArm(3) {}
};

TEST_F(DriftChangeTest, ARateIsHowFarItsStepGoesInASample) {
  const Vector6d rate = 0.01 * test::gaussian6(rng_);
  for (const auto& [part, link, form] : {std::tuple{kPart, 1, Form::kBent},
                                         {kPart, 0, Form::kBent},
                                         {schema_.root, 0, Form::kCamera}}) {
    SCOPED_TRACE(static_cast<int>(form));
    const BodyChange step = drift_step(schema_, part, link);
    EXPECT_EQ(step, (BodyChange{form, part, link}));
    const BodySchema now = changed(schema_, step, coordinates(exp(rate)));
    const Vector6d moved = part == kPart
                               ? log(pose_at(schema_, part).inverse() * pose_at(now, part))
                               : log(schema_.X_CR.inverse() * now.X_CR);
    const ChangeSize size = size_of_rate(schema_, part, link, rate, 1e-8 * rate * rate.transpose());
    EXPECT_EQ(size.kind, ChangeSize::Kind::kRate);
    EXPECT_NEAR(size.amounts[0], moved.head<3>().norm(), 1e-9);
    EXPECT_NEAR(size.amounts[1], moved.tail<3>().norm(), 1e-9);
    EXPECT_NEAR(size.sds[0], 1e-4 * size.amounts[0], 1e-9);
  }
}

}  // namespace
}  // namespace bodyschema
