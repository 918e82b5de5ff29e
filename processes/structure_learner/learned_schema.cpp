#include "processes/structure_learner/learned_schema.h"

#include <algorithm>

#include "common/kinematics/kinematic_tree.h"
#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

BodySchema start_schema(const std::vector<Signal>& signals,
                        const std::vector<ActionPoseSample>& samples, std::optional<int> root) {
  BodySchema schema;
  schema.signals = signals;
  schema.num_samples = static_cast<int>(samples.size());
  for (const ActionPoseSample& sample : samples)
    schema.last_sample_index = std::max(schema.last_sample_index, sample.sample_index);
  if (!samples.empty()) schema.calibration_id = samples.back().calibration_id;
  schema.parts = seen_parts(samples);
  schema.position_parts = parts_without_rotation(samples);
  if (!schema.parts.empty()) schema.root = schema.parts.front();
  const auto first_posed = std::find_if(schema.parts.begin(), schema.parts.end(),
                                        [&](int part) { return schema.has_rotation(part); });
  if (first_posed != schema.parts.end()) schema.root = *first_posed;
  if (root) schema.root = *root;
  return schema;
}

void visit_outwards(const std::vector<std::pair<int, int>>& edges, const BodySchema& schema,
                    const EdgeVisitor& visit) {
  std::vector<int> starts = schema.parts;  // a leaf without orientation is no start
  std::stable_partition(starts.begin(), starts.end(),
                        [&](int part) { return schema.has_rotation(part); });
  if (schema.has_part(schema.root)) starts.insert(starts.begin(), schema.root);
  std::set<int> reached;
  for (const int start : starts) {
    if (!reached.insert(start).second) continue;
    const KinematicTree tree(edges, start);
    std::set<int> grown{start};
    for (const KinematicTree::Node& node : tree.nodes()) {
      if (node.parent < 0 || reached.contains(node.part)) continue;
      const int from = tree.nodes()[static_cast<std::size_t>(node.parent)].part;
      if (!grown.contains(from) || !visit(node.edge, from, node.part)) continue;
      grown.insert(node.part);
      reached.insert(node.part);
    }
  }
}

std::set<int> connected_to_root(const BodySchema& schema) {
  std::set<int> connected;
  if (!schema.has_part(schema.root) || !schema.has_rotation(schema.root)) return connected;
  const KinematicTree tree(schema.edges, schema.root);
  for (const KinematicTree::Node& node : tree.nodes()) connected.insert(node.part);
  return connected;
}

void report_unconnected(const std::vector<int>& expected_parts,
                        const std::function<UnconnectedPart(int part)>& explain,
                        BodySchema* schema) {
  const std::set<int> connected = connected_to_root(*schema);
  std::set<int> expected(expected_parts.begin(), expected_parts.end());
  expected.insert(schema->parts.begin(), schema->parts.end());
  if (schema->root >= 0) expected.insert(schema->root);
  for (const int part : expected) {
    if (connected.contains(part)) continue;
    schema->unconnected.push_back(
        schema->has_part(part) ? explain(part)
                               : UnconnectedPart{part, Unconnected::kNeverSeen, "never seen"});
  }
  const std::vector<int>& parts = schema->parts;
  if (parts.size() == 1 && connected.contains(parts.front()))
    schema->unconnected.push_back({parts.front(), Unconnected::kNotEnoughData, kOnlyPart});
  // A part that was never seen is reported, but a tree over all the others is complete (Fig. 8,
  // 11).
  schema->complete = parts.size() > 1 && std::all_of(parts.begin(), parts.end(), [&](int part) {
                       return connected.contains(part);
                     });
}

}  // namespace bodyschema
