#pragma once

#include <vector>

#include "common/schema/body_schema.h"
#include "processes/model_monitor/changes/body_change.h"

namespace bodyschema {

/// How two schemas of one tree (the same parts, signals and pairs of parts) differ.

/// The edge to `part` (root: the camera's pose).
bool differ_at(const BodySchema& a, const BodySchema& b, int part);
/// All that predicts is the same.
bool is_same(const BodySchema& a, const BodySchema& b);
/// One local model of the edge to `part` (root: of the camera's pose): at actions all over the box
/// of the limits it differs by no more than is uncertain about it (χ²₆ at 99 %).
bool is_alike_at(const BodySchema& a, const BodySchema& b, int part);
/// At the same actions it differs by no more than `tolerance`, whatever is certain about it.
bool is_close_at(const BodySchema& a, const BodySchema& b, int part, const Noise& tolerance);
/// One body: alike everywhere.
bool is_alike(const BodySchema& a, const BodySchema& b);
/// The elements in which they differ: markers first, of parts that lie elsewhere between edges
/// which together lead to where they led, then edges.
std::vector<ElementId> differences(const BodySchema& a, const BodySchema& b);
/// The action, of 200 in the box of the limits, at which the poses of a part in the root differ
/// most, in units of `tolerance`; empty if nowhere by more than one.
Eigen::VectorXd most_telling_action(const BodySchema& a, const BodySchema& b,
                                    const Noise& tolerance);

}  // namespace bodyschema
