#pragma once

#include <gtest/gtest.h>

#include <vector>

#include "common/estimation/measurement_model.h"
#include "processes/model_monitor/changes/body_change.h"
#include "tests/support/broken_arm.h"

namespace bodyschema {

using Form = BodyChange::Form;

inline Eigen::VectorXd vector(std::vector<double> values) {
  return Eigen::Map<Eigen::VectorXd>(values.data(), static_cast<Eigen::Index>(values.size()));
}

struct Case {
  BodyChange change;
  Eigen::VectorXd theta;
};

/// The engineered arm, and what is seen of a body like it.
class ChangedArm : public testing::Test {
 protected:
  static constexpr int kPart = 4;  // q3 moves the edge 3→4

  explicit ChangedArm(unsigned seed) : rng_(seed) {}

  const Edge& edge(const BodySchema& schema) const { return *edge_to(schema, kPart); }
  Eigen::VectorXd random_theta(const BodyChange& change) {
    Eigen::VectorXd theta(change.size());
    for (double& t : theta) t = 0.3 * test::gaussian(rng_);
    return theta;
  }
  /// One of every form that has parameters, but kRigid.
  std::vector<Case> cases() const {
    const Eigen::VectorXd bend = vector({0.05, -0.03, 0.02, 0.5, -0.4, 0.3});
    return {{{Form::kStuck, kPart}, vector({0.4})},
            {{Form::kOffset, kPart}, vector({0.35})},
            {{Form::kGain, kPart}, vector({-0.3, 0.0})},
            {{Form::kBent, kPart}, bend},
            {{Form::kBent, kPart, 1}, bend},
            {{Form::kBoth, kPart},
             vector({0.05, -0.03, 0.02, 0.5, -0.4, 0.3, -0.04, 0.02, 0.03, -0.3, 0.2, 0.6})},
            {{Form::kMarkerMoved, kPart}, bend},
            {{Form::kCamera, schema_.root}, bend}};
  }
  /// Of random actions, without outliers.
  std::vector<ActionPoseSample> observe(const BodySchema& body, int count,
                                        const Vector6d& sigma = nominal_sigma()) {
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < count; ++t) {
      ActionPoseSample& sample = samples.emplace_back();
      sample.sample_index = t;
      sample.action.resize(7);
      for (double& q : sample.action) q = test::uniform(rng_, -1.3, 1.3);
      for (const auto& [part, X_RB] : body.predict_all(sample.action)) {
        PartObservation& o = sample.parts.emplace_back();
        o.part = part;
        o.X_CB = body.X_CR * X_RB * exp(sigma.cwiseProduct(test::gaussian6(rng_)));
        o.covariance = sigma.cwiseAbs2().asDiagonal();
      }
    }
    return samples;
  }
  static std::vector<const ActionPoseSample*> pointers(
      const std::vector<ActionPoseSample>& samples) {
    std::vector<const ActionPoseSample*> result;
    for (const ActionPoseSample& s : samples) result.push_back(&s);
    return result;
  }
  /// 3 mm and 1°.
  static Vector6d nominal_sigma() {
    const Noise noise = test::nominal_noise(test::Regime::kTagIso);
    Vector6d sigma;
    sigma << Eigen::Vector3d::Constant(noise.position_m),
        Eigen::Vector3d::Constant(noise.rotation_rad);
    return sigma;
  }

  test::Rng rng_;
  MeasurementModel measurement_;
  BodySchema schema_ =
      test::BrokenArm({test::Fault::kNone, "", 1}, test::Regime::kTagIso, 1, 3).engineered();
};

}  // namespace bodyschema
