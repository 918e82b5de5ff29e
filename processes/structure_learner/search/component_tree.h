#pragma once

#include <vector>

#include "processes/structure_learner/joints/joint_insertion.h"
#include "processes/structure_learner/search/pair_models.h"
#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {

/// The accepted models of one component, outwards from a part that rests if there is one.
class ComponentTree {
 public:
  /// The component of `part`. Keeps a reference to `pairs`.
  ComponentTree(const ModelForest& forest, int part, PairModels* pairs);

  const std::vector<TreeNode>& nodes() const { return nodes_; }
  const std::vector<PairData>& data() const { return data_; }
  bool root_rests() const { return root_rests_; }
  /// Index into the forest's models of the edge that carries a node; −1: the root.
  int model_of(int node) const { return model_of_[static_cast<std::size_t>(node)]; }

  /// All poses of the component's parts at once.
  TreeFit fit() const;
  /// Puts `edges` in the place of the component's models.
  void replace_edges(const std::vector<TreeEdge>& edges, ModelForest* forest) const;

 private:
  PairModels& pairs_;
  std::vector<TreeNode> nodes_;
  std::vector<int> model_of_;
  std::vector<PairData> data_;
  bool root_rests_ = false;
};

/// The joint that a tree lacks most, if it is significant. What a fit has not settled yet looks
/// like one: only if it remains after more steps.
std::optional<MissingJoint> missing_joint(const ModelForest& forest, const PairModels& pairs,
                                          TreeFit* fit);

}  // namespace bodyschema
