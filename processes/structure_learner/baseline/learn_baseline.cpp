#include "processes/structure_learner/baseline/learn_baseline.h"

#include <algorithm>
#include <cmath>
#include <ctime>
#include <limits>
#include <memory>
#include <numeric>
#include <stdexcept>

#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "processes/structure_learner/learned_schema.h"
#include "processes/structure_learner/pair_data.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {
namespace {

// With two samples each is predicted by the other alone, whatever the signals.
constexpr int kMinSamples = 3;

struct Candidate {
  int i = 0, j = 0;  // parts, i < j
  std::vector<int> signals;
  double log_likelihood = 0;  // s(M)
};

// Instants at which both parts were seen, evenly thinned.
struct PairSamples {
  Eigen::MatrixXd actions;  // m×N
  std::vector<Pose> poses;  // z_ij
};

PairSamples pair_samples(const std::vector<ActionPoseSample>& samples, int from, int to,
                         int num_signals, int max_samples) {
  std::vector<const ActionPoseSample*> common;
  for (const ActionPoseSample& sample : samples)
    if (sample.find(from) && sample.find(to)) common.push_back(&sample);
  const std::size_t N = std::min<std::size_t>(common.size(), max_samples);
  PairSamples pair;
  pair.actions.resize(num_signals, static_cast<Eigen::Index>(N));
  for (std::size_t t = 0; t < N; ++t) {
    const ActionPoseSample& sample = *common[t * common.size() / N];
    pair.actions.col(static_cast<Eigen::Index>(t)) = sample.action;
    pair.poses.push_back(sample.find(from)->X_CB.inverse() * sample.find(to)->X_CB);
  }
  return pair;
}

MatrixGp fit(const PairSamples& pair, const std::vector<int>& signals) {
  return fit_matrix_gp(signals, pair.actions(signals, Eigen::all), pair.poses);
}

// All subsets of `items` with k elements, in lexicographic order.
std::vector<std::vector<int>> subsets(const std::vector<int>& items, int k) {
  std::vector<std::vector<int>> result;
  std::vector<bool> is_in(items.size(), false);
  if (k > static_cast<int>(items.size())) return result;
  std::fill(is_in.begin(), is_in.begin() + k, true);
  do {
    std::vector<int>& subset = result.emplace_back();
    for (std::size_t n = 0; n < items.size(); ++n)
      if (is_in[n]) subset.push_back(items[n]);
  } while (std::prev_permutation(is_in.begin(), is_in.end()));
  return result;
}

// Kruskal over models in the order of their quality.
std::vector<Candidate> spanning_forest(const std::vector<Candidate>& valid,
                                       const std::vector<int>& parts) {
  std::vector<ModelScore> scores;
  for (const Candidate& c : valid)
    scores.push_back({static_cast<int>(c.signals.size()), c.log_likelihood});
  const std::vector<double> quality = model_qualities(scores);
  std::vector<std::size_t> order(valid.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::stable_sort(order.begin(), order.end(),
                   [&](std::size_t x, std::size_t y) { return quality[x] > quality[y]; });
  Components components(parts);
  std::vector<Candidate> forest;
  for (const std::size_t n : order)
    if (components.join(valid[n].i, valid[n].j)) forest.push_back(valid[n]);
  return forest;
}

class BaselineSearch {
 public:
  BaselineSearch(const std::vector<Signal>& signals, const std::vector<ActionPoseSample>& samples,
                 const BaselineOptions& options)
      : num_signals_(static_cast<int>(signals.size())),
        samples_(samples),
        options_(options),
        moving_(NormalizedActions(samples, num_signals_).moving()) {
    result_.schema = start_schema(signals, samples, options.root);
  }

  BaselineResult run() {
    const std::clock_t start = std::clock();
    BodySchema& schema = result_.schema;
    // Per axis and marker, as the schema says it.
    schema.noise = {options_.sigma_position_m / std::sqrt(6),
                    options_.sigma_rotation_rad / std::sqrt(6)};

    const std::vector<Candidate> forest = search();
    std::vector<std::pair<int, int>> ends;
    for (const Candidate& c : forest) ends.emplace_back(c.i, c.j);
    visit_outwards(ends, schema, [&](int edge, int from, int to) {
      schema.edges.push_back(make_edge(from, to, forest[static_cast<std::size_t>(edge)].signals));
      return true;
    });
    schema.set_covered(samples_);
    report_unconnected(
        options_.expected_parts, [&](int part) { return explain(part); }, &schema);
    estimate_root_pose();
    result_.seconds = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    return std::move(result_);
  }

 private:
  // Algorithm 1.
  std::vector<Candidate> search() {
    const std::vector<int>& parts = result_.schema.parts;
    std::vector<Candidate> valid, forest;
    for (int k = 0; k <= options_.max_signals; ++k) {
      for (const int i : parts) {
        for (const int j : parts) {
          if (j <= i) continue;
          const PairSamples pair = pair_samples(samples_, i, j, num_signals_, options_.max_samples);
          if (static_cast<int>(pair.poses.size()) < kMinSamples) continue;
          for (const std::vector<int>& signals : subsets(moving_, k)) {
            ++result_.num_fits;
            const std::optional<double> s =
                log_likelihood_if_valid(fit(pair, signals).leave_one_out().residual);
            if (s) valid.push_back({i, j, signals, *s});
          }
        }
      }
      forest = spanning_forest(valid, parts);
      if (options_.stop_at_first_tree && forest.size() + 1 >= parts.size()) break;
    }
    result_.num_valid = static_cast<int>(valid.size());
    return forest;
  }

  // s(M), eq. (10) with the 6-D residual and Σ_z.
  std::optional<double> log_likelihood_if_valid(const std::vector<Vector6d>& residuals) const {
    // σ_z is that of a length: a third of its square for each axis.
    const double position_variance = std::pow(options_.sigma_position_m, 2) / 3;
    const double rotation_variance = std::pow(options_.sigma_rotation_rad, 2) / 3;
    double position = 0, rotation = 0, squared = 0;
    for (const Vector6d& r : residuals) {
      position += r.head<3>().norm();
      rotation += r.tail<3>().norm();
      squared += r.head<3>().squaredNorm() / position_variance +
                 r.tail<3>().squaredNorm() / rotation_variance;
    }
    const auto N = static_cast<double>(residuals.size());
    if (!(position / N < 3 * options_.sigma_position_m) ||
        !(rotation / N < 3 * options_.sigma_rotation_rad))
      return std::nullopt;
    return -0.5 * (squared / N + 6 * std::log(2 * M_PI) +
                   3 * std::log(position_variance * rotation_variance));
  }

  Edge make_edge(int from, int to, const std::vector<int>& signals) {
    const PairSamples pair = pair_samples(samples_, from, to, num_signals_, options_.max_samples);
    auto model = std::make_shared<const MatrixGp>(fit(pair, signals));
    Edge edge;
    edge.from = from;
    edge.to = to;
    edge.num_samples = model->num_samples();
    const Matrix6d covariance = empirical_covariance(model->leave_one_out().residual);
    edge.position_rms_m = std::sqrt(covariance.topLeftCorner<3, 3>().trace());
    edge.rotation_rms_rad = std::sqrt(covariance.bottomRightCorner<3, 3>().trace());
    edge.matrix_gp = std::move(model);
    return edge;
  }

  // Why a part that was seen is not connected to the root.
  UnconnectedPart explain(int part) const {
    int common = 0;
    for (const int other : connected_to_root(result_.schema))
      common = std::max(common, count_common(samples_, part, other));
    const std::string detail = "seen " + std::to_string(count_common(samples_, part, part)) +
                               " times, at most " + std::to_string(common) +
                               " of them together with one connected part";
    if (common < kMinSamples) return {part, Unconnected::kNotEnoughData, detail};
    return {part, Unconnected::kNoValidModel,
            detail + "; no model with up to " + std::to_string(options_.max_signals) +
                " signals is valid to any connected part"};
  }

  // As that of a rigid connection between camera and root.
  void estimate_root_pose() {
    std::vector<Pose> seen, X_CR;
    for (const ActionPoseSample& sample : samples_)
      if (const PartObservation* o = sample.find(result_.schema.root)) seen.push_back(o->X_CB);
    if (seen.empty()) return;
    result_.schema.X_CR = seen.front();
    const std::size_t N = std::min<std::size_t>(seen.size(), options_.max_samples);
    if (N < 2) return;
    for (std::size_t t = 0; t < N; ++t) X_CR.push_back(seen[t * seen.size() / N]);
    const MatrixGp mean = fit_matrix_gp({}, Eigen::MatrixXd(0, X_CR.size()), X_CR);
    result_.schema.X_CR = mean.predict({});
    result_.schema.X_CR_covariance = mean.prediction_covariance({});
  }

  const int num_signals_;
  const std::vector<ActionPoseSample>& samples_;
  const BaselineOptions& options_;
  const std::vector<int> moving_;  // a signal that is constant explains nothing
  BaselineResult result_;
};

}  // namespace

std::vector<double> model_qualities(const std::vector<ModelScore>& valid) {
  double least = std::numeric_limits<double>::infinity(), largest = -least;
  for (const ModelScore& m : valid) {
    least = std::min(least, m.log_likelihood);
    largest = std::max(largest, m.log_likelihood);
  }
  std::vector<double> result;
  for (const ModelScore& m : valid)
    result.push_back(m.log_likelihood - m.num_signals * (1 + largest - least));
  return result;
}

void BaselineOptions::set_noise(const Noise& marker_noise) {
  sigma_position_m = std::sqrt(6) * marker_noise.position_m;
  sigma_rotation_rad = std::sqrt(6) * marker_noise.rotation_rad;
}

BaselineResult learn_baseline(const std::vector<Signal>& signals,
                              const std::vector<ActionPoseSample>& samples,
                              const BaselineOptions& options) {
  if (options.max_signals < 0) throw std::invalid_argument("max_signals must not be below 0");
  if (options.max_samples < kMinSamples)
    throw std::invalid_argument("max_samples must be at least " + std::to_string(kMinSamples));
  if (!(options.sigma_position_m > 0) || !(options.sigma_rotation_rad > 0))
    throw std::invalid_argument("the standard deviations of a relative pose must be above 0");
  return BaselineSearch(signals, samples, options).run();
}

}  // namespace bodyschema
