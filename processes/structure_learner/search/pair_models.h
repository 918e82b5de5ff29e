#pragma once

#include <map>
#include <optional>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/search/model_forest.h"
#include "processes/structure_learner/validity.h"

namespace bodyschema {

/// Two signal sets of one size whose likelihoods differ by less [nats] are not told apart.
inline constexpr double kAmbiguityMargin = 3;

struct SearchOptions {
  MeasurementModel measurement;
  ValidityOptions validity;
  int max_signals = kMaxChainJoints;  ///< largest number of joints of one model
  /// Standard deviation of the bias that every marker may have beside measurement.systematic, at
  /// half range of a signal, in those of the noise of one sight.
  double unknown_bias = 0;
  /// Two parts between which no edge is looked for, the lower first.
  std::set<std::pair<int, int>> unconnectable = {};
};

/// Signals of two models of which the data do not tell which one it is.
struct ContestedSignals {
  std::set<int> of_screws;      ///< if the noise is larger than assumed
  std::vector<int> of_process;  ///< if it is not: with a Gaussian process beside the screws
};

/// A search's trials between two parts.
struct PairRecord {
  int num_common = 0;  ///< instants at which both were seen
  /// The models that were not refuted but that the data are too few to trust: mean of min(d², 2c)
  /// of the best, by k.
  std::map<int, double> undecided;
  bool has_far_outliers = false;  ///< of a model, see Validity
  bool moves_little = false;      ///< beside its noise: to tell joints from a Gaussian process
  bool was_soft_tried = false;    ///< a Gaussian process on the screws' rest was fitted too
  /// Signals whose joints are in an order that the poses do not tell: why a model was taken back.
  std::set<int> open_order = {};
  /// Signals that moved too little while both were seen to tell whether they move the one against
  /// the other: why a model was taken back.
  std::set<int> untold_signals = {};
  /// Each two signals that move alike, of which no pose tells which one moves the one part against
  /// the other: why a model was taken back.
  std::set<std::pair<int, int>> look_alikes = {};
  /// A valid model has a joint that its tree does not need: redundant_edges().
  bool is_redundant = false;
  /// A valid model was taken back: time-shifted commands explain the motion nearly as well, it is a
  /// Gaussian process on a stream too short for one, or has several joints where all signals follow
  /// one rhythm.
  bool is_by_chance = false, is_too_short = false, has_one_rhythm = false;
  std::optional<ContestedSignals> contested = {};

  void note_undecided(int num_signals, double mean_capped);
};

/// A valid model with what its pair's data say of it.
struct Candidate : AcceptedModel {
  int num_frames = 0;
  int num_outliers = 0;
  double mean_capped = 0;  ///< mean of min(d², 2c)
  bool doubtful = false;
  bool on_all_data = false;
  bool is_valid = true;  ///< on all data, once it was judged there
};

/// Fewer joints first, then the better score.
std::tuple<int, double> rank(const Candidate& candidate);

/// A model that its pair's own data refuted, at a cost that a true one may have.
struct NearMiss {
  int part_i = 0, part_j = 0;
  LocalModel model;
  double cost = 0;  ///< a frame
};

/// A search's knowledge of the parts and of each two of them: their data, made once, and what
/// became of the models that were tried on these. Hypotheses are judged on an even subset of the
/// instants.
class PairModels {
 public:
  /// Keeps references to `samples`, `actions` and `options`.
  PairModels(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
             const std::vector<int>& parts, const SearchOptions& options);

  const NormalizedActions& actions() const { return actions_; }
  const SearchOptions& options() const { return options_; }
  PairRecord& record(int part_a, int part_b) { return records_.at(std::minmax(part_a, part_b)); }
  std::map<std::pair<int, int>, PairRecord>& records() { return records_; }

  const PairData& pair(int part_i, int part_j);
  const RelativeMotions& motions(int part_i, int part_j);
  PairData part_data(int part) const;
  /// Of at most so many instants.
  PairData pair_data(int part_i, int part_j, int max_frames) const;
  /// Does the part keep its pose in the camera's frame?
  bool rests(int part);

  /// Fits and tests a start on the pair's subset of the data.
  std::optional<Candidate> try_start(int part_i, int part_j, const LocalModel& start);
  /// Cost a frame of the latest fit of try_start().
  double last_cost() const { return last_cost_; }
  /// Fits and tests a candidate on all data of its pair, once.
  bool confirm_on_all_data(Candidate* candidate);

  /// The pair is undecided between two models: because their signals move alike?
  void note_look_alikes(const Candidate& best, const Candidate& other);
  /// The first by rank(); std::nullopt if there is none, or if as many joints on other signals
  /// explain its pair as well, which is then undecided.
  std::optional<Candidate> only_best(const std::vector<Candidate>& candidates);

  /// All markers together spoke against this model.
  void refute(const AcceptedModel& m) { refuted_.insert(key(m.part_i, m.part_j, m.model)); }
  bool is_refuted(int part_i, int part_j, const LocalModel& model) const {
    return refuted_.contains(key(part_i, part_j, model));
  }
  /// The best one of each two parts and signal set, by joints and cost.
  std::vector<NearMiss> near_misses() const;

  int num_screens = 0;  ///< closed-form starts and regressions
  int num_fits = 0;     ///< Levenberg–Marquardt fits, of pairs and of whole trees

 private:
  using Key = std::tuple<int, int, std::multiset<int>>;  // the signals of the joints
  static Key key(int part_i, int part_j, const LocalModel& model) {
    return {part_i, part_j, signals_of_joints(model)};
  }

  const std::vector<ActionPoseSample>& samples_;
  const NormalizedActions& actions_;
  const SearchOptions& options_;
  int max_frames_ = 0;
  int max_motions_ = 0;
  std::map<std::pair<int, int>, PairRecord> records_;
  std::map<std::pair<int, int>, PairData> pairs_;
  std::map<std::pair<int, int>, RelativeMotions> motions_;
  std::map<int, bool> rests_;
  std::set<Key> refuted_;
  std::vector<NearMiss> near_misses_;
  double last_cost_ = 0;
};

}  // namespace bodyschema
