#include "processes/refiner/elasticity.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "processes/refiner/held_out.h"
#include "processes/refiner/information.h"
#include "processes/refiner/refined_schema.h"

namespace bodyschema {
namespace {

/// The schema with a signal for each joint: that is where the joint stands.
BodySchema with_a_signal_a_joint(BodySchema schema) {
  schema.signals.clear();
  for (Edge& edge : schema.edges)
    for (ScrewJoint& joint : edge.joints) {
      joint.signal = static_cast<int>(schema.signals.size());
      joint.gain = 1;
      joint.offset = 0;
      schema.signals.emplace_back();
    }
  return schema;
}

/// The samples for it: joints that go where they are told, and give way.
std::vector<RefinerSample> loaded(const BodySchema& schema, std::vector<RefinerSample> samples,
                                  const JointLoads& loads, const Eigen::VectorXd& compliance) {
  for (RefinerSample& seen : samples) {
    const Eigen::VectorXd theta = schema.displacements(seen.sample.action);
    Eigen::VectorXd stands = loads(seen.sample.action).cwiseProduct(compliance);
    Eigen::Index n = 0;
    for (const Edge& edge : schema.edges)
      for (const ScrewJoint& joint : edge.joints) {
        stands(n) = joint.gain * (theta(joint.signal) + stands(n)) + joint.offset;
        ++n;
      }
    seen.sample.action = stands;
  }
  return samples;
}

std::vector<JointCompliance> compliances(const BodySchema& schema,
                                         const std::vector<RefinerSample>& samples,
                                         const JointLoads& loads, const RefinementProblem& problem,
                                         const Information& information, double num_residuals) {
  const ParameterBlock& block = *problem.drive();
  const Eigen::VectorXd sd =
      information.cross_covariance(&block, &block).diagonal().cwiseMax(0).cwiseSqrt();
  Eigen::VectorXd largest = loads(samples.front().sample.action).cwiseAbs();
  for (const RefinerSample& seen : samples)
    largest = largest.cwiseMax(loads(seen.sample.action).cwiseAbs());
  std::vector<JointCompliance> result;
  for (const Edge& edge : schema.edges)
    for (const ScrewJoint& joint : edge.joints) {
      const auto n = std::ssize(result);
      JointCompliance& compliance = result.emplace_back();
      compliance.joint = joint_name(schema, edge, joint);
      compliance.unit = joint.turn != 0 ? "rad/(N m)" : "m/N";
      compliance.value = block.values[n];
      compliance.sd = sd(n);
      if (sd(n) > 0)
        compliance.evidence =
            std::pow(compliance.value / sd(n), 2) / 2 - std::log(num_residuals) / 2;
      const double reach = std::abs(joint.gain * (joint.turn != 0 ? joint.turn : joint.slide));
      compliance.droop = reach * std::abs(compliance.value) * largest(n);
    }
  return result;
}

}  // namespace

std::string joint_name(const BodySchema& schema, const Edge& edge, const ScrewJoint& joint) {
  std::string thing = fmt::format("{}→{}", edge.from, edge.to);
  if (std::ranges::count(edge.joints, joint.signal, &ScrewJoint::signal) > 1)
    thing += fmt::format(", joint {}", &joint - edge.joints.data() + 1);
  return fmt::format("{} ({})", schema.signals.at(joint.signal).name, thing);
}

std::optional<Elasticity> fit_elasticity(const BodySchema& schema,
                                         const std::vector<RefinerSample>& training,
                                         const std::vector<RefinerSample>& held_out,
                                         const RefineOptions& options, RefinementProblem& stiff) {
  const std::optional<RigCalibration> no_rig;
  RefinementProblem problem(schema, training, no_rig, options, stiff.root_moves());
  const auto num_joints = options.joint_loads(training.front().sample.action).size();
  const ParameterBlock* drive = problem.drive();
  const auto num_free = drive ? std::count_if(drive->free.begin(), drive->free.end(),
                                              [&](int n) { return n < num_joints; })
                              : 0;
  if (num_free == 0) return std::nullopt;
  problem.solve();
  const double gain = problem.log_likelihood() - stiff.log_likelihood();
  const double num_residuals = problem.num_residuals();
  const Information information(problem, options.measurement);
  Elasticity result;
  result.evidence = gain - static_cast<double>(num_free) * std::log(num_residuals) / 2;
  result.schema = refined_schema(schema, training, problem, information);
  result.joints = compliances(result.schema, training, options.joint_loads, problem, information,
                              num_residuals);
  const auto errors_of = [&](const BodySchema& model, const Eigen::VectorXd& compliance,
                             double noise_scale) {
    const auto errors = [&](const std::vector<RefinerSample>& samples) {
      return held_out_errors(with_a_signal_a_joint(model),
                             loaded(model, samples, options.joint_loads, compliance), std::nullopt,
                             options.corner_noise)
          .parts;
    };
    return Elasticity::Errors{noise_scale, errors(training), errors(held_out)};
  };
  const Eigen::VectorXd found = Eigen::Map<const Eigen::VectorXd>(drive->values.data(), num_joints);
  result.stiff = errors_of(schema, Eigen::VectorXd::Zero(found.size()), stiff.scale());
  result.elastic = errors_of(result.schema, found, problem.scale());
  return result;
}

}  // namespace bodyschema
