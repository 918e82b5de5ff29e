#include "processes/console/urdf_model.h"

#include <gmock/gmock.h>
#include <urdf_model/model.h>
#include <urdf_parser/urdf_parser.h>

#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <kdl/chainfksolverpos_recursive.hpp>
#include <kdl/tree.hpp>
#include <kdl/treefksolverpos_recursive.hpp>
#include <map>
#include <string>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "common/scene/mujoco.h"
#include "processes/console/engineered_model.h"
#include "processes/console/gravity_load.h"
#include "processes/console/pure_joints.h"
#include "tests/support/synthetic_robot.h"
#include "tests/support/temporary_folder.h"

namespace bodyschema {
namespace {

using test::Rng;
using testing::HasSubstr;

constexpr double kExact = 1e-9;
constexpr int kNumRobots = 20;
constexpr int kNumActions = 5;

/// Edges of 0 to 3 joints, each revolute, prismatic or, now and then, stuck; five signals for all
/// of them, in units of their own; the last part shows its position alone.
BodySchema random_schema(Rng& rng, int num_parts = 8) {
  BodySchema schema;
  schema.complete = true;
  schema.root = 3;
  for (int s = 0; s < 5; ++s) {
    const double unit = std::pow(10.0, s - 2);
    schema.signals.push_back({"q" + std::to_string(s), -unit * test::uniform(rng, 0, 2),
                              unit * test::uniform(rng, 0, 2)});
  }
  for (int n = 0; n < num_parts; ++n) {
    schema.parts.push_back(3 + 2 * n);
    if (n == 0) continue;
    std::vector<int> signals(rng() % 4);
    for (int& signal : signals) signal = static_cast<int>(rng() % 5);
    const int parent = schema.parts[rng() % std::min<std::size_t>(n, num_parts - 2)];
    Edge edge = test::random_edge(parent, schema.parts.back(), signals, rng);
    for (ScrewJoint& joint : edge.joints) {
      const double kind = test::uniform(rng, 0, 1);
      (kind < 0.6 ? joint.slide : joint.turn) = 0;
      joint.gain *= kind > 0.9 ? 0 : std::pow(10.0, 2 - joint.signal);
    }
    schema.edges.push_back(std::move(edge));
  }
  schema.position_parts = {schema.parts.back()};
  return schema;
}

class UrdfModelTest : public testing::Test {
 protected:
  void write(const UrdfModel& model) const {
    std::ofstream(urdf()) << model.urdf;
    std::ofstream(placement()) << model.placement;
  }
  std::filesystem::path urdf() const { return folder_ / "robot.urdf"; }
  std::filesystem::path placement() const { return folder_ / "placement.yaml"; }

  BodySchema engineered(const UrdfModel& model) const {
    write(model);
    return engineered_model(urdf(), placement());
  }

  test::TemporaryFolder folder_;
};

void expect_same(const BodySchema& a, const BodySchema& b, Rng& rng) {
  EXPECT_EQ(a.parts, b.parts);
  EXPECT_EQ(a.root, b.root);
  for (int n = 0; n < kNumActions; ++n) {
    const Eigen::VectorXd action = test::random_action(a.signals, rng);
    const std::map<int, Pose> A = a.predict_all(action), B = b.predict_all(action);
    ASSERT_EQ(A.size(), B.size());
    for (const auto& [part, X] : A)
      EXPECT_LT(log(X.inverse() * B.at(part)).norm(), kExact) << "part " << part;
  }
}

/// Joint positions at an action, as a program reads them out of the two files.
std::map<std::string, double> joint_positions(const urdf::ModelInterface& robot, const Yaml& yaml,
                                              const Eigen::VectorXd& action) {
  std::map<std::string, double> positions;
  Eigen::Index s = 0;
  for (const Yaml& signal : yaml.list("signals")) {
    if (signal.has("joint"))
      positions[signal.text("joint")] = signal.number("gain") * action(s) + signal.number("offset");
    ++s;
  }
  for (const auto& [name, joint] : robot.joints_) {
    if (joint->type == urdf::Joint::FIXED) continue;
    if (joint->mimic) {
      positions[name] =
          joint->mimic->multiplier * positions.at(joint->mimic->joint_name) + joint->mimic->offset;
    }
    if (joint->type == urdf::Joint::CONTINUOUS) continue;
    EXPECT_GT(positions.at(name), joint->limits->lower - kExact) << name;
    EXPECT_LT(positions.at(name), joint->limits->upper + kExact) << name;
  }
  return positions;
}

/// Joint positions follow from commands alike.
void expect_same_drives(const std::string& placement, const std::string& other) {
  const Yaml a = Yaml::parse(placement), b = Yaml::parse(other);
  const std::vector<Yaml> drives = a.list("signals"), others = b.list("signals");
  ASSERT_EQ(drives.size(), others.size());
  for (std::size_t s = 0; s < drives.size(); ++s) {
    ASSERT_EQ(drives[s].has("joint"), others[s].has("joint"));
    if (!drives[s].has("joint")) continue;
    const double gain = drives[s].number("gain");
    EXPECT_NEAR(others[s].number("gain"), gain, kExact * std::abs(gain));
    EXPECT_NEAR(others[s].number("offset"), drives[s].number("offset"), kExact);
  }
}

TEST_F(UrdfModelTest, EngineerMakesTheSchemaOfItAgain) {
  Rng rng(1);
  for (int n = 0; n < kNumRobots; ++n) {
    const BodySchema schema = random_schema(rng);
    const UrdfModel model = urdf_model(schema, false);
    const BodySchema again = engineered(model);
    EXPECT_TRUE(again.complete);
    expect_same(schema, again, rng);
    for (std::size_t s = 0; s < schema.signals.size(); ++s) {
      EXPECT_EQ(again.signals[s].name, schema.signals[s].name);
      EXPECT_EQ(again.signals[s].lower, schema.signals[s].lower);
      EXPECT_EQ(again.signals[s].upper, schema.signals[s].upper);
    }
    const UrdfModel twice = urdf_model(again, false);
    expect_same(schema, engineered(twice), rng);
    expect_same_drives(model.placement, twice.placement);
  }
}

TEST_F(UrdfModelTest, ScrewFramesDoNotMatter) {
  Rng rng(2);
  const BodySchema schema = random_schema(rng);
  BodySchema other = schema;
  for (Edge& edge : other.edges) {
    for (std::size_t d = 0; d < edge.joints.size(); ++d) {
      Vector6d along = Vector6d::Zero();
      along(2) = test::uniform(rng, -1, 1);
      along(5) = test::uniform(rng, -1, 1);
      Pose& before = d == 0 ? edge.left : edge.joints[d - 1].X_after;
      before = before * exp(along);
      edge.joints[d].X_after = exp(-along) * edge.joints[d].X_after;
    }
  }
  const auto a = urdf::parseURDF(urdf_model(schema, false).urdf);
  const auto b = urdf::parseURDF(urdf_model(other, false).urdf);
  ASSERT_EQ(a->joints_.size(), b->joints_.size());
  for (const auto& [name, joint] : a->joints_) {
    const auto& p = joint->parent_to_joint_origin_transform.position;
    const auto& q = b->getJoint(name)->parent_to_joint_origin_transform.position;
    EXPECT_LT(std::hypot(p.x - q.x, p.y - q.y, p.z - q.z), kExact) << name;
    const auto &v = joint->axis, &w = b->getJoint(name)->axis;
    EXPECT_LT(std::hypot(v.x - w.x, v.y - w.y, v.z - w.z), kExact) << name;
  }
}

TEST_F(UrdfModelTest, ARightAngleOfPitchIsExactToo) {
  Rng rng(3);
  BodySchema schema = random_schema(rng);
  for (Edge& edge : schema.edges) {
    edge.left.linear() = (Eigen::AngleAxisd(test::uniform(rng, -3, 3), Eigen::Vector3d::UnitZ()) *
                          Eigen::AngleAxisd(M_PI / 2, Eigen::Vector3d::UnitY()))
                             .toRotationMatrix();
    edge.joints.clear();
    edge.right = Pose::Identity();
    edge.parameter_covariance.resize(0, 0);
  }
  expect_same(schema, engineered(urdf_model(schema, false)), rng);
}

TEST_F(UrdfModelTest, CheckUrdfAcceptsIt) {
  Rng rng(4);
  write(urdf_model(random_schema(rng), false));
  const std::string command = CHECK_URDF " '" + urdf().string() + "' > /dev/null";
  EXPECT_EQ(std::system(command.c_str()), 0);
}

/// The model as kdl_parser makes it.
KDL::Frame to_kdl(const urdf::Pose& X) {
  return {KDL::Rotation::Quaternion(X.rotation.x, X.rotation.y, X.rotation.z, X.rotation.w),
          {X.position.x, X.position.y, X.position.z}};
}

void add_children(const urdf::ModelInterface& robot, const std::string& parent, KDL::Tree* tree) {
  for (const auto& joint : robot.getLink(parent)->child_joints) {
    const KDL::Frame X = to_kdl(joint->parent_to_joint_origin_transform);
    const KDL::Vector axis(joint->axis.x, joint->axis.y, joint->axis.z);
    const bool slides = joint->type == urdf::Joint::PRISMATIC;
    const KDL::Joint moving(joint->name, X.p, X.M * axis,
                            slides ? KDL::Joint::TransAxis : KDL::Joint::RotAxis);
    const KDL::Joint fixed(joint->name, KDL::Joint::None);
    const bool is_fixed = joint->type == urdf::Joint::FIXED;
    tree->addSegment(KDL::Segment(joint->child_link_name, is_fixed ? fixed : moving, X), parent);
    add_children(robot, joint->child_link_name, tree);
  }
}

TEST_F(UrdfModelTest, KdlAgrees) {
  Rng rng(5);
  for (int n = 0; n < kNumRobots; ++n) {
    const BodySchema schema = random_schema(rng);
    write(urdf_model(schema, false));
    const auto robot = urdf::parseURDFFile(urdf());
    const Yaml yaml = Yaml::load(placement());
    const std::string root = "part_" + std::to_string(schema.root);
    KDL::Tree tree(root);
    add_children(*robot, root, &tree);
    KDL::TreeFkSolverPos_recursive kinematics(tree);
    const Eigen::VectorXd action = test::random_action(schema.signals, rng);
    KDL::JntArray q(tree.getNrOfJoints());
    for (const auto& [name, position] : joint_positions(*robot, yaml, action))
      q(tree.getSegment(robot->getJoint(name)->child_link_name)->second.q_nr) = position;
    for (const auto& [part, X_RB] : schema.predict_all(action)) {
      KDL::Frame X;
      ASSERT_GE(kinematics.JntToCart(q, X, "part_" + std::to_string(part)), 0);
      double x, y, z, w;
      X.M.GetQuaternion(x, y, z, w);
      const Pose X_kdl = make_pose({w, x, y, z}, {X.p.x(), X.p.y(), X.p.z()});
      EXPECT_LT(log(X_RB.inverse() * X_kdl).norm(), kExact) << "part " << part;
    }
  }
}

MjModelPtr load_mujoco(const std::filesystem::path& file) {
  std::array<char, 1000> error{};
  MjModelPtr model(mj_loadXML(file.c_str(), nullptr, error.data(), error.size()));
  EXPECT_TRUE(model) << error.data();
  return model;
}

TEST_F(UrdfModelTest, MuJoCoAgrees) {
  install_mujoco_handlers();
  Rng rng(6);
  for (int n = 0; n < kNumRobots; ++n) {
    const BodySchema schema = random_schema(rng);
    UrdfModel files = urdf_model(schema, false);
    write(files);
    ASSERT_TRUE(load_mujoco(urdf()));
    // Else it merges fixed links with those that carry them.
    files.urdf.insert(files.urdf.find("<link"),
                      "<mujoco><compiler fusestatic=\"false\"/></mujoco>");
    write(files);
    const MjModelPtr model = load_mujoco(urdf());
    ASSERT_TRUE(model);
    const MjDataPtr data(mj_makeData(model.get()));
    const auto robot = urdf::parseURDFFile(urdf());
    const Eigen::VectorXd action = test::random_action(schema.signals, rng);
    for (const auto& [name, position] : joint_positions(*robot, Yaml::load(placement()), action)) {
      const int joint = mj_name2id(model.get(), mjOBJ_JOINT, name.c_str());
      ASSERT_GE(joint, 0) << name;
      data->qpos[model->jnt_qposadr[joint]] = position;
    }
    mj_kinematics(model.get(), data.get());
    for (const auto& [part, X_RB] : schema.predict_all(action)) {
      if (part == schema.root) continue;  // the world
      const int body =
          mj_name2id(model.get(), mjOBJ_BODY, ("part_" + std::to_string(part)).c_str());
      ASSERT_GE(body, 0) << part;
      const double* q = data->xquat + 4 * body;
      const Pose X = make_pose({q[0], q[1], q[2], q[3]},
                               Eigen::Map<const Eigen::Vector3d>(data->xpos + 3 * body));
      EXPECT_LT(log(X_RB.inverse() * X).norm(), kExact) << "part " << part;
    }
  }
}

TEST_F(UrdfModelTest, MuJoCoAgreesOnWhatGravityDoes) {
  install_mujoco_handlers();
  Rng rng(7);
  for (int n = 0; n < kNumRobots; ++n) {
    const BodySchema schema = random_schema(rng);
    UrdfModel files = urdf_model(schema, false);
    const std::string kMass = "<mass value=\"";
    for (auto at = files.urdf.find(kMass); at != std::string::npos;
         at = files.urdf.find(kMass, at + 1)) {
      const Eigen::Vector3d centre = test::random_vector(rng, 0, 0.3);
      const std::string origin = "<origin xyz=\"" + std::to_string(centre.x()) + " " +
                                 std::to_string(centre.y()) + " " + std::to_string(centre.z()) +
                                 "\"/>";
      files.urdf.insert(at, origin);
      at += origin.size() + kMass.size();
      files.urdf.replace(at, files.urdf.find('"', at) - at,
                         std::to_string(test::uniform(rng, 1, 9)));
    }
    std::vector<std::string> joints;
    write(files);
    const BodySchema engineered = engineered_model(urdf(), placement(), &joints);
    const MjModelPtr model = load_mujoco(urdf());
    ASSERT_TRUE(model);
    Eigen::Map<Eigen::Vector3d>(model->opt.gravity) << 0, 0, -9.80665;
    const MjDataPtr data(mj_makeData(model.get()));
    const auto robot = urdf::parseURDFFile(urdf());
    const Eigen::VectorXd action = test::random_action(schema.signals, rng);
    for (const auto& [name, position] : joint_positions(*robot, Yaml::load(placement()), action))
      data->qpos[model->jnt_qposadr[mj_name2id(model.get(), mjOBJ_JOINT, name.c_str())]] = position;
    mj_forward(model.get(), data.get());
    const Eigen::VectorXd loads = GravityLoad(urdf(), placement(), joints)(action);
    std::size_t at = 0;
    for (const Edge& edge : engineered.edges)
      for (const ScrewJoint& joint : edge.joints) {
        const int id = mj_name2id(model.get(), mjOBJ_JOINT, joints.at(at).c_str());
        const double expected =
            -data->qfrc_bias[model->jnt_dofadr[id]] / (joint.slide + joint.turn);
        EXPECT_NEAR(loads(static_cast<Eigen::Index>(at)), expected, 1e-9 * (1 + std::abs(expected)))
            << joints[at];
        ++at;
      }
    EXPECT_EQ(loads.size(), std::ssize(joints));
    EXPECT_EQ(at, joints.size());
  }
}

/// Part 1 carries part 2 by one joint of signal "q".
BodySchema one_joint(double slide, double turn) {
  BodySchema schema;
  schema.complete = true;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.signals = {{"q", -1, 2}};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.joints.push_back({.slide = slide, .turn = turn});
  edge.joints.front().X_after.translation() << 0.3, 0, 0.1;
  edge.parameter_covariance = 1e-6 * Eigen::MatrixXd::Identity(14, 14);
  schema.edges = {edge};
  return schema;
}

void expect_refusal(const BodySchema& schema, const std::string& why) {
  try {
    urdf_model(schema, false);
    FAIL() << "no error, expected: " << why;
  } catch (const std::invalid_argument& error) {
    EXPECT_THAT(error.what(), HasSubstr(why));
  }
}

TEST_F(UrdfModelTest, AFixedJointAMimicAndDeviationsAreToldByNameAndComment) {
  BodySchema schema = one_joint(0, -0.8);
  schema.signals.front().name = "hip & <knee> -- \"1\"";
  schema.signals.push_back({"idle", 0, 1});
  schema.undecided_signals = {1};
  Edge edge = schema.edges.front();
  edge.from = 2;
  edge.to = 5;
  edge.joints.push_back(edge.joints.front());
  edge.joints[1].gain = 0;
  edge.joints[0].order_group = edge.joints[1].order_group = 0;
  edge.parameter_covariance.resize(0, 0);
  schema.edges.push_back(edge);
  schema.parts.push_back(5);
  schema.position_parts = {5};
  const UrdfModel model = urdf_model(schema, false);
  EXPECT_EQ(model.urdf, urdf_model(schema, false).urdf);
  const auto robot = urdf::parseURDF(model.urdf);
  ASSERT_TRUE(robot);
  const std::string name = schema.signals.front().name;
  ASSERT_TRUE(robot->getJoint(name));
  EXPECT_NEAR(robot->getJoint(name)->limits->lower, -1.6, 1e-12);
  ASSERT_TRUE(robot->getJoint(name + "_2"));
  EXPECT_EQ(robot->getJoint(name + "_2")->mimic->joint_name, name);
  EXPECT_EQ(robot->getJoint(name + "_stuck")->type, urdf::Joint::FIXED);
  EXPECT_THAT(model.urdf, HasSubstr("axis ± 1 mm, axis ± 0.057 deg"));
  EXPECT_THAT(model.urdf, HasSubstr("stuck at"));
  EXPECT_THAT(model.remarks, testing::Contains(HasSubstr("part 5: its position alone is known")));
  EXPECT_THAT(model.remarks, testing::Contains(HasSubstr("2→5: the samples leave the order of")));
  EXPECT_THAT(model.remarks, testing::Contains("idle: moves nothing, as far as the samples tell"));
  Rng rng(7);
  expect_same(schema, engineered(model), rng);
}

TEST_F(UrdfModelTest, WithoutARangeATurningJointIsContinuous) {
  BodySchema schema = one_joint(0, 1);
  schema.signals.front().lower = schema.signals.front().upper = 0.5;
  const UrdfModel model = urdf_model(schema, false);
  EXPECT_EQ(urdf::parseURDF(model.urdf)->getJoint("q")->type, urdf::Joint::CONTINUOUS);
  Rng rng(8);
  expect_same(schema, engineered(model), rng);
}

TEST_F(UrdfModelTest, AnIncompleteSchemaIsRefused) {
  BodySchema schema = one_joint(0, 1);
  schema.complete = false;
  expect_refusal(schema, "incomplete: its edges do not span its parts");
  schema.unconnected = {{7, Unconnected::kNotEnoughData, "4 of 12 samples"}};
  expect_refusal(schema, "incomplete: part 7: 4 of 12 samples");
}

TEST_F(UrdfModelTest, WhatASlideLeavesWithinThreeDeviationsIsLeftOutAndTold) {
  const UrdfModel model = urdf_model(one_joint(2.9e-3, 1), false);
  EXPECT_THAT(
      model.remarks,
      testing::ElementsAre("1→2 q: slides 2.9 ± 1 mm per unit, 8.7 over the range; left out"));
  expect_refusal(one_joint(3.1e-3, 1), "1→2 q: helical, slides 3.1 ± 1 mm per unit");
}

}  // namespace
}  // namespace bodyschema
