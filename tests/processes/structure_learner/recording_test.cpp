#include "processes/structure_learner/recording/recording.h"

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <set>
#include <sstream>
#include <string>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

const std::string kHeader = "t,q1,q2,part,x,y,z,qw,qx,qy,qz\n";

std::string error_of(const std::string& text) {
  try {
    parse_csv(text, "f.csv");
  } catch (const RecordingError& error) {
    return error.what();
  } catch (const std::exception& error) {
    ADD_FAILURE() << "not a RecordingError: " << error.what();
    return "";
  }
  ADD_FAILURE() << "no error in " << text;
  return "";
}

TEST(RecordingTest, ReadsInstantsSignalsPartsAndPoses) {
  const Recording recording = parse_csv(kHeader +
                                            "0,0.5,-1,1,0.1,0.2,0.3,1,0,0,0\n"
                                            "0,0.5,-1,3,1,2,3,0,0,0,1\n"
                                            "2.5,0.25,4,1,0,0,0,0.5,0.5,0.5,0.5\n",
                                        "f");
  ASSERT_EQ(recording.signals.size(), 2U);
  EXPECT_EQ(recording.signals[0].name, "q1");
  EXPECT_EQ(recording.signals[0].lower, 0.25);
  EXPECT_EQ(recording.signals[0].upper, 0.5);
  EXPECT_EQ(recording.signals[1].lower, -1);
  EXPECT_EQ(recording.signals[1].upper, 4);
  EXPECT_FALSE(recording.has_noise);
  EXPECT_FALSE(recording.is_log);
  ASSERT_EQ(recording.samples.size(), 2U);
  EXPECT_EQ(recording.samples[0].sample_index, 0);
  EXPECT_EQ(recording.samples[1].sample_index, 1);
  EXPECT_EQ(recording.samples[1].utime, 2'500'000);
  EXPECT_EQ(recording.samples[1].action, Eigen::Vector2d(0.25, 4));
  ASSERT_EQ(recording.samples[0].parts.size(), 2U);
  EXPECT_EQ(recording.samples[0].parts[0].X_CB.translation(), Eigen::Vector3d(0.1, 0.2, 0.3));
  // Half a turn about z, scalar first.
  const Pose& X = recording.samples[0].parts[1].X_CB;
  EXPECT_LT((X * Eigen::Vector3d(1, 0, 0) - Eigen::Vector3d(0, 2, 3)).norm(), 1e-12);
  EXPECT_TRUE(recording.samples[0].parts[0].covariance.isZero(0));
  EXPECT_EQ(recording.training().size(), 2U);
}

TEST(RecordingTest, WhatCsvFilesOfTheWorldDoIsTolerated) {
  const std::string plain = kHeader + "0,1,2,1,0,0,0,1,0,0,0\n1,2,3,1,0,0,1,1,0,0,0\n";
  const auto with_line_end = [](std::string text, const std::string& end) {
    std::string result;
    for (const char c : text) result += c == '\n' ? end : std::string(1, c);
    return result;
  };
  for (const std::string& text :
       {plain, with_line_end(plain, "\r\n"), "\xEF\xBB\xBF" + plain, with_line_end(plain, "\n\n"),
        with_line_end(plain, "  \n"), "\n \r\n" + plain, plain.substr(0, plain.size() - 1),
        std::string("t , q1, q2 ,part,x,y,z,qw,qx,qy, qz\n 0,1 ,2,1,0,0,0,1,0,0,0\n"
                    "1e0,2.0,0.3e1,1,-0,0,1, 1 ,0,0,0\n")}) {
    const Recording recording = parse_csv(text, "f");
    ASSERT_EQ(recording.samples.size(), 2U) << text;
    EXPECT_EQ(recording.samples[1].action, Eigen::Vector2d(2, 3)) << text;
    EXPECT_EQ(recording.samples[1].parts.at(0).X_CB.translation().z(), 1) << text;
    EXPECT_EQ(recording.signals[1].name, "q2");
  }
}

TEST(RecordingTest, PartZeroIsAPartLikeAnyOtherAndPartsAreSorted) {
  const Recording recording = parse_csv(kHeader +
                                            "0,1,2,7,0,0,7,1,0,0,0\n"
                                            "0,1,2,0,0,0,0,1,0,0,0\n"
                                            "0,1,2,3,0,0,3,1,0,0,0\n",
                                        "f");
  ASSERT_EQ(recording.samples.size(), 1U);
  std::vector<int> ids;
  for (const auto& part : recording.samples[0].parts) {
    ids.push_back(part.part);
    EXPECT_EQ(part.X_CB.translation().z(), part.part);
  }
  EXPECT_EQ(ids, (std::vector<int>{0, 3, 7}));
}

TEST(RecordingTest, AMissingRowIsAnUnseenPart) {
  const Recording recording = parse_csv(kHeader +
                                            "0,1,2,1,0,0,0,1,0,0,0\n"
                                            "1,1,2,2,0,0,0,1,0,0,0\n"
                                            "2,1,2,1,0,0,0,1,0,0,0\n"
                                            "2,1,2,2,0,0,0,1,0,0,0\n",
                                        "f");
  ASSERT_EQ(recording.samples.size(), 3U);
  EXPECT_EQ(recording.samples[0].find(2), nullptr);
  EXPECT_EQ(recording.samples[1].find(1), nullptr);
  EXPECT_NE(recording.samples[2].find(2), nullptr);
}

TEST(RecordingTest, AnInstantIsATimeWhereverItsRowsStand) {
  // Part by part, and backwards.
  const Recording recording = parse_csv(kHeader +
                                            "1,1,2,1,0,0,1,1,0,0,0\n"
                                            "0,1,2,1,0,0,2,1,0,0,0\n"
                                            "1,1,2,2,0,0,3,1,0,0,0\n"
                                            "0,1,2,2,0,0,4,1,0,0,0\n",
                                        "f");
  ASSERT_EQ(recording.samples.size(), 2U);
  EXPECT_EQ(recording.samples[0].sample_index, 0);
  EXPECT_EQ(recording.samples[1].utime, 1'000'000);
  EXPECT_EQ(recording.samples[0].find(2)->X_CB.translation().z(), 4);
  EXPECT_EQ(recording.samples[1].find(2)->X_CB.translation().z(), 3);
}

// Slightly different ones would make two instants with half of the parts each.
TEST(RecordingTest, ARowWrittenTwiceCountsOnce) {
  const std::string row = "0,1,2,1,0,0,0,1,0,0,0\n";
  const Recording recording = parse_csv(kHeader + row + "0,1,2,2,0,0,1,1,0,0,0\n" + row, "f");
  ASSERT_EQ(recording.samples.size(), 1U);
  EXPECT_EQ(recording.samples[0].parts.size(), 2U);
}

TEST(RecordingTest, OneInstantHasOneAction) {
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,1,0,0,0\n\n0,1,2.000001,2,0,0,0,1,0,0,0\n"),
            "f.csv:4:5: q2: expected the value of line 2, which has the same t: one instant has "
            "one action");
}

Recording with_columns(const std::string& names) {
  return parse_csv("t," + names + ",part,x,y,z,qw,qx,qy,qz\n0,1,2,1,0,0,0,1,0,0,0\n", "f");
}

TEST(RecordingTest, ColumnsAreGivenToTheSignalsOfASchemaByTheirNames) {
  const std::vector<Signal> signals = {{.name = "lift"}, {.name = "turn"}};
  EXPECT_EQ(samples_by_signals(with_columns("lift,turn"), signals).at(0).action,
            Eigen::Vector2d(1, 2));
  EXPECT_EQ(samples_by_signals(with_columns("turn,lift"), signals).at(0).action,
            Eigen::Vector2d(2, 1));
  const auto error_with = [&](const Recording& recording, const std::vector<Signal>& of) {
    try {
      samples_by_signals(recording, of);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  EXPECT_EQ(error_with(with_columns("lift,q2"), signals),
            "the signals of the samples are lift, q2; those of the schema lift, turn: name the "
            "columns as the schema does");
  EXPECT_NE(error_with(with_columns("lift,turn"), {{.name = "lift"}}), "");
  EXPECT_NE(error_with(with_columns("lift,turn"), {}), "");
  // A log has no names of its own.
  Recording log = with_columns("q1,q2");
  log.is_log = true;
  EXPECT_EQ(samples_by_signals(log, signals).at(0).action, Eigen::Vector2d(1, 2));
  EXPECT_EQ(error_with(log, {{.name = "lift"}}), "the samples have 2 action signals, the schema 1");
}

TEST(RecordingTest, NoiseColumnsAreStandardDeviationsPerAxis) {
  const Recording recording =
      parse_csv("t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n0,1,1,0,0,0,1,0,0,0,0.003,2\n", "f");
  EXPECT_TRUE(recording.has_noise);
  const Matrix6d& covariance = recording.samples[0].parts[0].covariance;
  const double rotation = 2 * kDegree;
  Vector6d expected;
  expected << Eigen::Vector3d::Constant(9e-6), Eigen::Vector3d::Constant(rotation * rotation);
  EXPECT_LT((covariance - Matrix6d(expected.asDiagonal())).norm(), 1e-15);
}

TEST(RecordingTest, ABodyWithoutSignalsAndSignalsOfAnyNameAreRead) {
  EXPECT_EQ(parse_csv("t,part,x,y,z,qw,qx,qy,qz\n0,1,0,0,0,1,0,0,0\n", "f").signals.size(), 0U);
  EXPECT_EQ(parse_csv("t,Schulter,\xC3\xBC,part,x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0,1,0,0,0\n", "f")
                .signals[1]
                .name,
            "\xC3\xBC");
}

TEST(RecordingTest, EmptyQuaternionCellsArePositionsAlone) {
  const Recording recording = parse_csv(
      "t,q1,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n0,1,1,0,0,0,1,0,0,0,0.002,1\n"
      "0,1,2,0.1,0.2,0.3,,,,,0.002,\n1,1,2,0.1,0.2,0.3, ,,,,0.002,1\n",
      "f");
  EXPECT_TRUE(recording.samples[0].parts[0].has_rotation);
  const PartObservation& alone = recording.samples[0].parts[1];
  EXPECT_FALSE(alone.has_rotation);
  EXPECT_EQ(alone.X_CB.translation(), Eigen::Vector3d(0.1, 0.2, 0.3));
  EXPECT_TRUE(alone.X_CB.linear().isIdentity(0));
  EXPECT_NEAR(recording.measurement.covariance(alone)(0, 0), 4e-6, 1e-9);
  EXPECT_TRUE(recording.measurement.covariance(alone).bottomRows<3>().isZero(0));
  EXPECT_FALSE(recording.samples[1].parts[0].has_rotation);
  EXPECT_TRUE(recording.hints.empty());
  // A quaternion is there or not.
  EXPECT_THROW(parse_csv(kHeader + "0,1,2,1,0,0,0,1,0,,0\n", "f"), RecordingError);
  EXPECT_THROW(parse_csv(kHeader + "0,1,2,1,0,,0,,,,\n", "f"), RecordingError);
}

TEST(RecordingTest, AMixtureOfPosesAndPositionsIsTold) {
  std::string text = kHeader;
  for (int t = 0; t < 10; ++t)
    text += std::to_string(t) + ",1,2,1,0,0,0" + (t < 7 ? ",,,,\n" : ",1,0,0,0\n");
  const Recording recording = parse_csv(text, "f");
  ASSERT_EQ(recording.hints.size(), 1U);
  EXPECT_NE(recording.hints[0].find("part 1: 3 of 10 observations are left out, which have an"),
            std::string::npos)
      << recording.hints[0];
}

TEST(RecordingTest, QuaternionsAreNormalised) {
  const Recording recording =
      parse_csv(kHeader + "0,1,2,1,0,0,0,0.5004,0.5004,-0.5004,0.5004\n", "f");
  const Eigen::Matrix3d R = recording.samples[0].parts[0].X_CB.linear();
  EXPECT_LT((R * R.transpose() - Eigen::Matrix3d::Identity()).norm(), 1e-14);
}

TEST(RecordingTest, WhatWasWrittenIsReadAgain) {
  test::Rng rng(41);
  for (const test::Regime regime : {test::Regime::kFree, test::Regime::kTag}) {
    const auto robot = test::random_tree({}, rng);
    const test::ObservationOptions options{.regime = regime};
    auto samples = test::babble(robot, 30, options, rng);
    std::erase_if(samples, [](const auto& sample) { return sample.parts.empty(); });
    std::stringstream text;
    test::write_csv(samples, text);
    const Recording recording = parse_csv(text.str(), "f");
    ASSERT_EQ(recording.samples.size(), samples.size());
    for (std::size_t i = 0; i < samples.size(); ++i) {
      EXPECT_LT((recording.samples[i].action - samples[i].action).norm(), 1e-9);
      ASSERT_EQ(recording.samples[i].parts.size(), samples[i].parts.size());
      for (std::size_t k = 0; k < samples[i].parts.size(); ++k) {
        EXPECT_EQ(recording.samples[i].parts[k].part, samples[i].parts[k].part);
        EXPECT_LT((recording.samples[i].parts[k].X_CB.matrix() - samples[i].parts[k].X_CB.matrix())
                      .norm(),
                  1e-9);
      }
    }
  }
}

TEST(RecordingTest, AnEmptyFileIsRefused) {
  EXPECT_EQ(error_of(""), "f.csv:1:1: expected a header line, found an empty file");
  EXPECT_EQ(error_of("\n\r\n  \n"), "f.csv:1:1: expected a header line, found an empty file");
  EXPECT_EQ(error_of(kHeader), "f.csv:2:1: expected at least one row");
}

TEST(RecordingTest, ABrokenHeaderIsPointedAt) {
  EXPECT_EQ(error_of("time,q1,part\n"),
            "f.csv:1:1: expected the header t,q1,...,qm,part,x,y,z,qw,qx,qy,qz[,sp_m,sr_deg], "
            "found 'time'");
  EXPECT_EQ(error_of("0,0.1,1,0,0,0,1,0,0,0\n").rfind("f.csv:1:1: expected the header", 0), 0U);
  EXPECT_EQ(error_of("t,q1,,part,x,y,z,qw,qx,qy,qz\n"),
            "f.csv:1:6: expected the name of an action signal");
  EXPECT_EQ(error_of("t,q1,q1,part,x,y,z,qw,qx,qy,qz\n"), "f.csv:1:6: the name 'q1' stands twice");
  EXPECT_EQ(error_of("t,q1,q2\n"), "f.csv:1:6: expected a column 'part' after the action signals");
  EXPECT_EQ(error_of("t,q1,part,x,y,w,qw,qx,qy,qz\n"), "f.csv:1:15: expected the column 'z'");
  EXPECT_EQ(error_of("t,q1,part,x,y,z,qx,qy,qz,qw\n"),
            "f.csv:1:17: expected the column 'qw'; quaternions are w x y z: put qw first");
  EXPECT_EQ(error_of("t,q1,part,x,y,z,roll_deg,pitch_deg,yaw_deg\n"),
            "f.csv:1:17: expected the column 'qw'; rotations are unit quaternions");
  EXPECT_EQ(error_of("t,q1,part,x_mm,y,z,qw,qx,qy,qz\n"),
            "f.csv:1:11: expected the column 'x'; positions are in metres");
  EXPECT_EQ(error_of("t,q1,part,x,y,z,qw,qx,qy\n"), "f.csv:1:23: expected the column 'qz'");
  EXPECT_EQ(error_of("t,q1,part,x,y,z,qw,qx,qy,qz,noise\n"),
            "f.csv:1:29: expected the column 'sp_m' or nothing");
  EXPECT_EQ(error_of("t,q1,part,x,y,z,qw,qx,qy,qz,sp_m\n"),
            "f.csv:1:29: expected the column 'sr_deg' or nothing");
  EXPECT_EQ(error_of("t,q1,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg,more\n"),
            "f.csv:1:41: expected no further column");
  EXPECT_EQ(error_of("t,q\xFC,part,x,y,z,qw,qx,qy,qz\n"),
            "f.csv:1:3: expected the name of an action signal in UTF-8");
}

TEST(RecordingTest, ABrokenRowIsPointedAtWithWhatWasExpected) {
  const std::string row = "0,1,2,1,0,0,0,1,0,0,0\n";
  EXPECT_EQ(error_of(kHeader + row + "1,1,2,1,0,0,zero,1,0,0,0\n"),
            "f.csv:3:13: z: expected a finite number, found 'zero'");
  EXPECT_EQ(error_of(kHeader + "soon,1,2,1,0,0,0,1,0,0,0\n"),
            "f.csv:2:1: t: expected a finite number, found 'soon'");
  EXPECT_EQ(error_of(kHeader + "0,1,,1,0,0,0,1,0,0,0\n"),
            "f.csv:2:5: q2: expected a finite number, found ''");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,1,0,0,0 0\n"),
            "f.csv:2:21: qz: expected a finite number, found '0 0'");
  EXPECT_EQ(error_of(kHeader + "0,  nan,2,1,0,0,0,1,0,0,0\n"),
            "f.csv:2:5: q1: expected a finite number, found 'nan'");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,inf,0,0,1,0,0,0\n"),
            "f.csv:2:9: x: expected a finite number, found 'inf'");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,1e999,0,0,1,0,0,0\n"),
            "f.csv:2:9: x: expected a finite number, found '1e999'");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1.5,0,0,0,1,0,0,0\n"),
            "f.csv:2:7: part: expected a whole number from 0, found '1.5'");
  EXPECT_EQ(error_of(kHeader + "0,1,2,-1,0,0,0,1,0,0,0\n"),
            "f.csv:2:7: part: expected a whole number from 0, found '-1'");
  EXPECT_EQ(error_of(kHeader + "0,1,2,99999999999,0,0,0,1,0,0,0\n"),
            "f.csv:2:7: part: expected a whole number from 0, found '99999999999'");
  EXPECT_EQ(error_of(kHeader + row + "0,1,2,1,0,0,1,1,0,0,0\n"),
            "f.csv:3:7: part 1 stands twice at this instant");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,1,1,0,0\n"),
            "f.csv:2:15: qw,qx,qy,qz: expected a unit quaternion, found norm 1.414214");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,0.97,0,0,0\n"),
            "f.csv:2:15: qw,qx,qy,qz: expected a unit quaternion, found norm 0.970000");
  const Pose rounded =
      parse_csv(kHeader + "0,1,2,1,0,0,0,0.7,0,0.7,0\n", "f.csv").samples[0].parts[0].X_CB;
  EXPECT_NEAR(rounded.linear()(0, 2), 1, 1e-12);
  EXPECT_EQ(error_of(kHeader + "1700000000000000000,1,2,1,0,0,0,1,0,0,0\n"),
            "f.csv:2:1: t: expected seconds within ±1e12, found '1700000000000000000'");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,0,0,0,0\n"),
            "f.csv:2:15: qw,qx,qy,qz: expected a unit quaternion, found norm 0.000000");
}

TEST(RecordingTest, ARowOfAnotherLengthIsPointedAtWhereItGoesWrong) {
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,1,0,0\n"),
            "f.csv:2:19: expected 11 fields, found 10");
  EXPECT_EQ(error_of(kHeader + "0,1,2,1,0,0,0,1,0,0,0,7,8\n"),
            "f.csv:2:23: expected 11 fields, found 13");
  EXPECT_EQ(error_of(kHeader + "0;1;2\n"), "f.csv:2:1: expected 11 fields, found 1");
}

TEST(RecordingTest, OtherSeparatorsAndDecimalCommasAreNamed) {
  const auto expect = [](const std::string& text, const std::string& what) {
    const std::string error = error_of(text);
    EXPECT_TRUE(error.ends_with(what)) << error;
  };
  const std::string semicolons = "t;q1;q2;part;x;y;z;qw;qx;qy;qz\n";
  expect(semicolons + "0;0.5;2;1;0;0;0;1;0;0;0\n",
         "found 't;q1;q2;part;x;y;z;qw;qx;qy;qz'; fields look separated by ';', expected ','");
  expect(semicolons + "0;0,5;2,25;1;0,125;0;0;1;0;0;0\n",
         "; fields look separated by ';', expected ','; numbers look as if they had decimal "
         "commas, expected points");
  expect(kHeader + "0;0.5;2;1;0;0;0;1;0;0;0\n", "; fields look separated by ';', expected ','");
  expect("t\tq1\tq2\tpart\tx\ty\tz\tqw\tqx\tqy\tqz\n",
         "; fields look separated by tabs, expected ','");
  // As a spreadsheet writes that asks nobody.
  expect(kHeader + "0,0,5,2,25,1,0,125,0,0,1,0,0,0\n",
         "expected 11 fields, found 14; numbers look as if they had decimal commas, expected "
         "points");
  expect(kHeader + "0,0.5,2,1,0,0,0,1,0,0,0,7\n", "expected 11 fields, found 12");
}

TEST(RecordingTest, ANumberOf309DigitsIsPointedAtAndNotRepeated) {
  const std::string huge(309, '9');
  EXPECT_EQ(error_of(kHeader + "0,1,2,1," + huge + ",0,0,1,0,0,0\n"),
            "f.csv:2:9: x: expected a finite number, found '" + std::string(40, '9') + "…'");
  EXPECT_EQ(
      error_of(kHeader + "0,1,2," + huge + ",0,0,0,1,0,0,0\n"),
      "f.csv:2:7: part: expected a whole number from 0, found '" + std::string(40, '9') + "…'");
  EXPECT_EQ(error_of(huge + "\n").find(huge), std::string::npos);
}

TEST(RecordingTest, ANoiseThatIsNotPositiveIsRefused) {
  const std::string header = "t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n";
  EXPECT_EQ(error_of(header + "0,1,1,0,0,0,1,0,0,0,0,1\n"),
            "f.csv:2:21: sp_m: expected a standard deviation above 0");
  EXPECT_EQ(error_of(header + "0,1,1,0,0,0,1,0,0,0,1,-1\n"),
            "f.csv:2:23: sr_deg: expected a standard deviation above 0");
}

TEST(RecordingTest, APartWhosePoseNeverChangesHasNoNoise) {
  std::string text = kHeader;
  for (int t = 0; t < 4; ++t)
    text += fmt::format("{0},0.{0},0,1,1,0,0,1,0,0,0\n{0},0.{0},0,2,1,0.0{0},0,1,0,0,0\n", t);
  EXPECT_EQ(parse_csv(text, "f.csv").measurement.fixed_parts, std::set<int>{1});
}

// Numbers that no robot has would overflow further on.
TEST(RecordingTest, AbsurdlyLargeNumbersAreRefused) {
  for (const std::string row :
       {"1e300,1,2,1,0,0,0,1,0,0,0", "0,-1e300,2,1,0,0,0,1,0,0,0", "0,1,2,1,0,1e300,0,1,0,0,0"}) {
    EXPECT_NE(error_of(kHeader + row + "\n").find("within ±1e12"), std::string::npos);
  }
  // Nanoseconds since 1970 are no seconds, microseconds might be.
  EXPECT_NE(error_of(kHeader + "1.7e18,1,2,1,0,0,0,1,0,0,0\n").find("f.csv:2:1: t: "),
            std::string::npos);
}

TEST(RecordingTest, LinesAreCountedAsAnEditorDoes) {
  const std::string text = "\xEF\xBB\xBF\r\n" + kHeader + "\n0,1,2,1,0,0,0,1,0,0,0\r\n\r\n0,1,x";
  EXPECT_EQ(error_of(text).rfind("f.csv:6:5: expected 11 fields", 0), 0U) << error_of(text);
}

TEST(RecordingTest, BytesThatAreNoTextAreNotRepeated) {
  EXPECT_NE(error_of("\xED\x1b[2J\x9b,7\n").find(", found '? [2J?'"), std::string::npos);
}

}  // namespace
}  // namespace bodyschema
