#include "processes/structure_learner/search/component_tree.h"

#include <algorithm>

#include "common/kinematics/kinematic_tree.h"
#include "processes/structure_learner/joints/missing_joint_test.h"

namespace bodyschema {

ComponentTree::ComponentTree(const ModelForest& forest, int part, PairModels* pairs)
    : pairs_(*pairs) {
  const std::vector<int> members = forest.members(part);
  const auto resting =
      std::find_if(members.begin(), members.end(), [&](int m) { return pairs->rests(m); });
  root_rests_ = resting != members.end();
  const KinematicTree tree(ends_of(forest.models()), root_rests_ ? *resting : members.front());
  for (const KinematicTree::Node& node : tree.nodes()) {
    TreeNode& added = nodes_.emplace_back(TreeNode{node.part, node.parent, {}});
    model_of_.push_back(node.edge);
    data_.push_back(pairs->part_data(node.part));
    if (node.edge < 0) continue;
    const LocalModel& model = forest.models()[static_cast<std::size_t>(node.edge)].model;
    added.model = node.is_forward ? model : model.inverse();
  }
}

TreeFit ComponentTree::fit() const {
  ++pairs_.num_fits;
  TreeFit fit(nodes_, data_, pairs_.actions(), root_rests_);
  fit.fit(15, 0.2);
  return fit;
}

void ComponentTree::replace_edges(const std::vector<TreeEdge>& edges, ModelForest* forest) const {
  std::vector<AcceptedModel> models;
  for (int m = 0; m < static_cast<int>(forest->models().size()); ++m)
    if (!std::count(model_of_.begin(), model_of_.end(), m))
      models.push_back(forest->models()[static_cast<std::size_t>(m)]);
  for (const TreeEdge& e : edges) {
    AcceptedModel model{nodes_[e.a].part, nodes_[e.b].part, e.model, 0};
    if (model.part_i > model.part_j) {
      std::swap(model.part_i, model.part_j);
      model.model = model.model.inverse();
    }
    models.push_back(model);
  }
  forest->set_models(std::move(models));
}

std::optional<MissingJoint> missing_joint(const ModelForest& forest, const PairModels& pairs,
                                          TreeFit* fit) {
  const std::set<int> idle = forest.idle_signals(pairs.actions().moving());
  // What a long chain leaves of its own signals is how its joints are not perfect.
  std::set<int> of_chains;
  for (const AcceptedModel& m : forest.models())
    if (m.model.num_joints() > kMaxScreenedJoints) of_chains.merge(signal_set(m.model));
  for (bool is_settled = false;; is_settled = true) {
    const SearchOptions& options = pairs.options();
    std::vector<MissingJoint> missing =
        missing_joints(*fit, options.measurement.systematic, options.unknown_bias);
    std::erase_if(missing,
                  [&](const MissingJoint& joint) { return of_chains.contains(joint.signal); });
    const auto worst = most_significant(missing, fit->num_frames(), idle);
    if (!worst || is_settled) return worst;
    fit->fit(60, 1e-5);
  }
}

}  // namespace bodyschema
