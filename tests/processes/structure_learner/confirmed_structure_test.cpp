#include "processes/structure_learner/confirmed_structure.h"

#include <gtest/gtest.h>

#include <map>
#include <vector>

#include "common/geometry/angle.h"
#include "tests/support/imperfect_robot.h"

namespace bodyschema {
namespace {

// Parts 1 and 2, an edge with these signals, and what it leaves of the variance assumed.
LearnedStructure structure(const std::vector<int>& signals, double residual_scale) {
  LearnedStructure result{
      .parts = {1, 2}, .actions = NormalizedActions({}, 0), .noise_source = NoiseSource::kGiven};
  AcceptedModel edge{.part_i = 1, .part_j = 2};
  for (const int s : signals) edge.model.joints.push_back({.signal = s});
  result.search.models = {edge};
  result.search.residual_scale = residual_scale;
  return result;
}

LearnedStructure nothing() {
  LearnedStructure result = structure({}, 1);
  result.parts = {1, 2, 3};
  return result;
}

struct Found {
  int num_searches = 0;
  bool is_soft = false;  ///< Gaussian processes were tried
  LearnedStructure structure = {.actions = NormalizedActions({}, 0)};
};

/// `process`: of these signals, connects parts 1 and 2; without signals none does. `with_bends`:
/// what is found where it is known which commands are bent.
Found confirmed(const std::map<double, LearnedStructure>& by_factor,
                const std::vector<int>& process = {},
                const std::map<double, LearnedStructure>& with_bends = {}) {
  Found found;
  const auto find = [&](const StructureQuery& query) {
    ++found.num_searches;
    EXPECT_EQ(query.unknown_bias > 0, query.factor > 1);
    return (query.bent.empty() ? by_factor : with_bends).at(query.factor);
  };
  found.structure = confirmed_structure(find, [&](LearnedStructure* open) {
    found.is_soft = true;
    if (process.empty()) return;
    open->parts = {1, 2};
    open->search.models = {{.part_i = 1, .part_j = 2, .soft_signals = process}};
  });
  return found;
}

std::vector<int> signals_of(const LearnedStructure& found) {
  std::vector<int> result;
  for (const AcceptedModel& edge : found.search.models)
    for (int d = 0; d < edge.model.num_joints(); ++d)
      result.push_back(edge.model.joints[static_cast<std::size_t>(d)].signal);
  return result;
}

// Parts 1 and 2, fixed to each other, and part 3, which a joint hangs on `parent`.
LearnedStructure third_on(int parent) {
  LearnedStructure result = structure({}, 0.9);
  result.parts = {1, 2, 3};
  AcceptedModel edge{.part_i = parent, .part_j = 3};
  edge.model.joints.push_back({.signal = 0});
  result.search.models.push_back(edge);
  return result;
}

TEST(ConfirmedStructureTest, ToldNoiseThatResidualsDoNotRefuteStandsAfterOneSearch) {
  const Found found = confirmed({{1, structure({0}, 0.95)}});
  EXPECT_EQ(found.num_searches, 1);
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
}

TEST(ConfirmedStructureTest, WhereNothingSpansTheNoiseGrowsUntilTwoStructuresAreTheSame) {
  const Found found = confirmed({{1, nothing()},
                                 {2, structure({0, 0}, 1.5)},
                                 {4, structure({0}, 1)},
                                 {8, structure({0}, 0.5)}});
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
  EXPECT_EQ(found.structure.search.residual_scale, 1);
  EXPECT_FALSE(found.is_soft);
  EXPECT_EQ(found.structure.noise_source, NoiseSource::kResiduals);
  EXPECT_FALSE(found.structure.is_contested);
}

TEST(ConfirmedStructureTest, JointsThatTheOthersMakeNeedlessAreTakenBackIfMoreNoiseDoesNot) {
  LearnedStructure needless = structure({0, 1}, 0.95);
  needless.search.redundant = {{1, 2}};
  Found found = confirmed({{1, needless}, {2, needless}, {4, needless}, {8, needless}});
  EXPECT_TRUE(found.structure.search.models.empty());
  LearnedStructure other_order = structure({1, 0, 1}, 0.9);
  other_order.search.redundant = {{1, 2}};
  found = confirmed({{1, other_order}, {2, structure({1, 0}, 0.5)}, {4, structure({1, 0}, 0.3)}});
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({1, 0}));
}

TEST(ConfirmedStructureTest, ASmallJointOfASignalThatHasALargeOneGoesIfMoreNoiseDoesWithoutIt) {
  LearnedStructure coupled = structure({0, 0}, 0.9);
  coupled.search.couplings = {{1, 2, 0}};
  for (const NoiseSource source : {NoiseSource::kGiven, NoiseSource::kResiduals}) {
    coupled.noise_source = source;
    Found found = confirmed({{1, coupled}, {2, structure({0}, 0.5)}, {4, structure({0}, 0.1)}});
    EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
    found =
        confirmed({{1, coupled}, {2, coupled}, {4, structure({0}, 0.3)}, {8, structure({0}, 0.1)}});
    EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
    found = confirmed({{1, coupled}, {2, coupled}, {4, coupled}, {8, coupled}});
    EXPECT_EQ(signals_of(found.structure), std::vector<int>({0, 0}));
    EXPECT_FALSE(found.structure.is_contested);
  }
}

// Observations that have covariances go without a noise that is told.
TEST(ConfirmedStructureTest, CovariancesMadeLargerAreNoGuessOfTheNoise) {
  LearnedStructure found = structure({0}, 0.9);
  found.noise_source = NoiseSource::kResiduals;
  found.options.measurement.noise = Noise{1, 1};
  EXPECT_TRUE(found.is_noise_guessed_too_large());
  found.options.measurement.noise.reset();
  EXPECT_FALSE(found.is_noise_guessed_too_large());
}

TEST(ConfirmedStructureTest, PartsThatAreFixedToEachOtherAreOneBody) {
  LearnedStructure coupled = third_on(1);
  coupled.search.models.back().model.joints.push_back({.signal = 0});
  coupled.search.couplings = {{1, 3, 0}};
  const Found found = confirmed({{1, coupled}, {2, third_on(1)}, {4, third_on(2)}});
  EXPECT_EQ(found.num_searches, 3);
  EXPECT_EQ(found.structure.search.models.size(), 2U);
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
  EXPECT_FALSE(found.structure.is_contested);
  // Edges of the answer that more noise hangs on the other part are not contested either.
  const Found small = confirmed({{1, coupled}, {2, third_on(1)}, {4, coupled}, {8, third_on(2)}});
  EXPECT_EQ(signals_of(small.structure), std::vector<int>());
  EXPECT_EQ(small.structure.search.models.size(), 1U);
}

TEST(ConfirmedStructureTest, TooFewDataAreNoReasonForMoreNoise) {
  LearnedStructure few = nothing();
  few.search.records[{2, 3}].undecided.emplace(1, 5.0);
  EXPECT_EQ(confirmed({{1, few}}).num_searches, 1);
}

TEST(ConfirmedStructureTest, NoiseThatWasGuessedFromResidualsIsNotRefutedByThem) {
  LearnedStructure guessed = structure({0, 1}, 1.2);
  guessed.noise_source = NoiseSource::kResiduals;
  EXPECT_EQ(confirmed({{1, guessed}}).num_searches, 1);
}

// A guess is that of some parts: others may have more.
TEST(ConfirmedStructureTest, AGuessThatNothingSpansWithGrowsUntilTwoStructuresAreTheSame) {
  const auto guessed = [](LearnedStructure found, double factor) {
    found.noise_source = NoiseSource::kResiduals;
    found.options.measurement.noise = Noise{factor * 0.004, factor * 1 * kDegree};
    return found;
  };
  Found found = confirmed({{1, guessed(nothing(), 1)},
                           {2, guessed(structure({0}, 0.4), 2)},
                           {4, guessed(structure({0}, 0.1), 4)}});
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
  EXPECT_TRUE(found.is_soft);  // tried first
  EXPECT_FALSE(found.structure.is_contested);
  // No marker is as noisy as that.
  found = confirmed({{1, guessed(nothing(), 1)}, {2, guessed(structure({0}, 0.4), 3)}});
  EXPECT_FALSE(found.structure.spans());
  EXPECT_EQ(found.num_searches, 2);
}

TEST(ConfirmedStructureTest, AJointThatAddsLessThanTheNoiseOfOneSightIsNeverInTheAnswer) {
  LearnedStructure coupled = structure({0, 0}, 0.9);
  coupled.search.couplings = {{1, 2, 0, true}};
  const Found found = confirmed({{1, coupled}, {2, nothing()}});
  EXPECT_TRUE(found.structure.search.models.empty());
}

TEST(ConfirmedStructureTest, WhatMoreNoiseDoesNotConnectIsLeftAsItIs) {
  const Found found = confirmed({{1, nothing()}, {2, nothing()}});
  EXPECT_EQ(found.num_searches, 2);
  EXPECT_TRUE(found.is_soft);
  EXPECT_FALSE(found.structure.is_contested);
}

TEST(ConfirmedStructureTest, WhatTwiceTheNoiseDoesNotSpanContradictsNothing) {
  const Found found = confirmed({{1, structure({0, 1}, 1.2)}, {2, nothing()}});
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0, 1}));
  EXPECT_FALSE(found.structure.is_contested);
}

TEST(ConfirmedStructureTest, AnExtraJointOfASignalThatIsUsedAnywayGoes) {
  const Found found =
      confirmed({{1, structure({0, 0}, 1.2)}, {2, structure({0}, 0.9)}, {4, structure({0}, 0.3)}});
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0}));
  EXPECT_EQ(found.structure.noise_source, NoiseSource::kResiduals);
}

TEST(ConfirmedStructureTest, NoiseThatIsMoreThanTheResidualsSayConnectsNothingButAProcessMay) {
  const std::map<double, LearnedStructure> by_factor = {{1, nothing()},
                                                        {2, structure({0, 0}, 0.6)},
                                                        {4, structure({0}, 0.16)},
                                                        {8, structure({0}, 0.04)}};
  const Found found = confirmed(by_factor);
  EXPECT_FALSE(found.structure.spans());
  EXPECT_TRUE(found.structure.is_contested);
  EXPECT_TRUE(found.is_soft);
  const Found soft = confirmed(by_factor, {0});
  EXPECT_TRUE(soft.structure.spans());
  EXPECT_FALSE(soft.structure.is_contested);
  EXPECT_EQ(soft.structure.noise_source, NoiseSource::kGiven);
  // Of another signal it would explain what the screws do not leave.
  EXPECT_TRUE(confirmed(by_factor, {0, 1}).structure.is_contested);
}

TEST(ConfirmedStructureTest, BendsThatOnlyMoreNoiseShowsMakeLessNoiseEnough) {
  LearnedStructure bent = structure({0, 1}, 0.16);
  bent.signals = {{.name = "q1", .warp = {0.1}}, {.name = "q2"}};
  const std::map<double, LearnedStructure> by_factor = {
      {1, nothing()}, {2, bent}, {4, bent}, {8, bent}};
  Found found = confirmed(by_factor, {}, {{1, structure({0, 1}, 0.9)}});
  EXPECT_EQ(signals_of(found.structure), std::vector<int>({0, 1}));
  EXPECT_EQ(found.structure.noise_source, NoiseSource::kGiven);
  EXPECT_FALSE(found.is_soft);
  // With some more noise than is told, or not at all.
  found = confirmed(by_factor, {}, {{1, nothing()}, {2, structure({0, 1}, 0.6)}});
  EXPECT_TRUE(found.structure.spans());
  EXPECT_EQ(found.structure.noise_source, NoiseSource::kResiduals);
  found = confirmed(by_factor, {}, {{1, structure({0}, 0.9)}, {2, structure({0}, 0.6)}});
  EXPECT_TRUE(found.structure.is_contested);
}

TEST(ConfirmedStructureTest, MoreNoiseFixesNothingToAPartThatRests) {
  for (const bool rests : {false, true}) {
    LearnedStructure apart = nothing();
    if (rests) apart.search.resting = {1};
    const Found found = confirmed({{1, apart}, {2, structure({}, 1)}, {4, structure({}, 0.25)}});
    EXPECT_EQ(found.structure.spans(), !rests);
  }
}

TEST(ConfirmedStructureTest, ASignalThatIsLostWithMoreNoiseLeavesItsEdgeOpen) {
  const Found found = confirmed({{1, structure({0, 1}, 1.2)}, {2, structure({0}, 0.9)}});
  EXPECT_TRUE(found.structure.is_contested);
  EXPECT_TRUE(found.structure.search.models.empty());
}

TEST(ConfirmedStructureTest, ABiasOfViewsAboveTheToldNoiseIsNoJoint) {
  test::Imperfection biased{.name = "view bias", .view_bias_m = 0.004, .view_bias_deg = 2};
  LearnOptions options;
  options.root = 1;
  options.measurement.noise = Noise{0.003, 1 * kDegree};
  int num_right = 0, num_confidently_wrong = 0;
  for (std::uint64_t seed = 0; seed < 4; ++seed) {
    test::ImperfectRobot robot(2 + static_cast<int>(seed), true, biased, seed);
    const BodySchema schema = learn(robot.signals(), robot.babble(50), options).schema;
    const test::Rightness rightness = judge(schema, robot.structure());
    num_right += rightness == test::Rightness::kRight;
    num_confidently_wrong += rightness == test::Rightness::kWrong && schema.complete;
  }
  EXPECT_GE(num_right, 3);
  EXPECT_EQ(num_confidently_wrong, 0);
}

TEST(ConfirmedStructureTest, ToldNoiseThatTheMarkersRefuteGivesWayToWhatTheyShow) {
  const std::vector<test::Imperfection> off = {
      {.name = "placements", .placement_m = 0.004, .placement_deg = 2},
      {.name = "sizes", .tag_size = 0.01}};
  LearnOptions options;
  options.root = 1;
  options.measurement.noise = Noise{0.003, 1 * kDegree};
  int num_right = 0, num_said = 0;
  for (const test::Imperfection& imperfection : off)
    for (const std::uint64_t seed : {1, 3, 8}) {
      test::ImperfectRobot robot(2 + static_cast<int>(seed) % 6, seed / 6 % 2 == 0, imperfection,
                                 seed);
      const LearnResult learned = learn(robot.signals(), robot.babble(60), options);
      num_right += judge(learned.schema, robot.structure()) == test::Rightness::kRight;
      num_said += learned.noise_source == NoiseSource::kResiduals &&
                  learned.schema.noise.position_m > options.measurement.noise->position_m;
    }
  EXPECT_GE(num_right, 5);
  EXPECT_GE(num_said, 5);
}

}  // namespace
}  // namespace bodyschema
