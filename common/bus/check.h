#pragma once

#include <string>

#include "common/bus/channels.h"

namespace bodyschema {

///////// Problem of a well-formed message of a channel, for people, beginning with the field
/// ("parts[3].X_CB.rotation_wxyz has norm 0.5, not 1"); "" if it makes sense. Problems: values that
/// are not of the field's kind (braces in its .lcm file: NaN, a quaternion that is not unit, a
/// covariance that is not positive semidefinite, ids that repeat, counts beyond reason or unlike
/// the length of their array, times before 0, an unknown constant, a string that is not UTF-8), and
/// fields that contradict each other (edges that are no tree ordered from the root outwards). The
/// bus calls check() before any handler; a message with a problem is dropped and counted as
/// "senseless". publish() calls it too; there a problem is a bug.
template <class Message>
std::string check(const Message& message);

}  // namespace bodyschema
