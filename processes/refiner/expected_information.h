#pragma once

#include <Eigen/Core>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "processes/refiner/expected_sights.h"
#include "processes/refiner/information.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// Places of the free directions of all blocks: the core (root, edges, lens), then the tags, both
/// in units in which a prior, weak or real, is 1. As for correlations, it is taken as known where
/// one tag of each part sits.
struct InformationLayout {
  std::vector<Eigen::Index> core, tags;  ///< rows of the information
  /// By free direction; −1: known.
  std::map<const ParameterBlock*, std::vector<Eigen::Index>> places;
  Eigen::VectorXd units;  ///< by row of the information
  Eigen::VectorXd prior;  ///< information of the weak prior, by place in the core

  InformationLayout(RefinementProblem& problem, const Information& information);

  /// The information in these units, over its rows.
  Eigen::MatrixXd scaled(const Eigen::MatrixXd& information) const {
    return units.asDiagonal() * information * units.asDiagonal();
  }
};

/// The derivative of what an action is expected to show.
struct Expectation {
  struct TagRows {
    Eigen::Index row = 0, column = 0;  ///< of the first
    Eigen::MatrixXd J;
  };
  Eigen::MatrixXd core;  ///< r × core, rows whitened
  std::vector<TagRows> tags;
  Eigen::MatrixXd noise;  ///< r × r, with what belongs to the instant
  bool has_instant = false;
};

/// Makes Expectations, of actions and of samples. All arguments must outlive it.
class Forecast {
 public:
  /// `worth`: Information::worth().
  Forecast(const InformationLayout& layout, const ExpectedSights& sights,
           RefinementProblem& problem, bool has_corners, double worth)
      : layout_(layout),
        sights_(sights),
        problem_(problem),
        has_corners_(has_corners),
        worth_(worth) {}

  /// Of a further sample at this action.
  Expectation at(const Eigen::VectorXd& action) const;
  /// Of the tags or the parts that this sample shows; a root that moves is taken to be where it is
  /// at a further one.
  Expectation of(const RefinerSample& seen) const;

 private:
  struct Row;
  using Rows = std::vector<Row>;
  void add(std::optional<RefinementProblem::Cost> cost, double probability, Rows* rows) const;
  Expectation assembled(const Rows& rows) const;
  void place(const Eigen::MatrixXd& J, const ParameterBlock& block,
             const std::vector<Eigen::Index>& places, Eigen::Index first,
             Expectation* result) const;
  Eigen::VectorXd instant_sd(Eigen::Index size) const;

  const InformationLayout& layout_;
  const ExpectedSights& sights_;
  RefinementProblem& problem_;
  const bool has_corners_;
  const double worth_;
};

}  // namespace bodyschema
