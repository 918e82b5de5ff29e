// adaptation_table REGIME NUM_SEEDS [verbose]: faults on a chain of seven markers, 4 x 100 samples.
#include <cstdio>
#include <cstring>
#include <ctime>
#include <iostream>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

SyntheticRobot chain(Rng& rng) {
  SyntheticRobot robot;
  robot.X_CR.linear() = random_rotation(rng);
  robot.X_CR.translation() << 0, 0, 2;
  robot.links.push_back({.part = 1});
  for (int e = 1; e <= 6; ++e) {
    TrueLink link;
    link.part = e + 1;
    link.parent = e;
    link.X_before = random_pose(rng, 0.06, 0.16);
    link.X_after = random_pose(rng, 0.06, 0.16);
    link.signal = e - 1;
    link.turn = 1;
    robot.links.push_back(link);
    robot.signals.push_back({"q" + std::to_string(e), -1.35, 1.35});
  }
  robot.signals.push_back({"q7", -1.35, 1.35});
  return robot;
}

BodySchema engineered(const SyntheticRobot& robot, Rng& rng) {
  BodySchema schema;
  schema.root = 1;
  schema.signals = robot.signals;
  schema.X_CR = robot.X_CR;
  const auto wobble = [&] {
    Vector6d xi = gaussian6(rng);
    xi.head<3>() *= 0.001;
    xi.tail<3>() *= 0.2 * M_PI / 180;
    return exp(xi);
  };
  Matrix6d cov = Matrix6d::Identity() * 1e-6;
  cov.diagonal().tail<3>().setConstant(std::pow(0.2 * M_PI / 180, 2));
  for (const TrueLink& link : robot.links) {
    schema.parts.push_back(link.part);
    if (link.parent < 0) continue;
    Edge edge;
    edge.from = link.parent;
    edge.to = link.part;
    edge.left = link.X_before;
    if (link.signal >= 0) {
      ScrewJoint j;
      j.signal = link.signal;
      j.turn = link.turn;
      j.slide = link.slide;
      j.offset = -link.zero;
      j.X_after = link.X_after * wobble();
      edge.joints.push_back(j);
      edge.parameter_covariance = Eigen::MatrixXd::Zero(14, 14);
      edge.parameter_covariance.block<6, 6>(8, 8) = cov;
    }
    schema.edges.push_back(edge);
  }
  schema.complete = true;
  return schema;
}

double ee_error(const BodySchema& schema, const SyntheticRobot& robot, const std::vector<Eigen::VectorXd>& q) {
  double sum = 0;
  for (const auto& a : q) {
    const auto X = robot.poses_in_camera(a);
    const auto p = schema.predict(1, 7, a);
    sum += (p->X_AB.translation() - (X.at(1).inverse() * X.at(7)).translation()).norm() / q.size();
  }
  return sum;
}

}  // namespace

int main(int argc, char** argv) {
  const std::string regime_name = argc > 1 ? argv[1] : "tag_iso";
  const int seeds = argc > 2 ? std::stoi(argv[2]) : 5;
  const std::string only = argc > 3 ? argv[3] : "";
  const double factor = argc > 4 ? std::stod(argv[4]) : 1;
  const bool verbose = argc > 5;
  const Regime regime = regime_name == "chapter" ? Regime::kChapter : Regime::kTagIso;
  const double limit = regime == Regime::kChapter ? 0.075 : 0.030;
  struct Scenario { const char* name; double visible; };
  for (const Scenario sc : {Scenario{"stuck", 0.919}, Scenario{"tool", 0.79}, Scenario{"bend", 0.85}, Scenario{"offset", 0.85},
                            Scenario{"gain", 0.85}, Scenario{"two", 0.85}, Scenario{"adjacent", 0.85}, Scenario{"marker", 0.85}, Scenario{"camera", 0.85}, Scenario{"drift", 0.85}, Scenario{"none", 0.85}}) {
    if (!only.empty() && only.find(sc.name) == std::string::npos) continue;
    double recovery[4] = {}, worst[4] = {};
    double seconds = 0, slowest = 0;
    int num_events = 0, num = 0;
    std::map<std::string, int> causes;
    for (int seed = 1; seed <= seeds; ++seed) {
      Rng rng(seed);
      const SyntheticRobot healthy = chain(rng);
      SyntheticRobot broken = healthy;
      const auto stick = [&](int part) {
        TrueLink& l = broken.links[part - 1];
        l.X_before = l.X_before * exp((Vector6d() << 0, 0, 0, 0, 0, uniform(rng, -0.8, 0.8)).finished());
        l.signal = -1;
      };
      const auto tool = [&](int part, double m, double deg) {
        TrueLink& l = broken.links[part - 1];
        Pose T = Pose::Identity();
        T.linear() = exp_so3(random_rotation(rng).col(0) * deg * M_PI / 180);
        T.translation() = random_rotation(rng).col(0) * m;
        l.X_after = l.X_after * T;
      };
      const std::string name = sc.name;
      if (name == "stuck") stick(5);
      if (name == "tool") tool(7, 0.25, 80);
      if (name == "bend") {
        TrueLink& l = broken.links[4];
        Pose T = Pose::Identity();
        T.linear() = exp_so3(random_rotation(rng).col(0) * 45 * M_PI / 180);
        T.translation() = random_rotation(rng).col(0) * 0.03;
        l.X_before = T * l.X_before;
      }
      if (name == "offset") broken.links[3].zero = 20 * M_PI / 180;
      if (name == "gain") broken.links[3].turn = 0.7;
      if (name == "two") { stick(3); tool(7, 0.25, 80); }
      if (name == "adjacent") { stick(5); tool(6, 0.1, 40); }
      if (name == "camera") {
        Vector6d t = gaussian6(rng);
        t.head<3>() *= 0.1 / t.head<3>().norm();
        t.tail<3>() *= 15 * M_PI / 180 / t.tail<3>().norm();
        broken.X_CR = exp(t) * broken.X_CR;
      }
      BodySchema start = engineered(healthy, rng);
      AdaptationOptions options;
      options.noise.noise = nominal_noise(regime);
      options.noise.noise->position_m *= factor;
      options.noise.noise->rotation_rad *= factor;
      options.noise.outlier_rate = 0.04;
      if (regime == Regime::kChapter) options.noise.outlier_rate = 0.013;
      Adaptation adaptation(start, options);
      std::vector<Eigen::VectorXd> q;
      for (int k = 0; k < 60; ++k) q.push_back(healthy.random_action(rng));
      const Pose moved = exp((Vector6d() << 0.05, 0, 0, 1, 0, 0).finished());
      int last_wrong[4] = {};
      const Eigen::Vector3d drift_axis = random_rotation(rng).col(0);
      double drift_early = 0, drift_late = 0;
      for (int t = 0; t < 400; ++t) {
        const bool fault = (t / 100) % 2 == 1;
        SyntheticRobot drifted;
        const bool drifts = name == "drift" && t >= 100;
        if (drifts) {
          drifted = healthy;
          Pose T = Pose::Identity();
          T.linear() = exp_so3(drift_axis * (0.05 * (t - 100) * M_PI / 180));
          drifted.links[3].X_before = healthy.links[3].X_before * T;
        }
        const SyntheticRobot& robot = drifts ? drifted : fault ? broken : healthy;
        ObservationOptions obs;
        obs.regime = regime;
        auto sample = observe(robot, robot.random_action(rng), obs, t, rng);
        std::erase_if(sample.parts, [&](const auto&) { return uniform(rng, 0, 1) > sc.visible; });
        if (name == "marker" && fault)
          for (auto& p : sample.parts)
            if (p.part == 3) p.X_CB = p.X_CB * moved;
        const std::clock_t c = std::clock();
        const auto events = adaptation.on_sample(sample);
        const double s = double(std::clock() - c) / CLOCKS_PER_SEC;
        seconds += s;
        slowest = std::max(slowest, s);
        ++num;
        for (const auto& e : events) {
          ++num_events;
          if (e.kind == AdaptationEvent::Kind::kRecovered) ++causes[std::to_string(std::max(e.to, e.part)) + e.cause];
          if (verbose)
            std::printf("    %s seed %d t %d: %s %d-%d part %d %s margin %.1f n %d err %.1f mm\n", sc.name, seed, t,
                        name_of(e.kind), e.from, e.to, e.part, e.cause.c_str(), e.margin, e.num_samples,
                        1e3 * ee_error(adaptation.schema(), robot, q));
        }
        if (drifts) {
          double& d = t < 250 ? drift_early : drift_late;
          d = std::max(d, ee_error(adaptation.schema(), robot, q));
        }
        if (ee_error(adaptation.schema(), robot, q) > limit) last_wrong[t / 100] = t % 100 + 1;
      }
      if (name == "drift") std::printf("    drift seed %d: largest error %.1f mm in the first 150 samples, %.1f mm later\n", seed, 1e3 * drift_early, 1e3 * drift_late);
      for (int b = 0; b < 4; ++b) {
        recovery[b] += double(last_wrong[b]) / seeds;
        worst[b] = std::max(worst[b], double(last_wrong[b]));
      }
    }
    std::printf("%-9s %s: healthy %.2f (%g), first %.2f (%g), repair %.2f (%g), second %.2f (%g); events %.1f a run; %.2f ms, slowest %.0f ms;",
                sc.name, regime_name.c_str(), recovery[0], worst[0], recovery[1], worst[1], recovery[2], worst[2], recovery[3], worst[3],
                double(num_events) / seeds, 1e3 * seconds / num, 1e3 * slowest);
    for (const auto& [cause, n] : causes) std::printf(" %s x%d", cause.c_str(), n);
    std::printf("\n");
    std::fflush(stdout);
  }
}
