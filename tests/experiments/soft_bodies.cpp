// soft_bodies: soft arms of several sections that bend with three chambers or tendons each, and a recording split into
// blocks of time: structure, signals and error where nothing was learned. Prints a Markdown table.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <fstream>
#include <iostream>
#include <sstream>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/recording/recording.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

// Constant curvature (Webster and Jones 2010), with a pull of the outer sections' tendons on the inner ones.
struct SoftArm {
  int num_sections = 3, num_chambers = 3, num_idle = 0;
  double bend = 1.0;      // [rad] of a section at the largest difference of its chambers
  double stretch = 0.15;  // of a section's length
  double coupling = 0.0;  // share of an outer section's bend that its tendons bring to the one before

  int num_signals() const { return num_sections * num_chambers + num_idle; }
  Pose section(int n, const Eigen::VectorXd& q) const {
    Eigen::Vector2d k = Eigen::Vector2d::Zero();
    double mean = 0;
    for (int m = n; m < num_sections; ++m)
      for (int c = 0; c < num_chambers; ++c) {
        const double angle = 2 * M_PI * c / num_chambers + 0.4 * m;
        const double p = q(m * num_chambers + c) + 0.2 * q(m * num_chambers + c) * q(m * num_chambers + c);
        const double share = m == n ? 1 : m == n + 1 ? coupling : 0;
        k += share * bend * p * Eigen::Vector2d(std::cos(angle), std::sin(angle)) * 2 / num_chambers;
        if (m == n) mean += p / num_chambers;
      }
    Vector6d xi;
    xi << 0, 0, 0.12 * (1 + stretch * mean), -k(1), k(0), 0;
    return exp(xi);
  }
  std::vector<Pose> poses(const Eigen::VectorXd& q) const {
    std::vector<Pose> result{make_pose(Eigen::Quaterniond::Identity(), Eigen::Vector3d(0, 0, 1))};
    for (int n = 0; n < num_sections; ++n) result.push_back(result.back() * section(n, q));
    return result;
  }
};

std::vector<ActionPoseSample> record(const SoftArm& arm, int num, const Noise& noise, Rng& rng) {
  std::vector<ActionPoseSample> samples(num);
  for (int t = 0; t < num; ++t) {
    samples[t].sample_index = t;
    samples[t].utime = 2'000'000 * std::int64_t{t};
    samples[t].action.resize(arm.num_signals());
    for (double& q : samples[t].action) q = uniform(rng, -1, 1);
    int part = 0;
    for (const Pose& X : arm.poses(samples[t].action)) {
      Vector6d e = gaussian6(rng);
      e.head<3>() *= noise.position_m;
      e.tail<3>() *= noise.rotation_rad;
      PartObservation o;
      o.part = part++;
      o.X_CB = X * exp(e);
      samples[t].parts.push_back(o);
    }
  }
  return samples;
}

double median(std::vector<double> v) {
  if (v.empty()) return NAN;
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

std::string describe(const LearnResult& r) {
  std::string s = r.schema.complete ? "complete" : "incomplete";
  for (const Edge& e : r.schema.edges) {
    s += fmt::format(" {}-{} {}{{", e.from, e.to, e.kind());
    for (int x : e.signals()) s += fmt::format("{} ", x + 1);
    s += "}";
  }
  return s;
}

// medians of part from root, by parts
std::string errors(const BodySchema& schema, const std::vector<ActionPoseSample>& test, const std::vector<std::vector<Pose>>* truth) {
  std::map<int, std::vector<double>> p, r;
  for (std::size_t t = 0; t < test.size(); ++t)
    for (const auto& o : test[t].parts) {
      if (o.part == schema.root) continue;
      const auto* root = test[t].find(schema.root);
      if (!root) continue;
      const auto predicted = schema.predict(schema.root, o.part, test[t].action);
      if (!predicted) continue;
      Pose z = root->X_CB.inverse() * o.X_CB;
      if (truth) z = (*truth)[t][0].inverse() * (*truth)[t][o.part];
      const Vector6d e = log(predicted->X_AB.inverse() * z);
      p[o.part].push_back(e.head<3>().norm());
      r[o.part].push_back(e.tail<3>().norm());
    }
  std::string s;
  for (auto& [part, v] : p) s += fmt::format(" {:.2f}mm {:.2f}°", 1e3 * median(v), median(r[part]) / kDegree);
  return s;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app;
  std::string csv;
  std::vector<int> shifts{0, 1, 32, 64, 96}, poses{100, 200, 400};
  double coupling = 0, sp = 1, sr = 0.5;
  int tendons = 3, idle = 0, seeds = 2;
  bool told_only = false, untold_only = false;
  app.add_option("--csv", csv);
  app.add_option("--shifts", shifts);
  app.add_option("--poses", poses);
  app.add_option("--coupling", coupling);
  app.add_option("--tendons", tendons);
  app.add_option("--idle", idle);
  app.add_option("--seeds", seeds);
  app.add_option("--mm", sp);
  app.add_option("--deg", sr);
  app.add_flag("--told", told_only);
  app.add_flag("--untold", untold_only);
  CLI11_PARSE(app, argc, argv);
  std::setvbuf(stdout, nullptr, _IOLBF, 0);
  if (!csv.empty()) {
    std::ifstream in(csv);
    std::stringstream text;
    text << in.rdbuf();
    const Recording rec = parse_csv(text.str(), csv);
    for (int shift : shifts)
      for (int which : {0, 1}) {
        std::vector<ActionPoseSample> half[2];
        for (std::size_t t = 0; t < rec.samples.size(); ++t) half[((t + shift) / 128) % 2].push_back(rec.samples[t]);
        for (bool told : {true, false}) {
          if ((told_only && !told) || (untold_only && told)) continue;
          LearnOptions o;
          if (told) o.measurement.noise = Noise{0.003, 1.5 * kDegree};
          const std::clock_t c = std::clock();
          const auto r = learn(rec.signals, half[which], o);
          const double s = double(std::clock() - c) / CLOCKS_PER_SEC;
          fmt::print("shift {} {} {} : {} | {} | {:.1f} s noise {:.2f} mm {:.2f}°\n", shift, which, told ? "told" : "-", describe(r), errors(r.schema, half[1 - which], nullptr), s, 1e3 * r.schema.noise.position_m, r.schema.noise.rotation_rad / kDegree);
        }
      }
    return 0;
  }
  for (int n : poses)
    for (int seed = 0; seed < seeds; ++seed)
      for (bool told : {true, false}) {
        if ((told_only && !told) || (untold_only && told)) continue;
        Rng rng(77 + seed);
        SoftArm arm;
        arm.num_chambers = tendons;
        arm.coupling = coupling;
        arm.num_idle = idle;
        const Noise noise{1e-3 * sp, sr * kDegree};
        const auto train = record(arm, n, noise, rng);
        const auto test = record(arm, 300, noise, rng);
        std::vector<std::vector<Pose>> truth;
        for (const auto& s : test) truth.push_back(arm.poses(s.action));
        LearnOptions o;
        if (told) o.measurement.noise = noise;
        std::vector<Signal> signals;
        for (int s = 0; s < arm.num_signals(); ++s) signals.push_back({fmt::format("q{}", s + 1)});
        const std::clock_t c = std::clock();
        const auto r = learn(signals, train, o);
        const double secs = double(std::clock() - c) / CLOCKS_PER_SEC;
        fmt::print("N {} seed {} {} : {} | {} | {:.1f} s noise {:.2f} mm {:.2f}°\n", n, seed, told ? "told" : "-", describe(r), errors(r.schema, test, &truth), secs, 1e3 * r.schema.noise.position_m, r.schema.noise.rotation_rad / kDegree);
      }
}
