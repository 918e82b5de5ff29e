#pragma once

#include <functional>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// A schema without edges: what the samples say of signals, parts and root, which is the lowest
/// part that has poses if none is told.
BodySchema start_schema(const std::vector<Signal>& signals,
                        const std::vector<ActionPoseSample>& samples, std::optional<int> root);

/// Visits a forest's edges, given by the parts at their ends, outwards and breadth first: from the
/// schema's root, then from the lowest part of every other component. Where `visit` says false
/// there is no edge, and what is beyond it is another component.
using EdgeVisitor = std::function<bool(int edge, int from, int to)>;
void visit_outwards(const std::vector<std::pair<int, int>>& edges, const BodySchema& schema,
                    const EdgeVisitor& visit);

/// The root, if it was seen, and all parts that the schema's edges connect to it.
std::set<int> connected_to_root(const BodySchema& schema);

/// Sets BodySchema::complete and what of the parts, the root and those expected is unconnected:
/// `explain` says why a part is that was seen.
void report_unconnected(const std::vector<int>& expected_parts,
                        const std::function<UnconnectedPart(int part)>& explain,
                        BodySchema* schema);

}  // namespace bodyschema
