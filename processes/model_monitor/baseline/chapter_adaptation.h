#pragma once

#include <deque>
#include <functional>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/model_monitor/adaptation.h"

namespace bodyschema {

struct ChapterAdaptationOptions {
  /// Standard deviations of a relative pose: length of the position's error, angle of the
  /// rotation's. These are the chapter's, for its cameras.
  double sigma_position_m = 0.050;
  double sigma_rotation_rad = 0.26179938779914943654;  // 15°
  int window = 15;    ///< newest observations of both parts on which a model is tested
  int wait = 15;      ///< samples without a valid tree before a new model is sampled
  int training = 30;  ///< samples that a new model learns from, from its sampling on
  int max_signals = 2;
};

/// Keeps a body schema true as the chapter does (Section 4, with the settings of 5.2 and 5.3), for
/// comparison: what Adaptation is measured against.
///
/// A model is valid while the root mean squares of its position and rotation errors over the newest
/// `window` observations are within 3 σ_z. For every edge the valid model with the smallest error
/// serves, old ones as well as new ones: the history comes first by itself. Once there has been no
/// valid spanning tree for `wait` consecutive samples, each edge without a valid model samples a
/// new one as soon as its newest is refuted: those with fewer signals first, among these by
/// structural proximity to the model they replace.
///
/// Chosen so that the chapter's Table 1 comes out: the windows hold samples from before a model was
/// sampled, and those that it learned from; the count of samples without a tree goes on while
/// models are being tried; errors are root mean squares.
class ChapterAdaptation {
 public:
  /// Learns a local model of Δ_from,to on the signals (indices) from samples in which both parts
  /// were seen; it is called with two of them at least.
  using LearnEdge = std::function<Edge(int from, int to, const std::vector<int>& signals,
                                       const std::vector<const ActionPoseSample*>& samples)>;

  ChapterAdaptation(BodySchema schema, ChapterAdaptationOptions options, LearnEdge learn_edge);

  /// Edges that lost their valid model (kMismatch) or have another one: one that was sampled
  /// (kCandidate) or that was there before (kRestored). The chapter knows neither causes nor
  /// evidence.
  /// @throws std::invalid_argument if the action does not have one value per signal.
  std::vector<AdaptationEvent> on_sample(const ActionPoseSample& sample);
  /// The best valid model of every edge; where none is, the last that was, of confidence 0.
  const BodySchema& schema() const { return schema_; }
  bool has_valid_tree() const;
  /// Models sampled so far.
  int num_sampled() const { return num_sampled_; }
  /// Models kept, over all edges.
  std::size_t num_models() const;

 private:
  struct Model {
    Edge edge;
    std::vector<int> signals;
    bool is_learning = false;
    bool has_served = false;
    int num_offered = 0;  ///< samples since it was sampled
    std::deque<ActionPoseSample> training;
    struct Residual {
      double position_m = 0, rotation_rad = 0;
    };
    std::deque<Residual> residuals;  ///< of the newest samples of the window
    double error = 0;  ///< the larger of the two root mean squares, in units of 3 σ_z
    bool is_tested = false;
  };
  /// All there is for one pair of neighbours.
  struct Pair {
    std::vector<Model> models;                 ///< the first is the one that was there at the start
    std::vector<std::vector<int>> candidates;  ///< signal sets in the order of the search
    std::size_t next_candidate = 0;
    std::size_t serving = 0;
    std::deque<ActionPoseSample> window;
    bool is_valid = true;
  };

  /// A new model, in place of the oldest that never served where there are too many.
  void add_model(Pair* pair);
  void learn(Model* model, const ActionPoseSample& sample) const;
  void test(Model* model, const std::deque<ActionPoseSample>& window) const;

  const ChapterAdaptationOptions options_;
  const LearnEdge learn_edge_;
  BodySchema schema_;
  std::vector<Pair> pairs_;  ///< by edge
  int num_without_tree_ = 0;
  int num_sampled_ = 0;
};

}  // namespace bodyschema
