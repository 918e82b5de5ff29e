#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "processes/refiner/information.h"
#include "processes/refiner/refine.h"

namespace bodyschema {

/// Names, changes and standard deviations of the refined parameters; for people. The transform
/// after the last joint of an edge is told in that joint's frame, so that its turn about z is the
/// joint's offset.
class RefinementWords {
 public:
  /// `frame_tags`: a tag of each part, by which correlations are told: as if it were known where it
  /// sits on the part. That a part's frame moves with all its tags is no news. `coverage`: of each
  /// signal.
  RefinementWords(const BodySchema& start, const Information& information,
                  std::vector<int> frame_tags, std::vector<SignalCoverage> coverage);

  std::vector<RefinedParameter> parameters() const { return parameters_; }
  /// Directions that nothing tells, or noise alone, one sentence an edge, tag or camera or for
  /// those that share one, with what would tell them.
  std::vector<std::string> undetermined() const;
  /// Those above kHighCorrelation, the highest first, at most `most`.
  std::vector<ParameterCorrelation> correlations(std::size_t most) const;

 private:
  struct Place {
    const ParameterBlock* block = nullptr;
    int direction = 0;    ///< in the block's whole tangent
    std::string element;  ///< "offset of q5 (5→6)"
  };
  void add(const ParameterBlock& block);
  std::string name_of(const ParameterBlock& block, int direction) const;
  /// The joint of an edge that a direction is of; of the last link the last one.
  const ScrewJoint& joint_of(const ParameterBlock& block, int direction) const;
  std::string edge_name(const ParameterBlock& block, int direction) const;
  std::string unit_of(const ParameterBlock& block, int direction) const;
  std::string thing_of(const ParameterBlock& block) const;
  bool is_determined(const Place& place, Eigen::Index row) const;
  Eigen::MatrixXd in_frames_of_tags() const;
  /// Which further samples would tell these; "" if unknown.
  std::string advice(const std::vector<Place>& places) const;

  const BodySchema& schema_;
  const Information& information_;
  const std::vector<int> frame_tags_;
  const std::vector<SignalCoverage> coverage_;
  std::vector<Place> places_;
  std::vector<bool> determined_;  // of each place
  std::vector<RefinedParameter> parameters_;
  Eigen::MatrixXd covariance_;           // in the frames that are told
  Eigen::VectorXd undetermined_shares_;  // of each place, 0 … 1
};

}  // namespace bodyschema
