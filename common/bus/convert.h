#pragma once

#include <string>
#include <vector>

#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/marker_poses_t.hpp"
#include "bodyschema/pose_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/camera/fit_pose.h"
#include "common/geometry/pose.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

// Conversion between messages and the types of common/. Only these functions know the order of a
// quaternion on the wire (w x y z). from_message() of a message that passed check() does not throw.

pose_t to_message(const Pose& X_AB);
Pose from_message(const pose_t& message);

// Covariances. from_message() makes one that rounding to float left nearly singular invertible: it
// raises the eigenvalues of the correlations to 4 kTriangleRounding.

void to_message(const Matrix6d& covariance, float (&message)[21]);
Matrix6d from_message(const float (&message)[21]);
void to_message(const Matrix8d& covariance, float (&message)[36]);
Matrix8d from_message(const float (&message)[36]);

/// Leaves out corners, which sample_t carries and ActionPoseSample does not.
ActionPoseSample from_message(const sample_t& message);
/// Source, epoch, action id, rest interval and corners are left empty.
sample_t to_message(const ActionPoseSample& sample);

body_schema_t to_message(const BodySchema& schema);
BodySchema from_message(const body_schema_t& message);

/// Sets a message's array together with its count.
template <class Count, class Element>
void set_array(Count& count, std::vector<Element>& array, std::vector<Element> values) {
  array = std::move(values);
  count = static_cast<Count>(array.size());
}

}  // namespace bodyschema
