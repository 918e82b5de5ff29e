#include "processes/structure_learner/recording/recording.h"

#include <gtest/gtest.h>
#include <unistd.h>
#include <zlib.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <random>
#include <sstream>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
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

/// Recordings of many robots, of noise, of flips and of parts that are not seen.
template <class Visit>
void for_each_robot(int count, Visit visit) {
  test::Rng rng(45);
  for (int n = 0; n < count; ++n) {
    const char* const names[] = {"a", "b", "c", "co", "d", "dP"};
    const auto robot =
        n % 4 == 3 ? test::random_tree({}, rng) : test::chapter_robot(names[n % 6], rng);
    const test::Regime regimes[] = {test::Regime::kFree, test::Regime::kTag, test::Regime::kTagIso,
                                    test::Regime::kChapter};
    Recording recording;
    recording.samples = test::babble(robot, n % 2 ? 15 : 60, {.regime = regimes[n / 4 % 4]}, rng);
    visit(recording, n);
  }
}

void change_poses(Recording& recording, const std::function<void(Pose&)>& change) {
  for (ActionPoseSample& sample : recording.samples)
    for (PartObservation& o : sample.parts) change(o.X_CB);
}

/// The pose that is read where x, y, z, w was written.
void as_x_y_z_w(Pose& X) {
  const Eigen::Quaterniond q(X.linear());
  X.linear() = Eigen::Quaterniond(q.x(), q.y(), q.z(), q.w()).toRotationMatrix();
}

bool is_hinted(const Recording& recording, const std::string& word) {
  const auto hints = hints_of(recording);
  return std::any_of(hints.begin(), hints.end(),
                     [&](const std::string& hint) { return hint.find(word) != std::string::npos; });
}

TEST(RecordingHintsTest, ARecordingAsItShouldBeGetsNone) {
  for_each_robot(300, [](Recording& recording, int n) {
    for (const std::string& hint : hints_of(recording))
      ADD_FAILURE() << "robot " << n << ": " << hint;
  });
}

TEST(RecordingHintsTest, MillimetresAreNamed) {
  for_each_robot(100, [](Recording& recording, int n) {
    change_poses(recording, [](Pose& X) { X.translation() *= 1000; });
    EXPECT_TRUE(is_hinted(recording, "positions look like millimetres")) << n;
  });
}

TEST(RecordingHintsTest, TheQuaternionOrderXYZWIsNamedWhereTheDataTell) {
  int num_named = 0;
  for_each_robot(300, [&](Recording& recording, int) {
    change_poses(recording, as_x_y_z_w);
    num_named += is_hinted(recording, "x y z w");
  });
  // Measured: 276. The others are small or noisy.
  EXPECT_GT(num_named, 250);
  // A frame's own pose is no rotation.
  const std::string header = "t,q1,part,x,y,z,qw,qx,qy,qz\n";
  EXPECT_EQ(parse_csv(header + "0,1,0,0,0,0,0,0,0,1\n0,1,1,0,0,1,0.6,0,0,0.8\n", "f").hints.size(),
            1U);
  EXPECT_TRUE(
      parse_csv(header + "0,1,0,0,0,0,1,0,0,0\n0,1,1,0,0,1,0.6,0,0,0.8\n", "f").hints.empty());
}

/// Three parts, two hinges, a root that rests: few joints tell the order, and half of them in
/// either.
Recording small_arm(std::uint32_t seed, double noise_m, double noise_rad) {
  test::Rng rng(seed);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> angle(-1, 1);
  const auto vector = [&](double sigma) {
    return Eigen::Vector3d(sigma * normal(rng), sigma * normal(rng), sigma * normal(rng));
  };
  const auto turn = [](const Eigen::Vector3d& v) { return Pose(exp_so3(v)); };
  const auto move = [](double x, double y, double z) {
    return Pose(Eigen::Translation3d(x, y, z));
  };
  Recording recording;
  for (int i = 0; i < 40; ++i) {
    const Pose X_C1 = move(0.1, 0.2, 1.5) * turn({2, 0, 0});
    const Pose X_C2 =
        X_C1 * move(0, 0, 0.2) * turn({0, 0, angle(rng)}) * move(0.1, 0, 0) * turn({0.3, 0, 0});
    const Pose X_C3 = X_C2 * move(0, 0, 0.1) * turn({0, angle(rng), 0}) * move(0.3, 0, 0);
    ActionPoseSample& sample = recording.samples.emplace_back();
    for (const Pose& X : {X_C1, X_C2, X_C3}) {
      PartObservation& o = sample.parts.emplace_back();
      o.part = static_cast<int>(sample.parts.size());
      o.X_CB = Eigen::Translation3d(vector(noise_m)) * X * turn(vector(noise_rad));
    }
  }
  return recording;
}

TEST(RecordingHintsTest, TheQuaternionOrderOfThreePartsIsNamed) {
  for (std::uint32_t seed = 1; seed <= 20; ++seed) {
    for (const double noise_m : {0.002, 0.01}) {
      Recording recording = small_arm(seed, noise_m, 2.5 * noise_m);
      EXPECT_TRUE(hints_of(recording).empty()) << seed;
      change_poses(recording, as_x_y_z_w);
      EXPECT_TRUE(is_hinted(recording, "x y z w")) << seed << ", " << noise_m;
    }
  }
}

TEST(RecordingHintsTest, StandardDeviationsInMillimetresAreNamed) {
  const std::string header = "t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n";
  EXPECT_TRUE(is_hinted(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,3,1\n", "f"), "sp_m"));
  EXPECT_TRUE(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,0.003,1\n", "f").hints.empty());
}

TEST(RecordingHintsTest, StandardDeviationsInRadiansAreNamed) {
  const std::string header = "t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n";
  EXPECT_TRUE(is_hinted(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,0.001,0.0035\n", "f"), "sr_deg"));
  EXPECT_TRUE(parse_csv(header + "0,1,1,0,0,0,1,0,0,0,0.001,0.2\n", "f").hints.empty());
}

TEST(RecordingTest, ANoiseThatIsNotPositiveIsRefused) {
  const std::string header = "t,q,part,x,y,z,qw,qx,qy,qz,sp_m,sr_deg\n";
  EXPECT_EQ(error_of(header + "0,1,1,0,0,0,1,0,0,0,0,1\n"),
            "f.csv:2:21: sp_m: expected a standard deviation above 0");
  EXPECT_EQ(error_of(header + "0,1,1,0,0,0,1,0,0,0,1,-1\n"),
            "f.csv:2:23: sr_deg: expected a standard deviation above 0");
}

// Numbers that no robot has would overflow further on.
TEST(RecordingTest, AbsurdlyLargeNumbersAreRefused) {
  for (const std::string row :
       {"1e300,1,2,1,0,0,0,1,0,0,0", "0,-1e300,2,1,0,0,0,1,0,0,0", "0,1,2,1,0,1e300,0,1,0,0,0"}) {
    EXPECT_NE(error_of(kHeader + row + "\n").find("expected a number within ±1e12"),
              std::string::npos);
  }
  // Nanoseconds since 1970 are no seconds, microseconds might be.
  EXPECT_NE(error_of(kHeader + "1.7e18,1,2,1,0,0,0,1,0,0,0\n").find("f.csv:2:1: t: "),
            std::string::npos);
}

TEST(RecordingTest, LinesAreCountedAsAnEditorDoes) {
  const std::string text = "\xEF\xBB\xBF\r\n" + kHeader + "\n0,1,2,1,0,0,0,1,0,0,0\r\n\r\n0,1,x";
  EXPECT_EQ(error_of(text).rfind("f.csv:6:5: expected 11 fields", 0), 0U) << error_of(text);
}

std::string valid_csv() {
  test::Rng rng(42);
  const auto robot = test::chapter_robot("a", rng);
  std::stringstream text;
  test::write_csv(test::babble(robot, 6, {}, rng), text);
  return text.str();
}

// A file that was damaged on its way is read or refused, never anything else.
TEST(RecordingTest, TwentyThousandDamagedFilesAreReadOrRefused) {
  const std::string good = valid_csv();
  const std::string likely = "0123456789,.-+eE \r\n\tnaifxq\xEF\xBB\xBF\"";
  std::mt19937_64 rng(43);
  const auto below = [&](std::size_t n) { return static_cast<std::size_t>(rng() % n); };
  int num_read = 0, num_refused = 0;
  for (int n = 0; n < 20'000; ++n) {
    std::string text = good.substr(0, n % 3 == 0 ? below(good.size()) + 1 : good.size());
    for (std::size_t k = 0, count = 1 + below(4); k < count; ++k) {
      if (text.empty()) break;
      const std::size_t at = below(text.size());
      switch (below(5)) {
        case 0:
          text[at] = static_cast<char>(rng());
          break;
        case 1:
          text[at] = likely[below(likely.size())];
          break;
        case 2:
          text.insert(at, 1, likely[below(likely.size())]);
          break;
        case 3:
          text.erase(at, 1 + below(10));
          break;
        default:
          text.insert(at, text.substr(below(text.size()), below(80)));
      }
    }
    try {
      const Recording recording = parse_csv(text, "f.csv");
      ++num_read;
      ASSERT_FALSE(recording.samples.empty());
      for (const ActionPoseSample& sample : recording.samples) {
        ASSERT_EQ(sample.action.size(), static_cast<Eigen::Index>(recording.signals.size()));
        ASSERT_TRUE(sample.action.allFinite());
        ASSERT_FALSE(sample.parts.empty());
        int last = -1;
        for (const PartObservation& part : sample.parts) {
          ASSERT_GT(part.part, last);
          last = part.part;
          ASSERT_TRUE(part.X_CB.matrix().allFinite());
          ASSERT_LT(
              (part.X_CB.linear() * part.X_CB.linear().transpose() - Eigen::Matrix3d::Identity())
                  .norm(),
              1e-9);
        }
      }
    } catch (const RecordingError& error) {
      ++num_refused;
      // FILE:LINE:COLUMN: what
      int line = 0, column = 0;
      ASSERT_EQ(std::sscanf(error.what(), "f.csv:%d:%d: ", &line, &column), 2) << error.what();
      ASSERT_GE(line, 1);
      ASSERT_GE(column, 1);
    }
  }
  EXPECT_GT(num_read, 100);
  EXPECT_GT(num_refused, 1000);
}

/// A file of its own for every test.
class RecordingFileTest : public testing::Test {
 protected:
  RecordingFileTest() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    file_ = std::filesystem::path(testing::TempDir()) /
            ("recording_" + std::to_string(getpid()) + test->name());
    std::filesystem::remove(file_);
    test::Rng rng(44);
    robot_ = test::chapter_robot("a", rng);
    const test::ObservationOptions options{
        .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    for (ActionPoseSample& sample : test::babble(robot_, 12, options, rng)) {
      sample.sample_index += 5;
      sample.utime = 1000 * sample.sample_index;
      if (sample.sample_index % 5 == 4) sample.purpose = Purpose::kTest;
      samples_.push_back(sample);
    }
  }
  ~RecordingFileTest() override { std::filesystem::remove(file_); }

  std::string load_error() const {
    try {
      load_recording(file_);
    } catch (const std::runtime_error& error) {
      const std::string text = error.what();
      EXPECT_EQ(text.rfind(file_.string() + ":", 0), 0U) << text;
      return text.substr(std::min(text.size(), file_.string().size() + 1));
    }
    ADD_FAILURE() << "no error";
    return "";
  }

  std::filesystem::path file_;
  test::SyntheticRobot robot_;
  std::vector<ActionPoseSample> samples_;
};

TEST_F(RecordingFileTest, ALogOfSamplesIsReadWithInstantsCountedFromZero) {
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) {
      if (sample.sample_index == samples_[3].sample_index) continue;  // its datagram was lost
      log.append(kSample, to_message(sample));
      log.append(kSample, to_message(sample));  // repeated on the bus
      log.append(kSample, to_message(samples_.front()));
    }
    log.append(kSample, to_message(samples_[3]));  // sent again on request
  }
  const Recording recording = load_recording(file_);
  EXPECT_TRUE(recording.is_log);
  EXPECT_TRUE(recording.has_noise);
  ASSERT_EQ(recording.samples.size(), 12U);
  for (std::size_t i = 0; i < samples_.size(); ++i) {
    const ActionPoseSample& read = recording.samples[i];
    EXPECT_EQ(read.sample_index, static_cast<std::int64_t>(i));
    EXPECT_EQ(read.utime, samples_[i].utime);
    EXPECT_EQ(read.purpose, samples_[i].purpose);
    EXPECT_EQ(read.action, samples_[i].action);
    ASSERT_EQ(read.parts.size(), samples_[i].parts.size());
    for (std::size_t k = 0; k < read.parts.size(); ++k) {
      const PartObservation &a = read.parts[k], &b = samples_[i].parts[k];
      EXPECT_EQ(a.part, b.part);
      EXPECT_LT((a.X_CB.matrix() - b.X_CB.matrix()).norm(), 1e-12);
      EXPECT_TRUE(a.covariance.isApprox(b.covariance, 1e-6)) << "beyond rounding to float";
      EXPECT_EQ(a.X_CB_other.has_value(), b.X_CB_other.has_value());
      EXPECT_EQ(a.error_ratio, b.error_ratio);
    }
  }
  ASSERT_EQ(recording.signals.size(), 2U);
  EXPECT_EQ(recording.signals[0].name, "q1");
}

TEST_F(RecordingFileTest, APositionAloneIsReadAndAMixtureWithPosesIsTold) {
  {
    LogAppender log(file_);
    sample_t alone = to_message(samples_[0]);
    part_observation_t& part = alone.parts[0];
    part.has_rotation = part.has_other = 0;
    part.error_ratio = 0;
    part.X_CB.rotation_wxyz[0] = 1;
    for (int i = 1; i < 4; ++i) part.X_CB.rotation_wxyz[i] = 0;
    part.X_CB_other = part.X_CB;
    std::fill(part.covariance + 6, part.covariance + 21, 0.0F);
    log.append(kSample, alone);
    log.append(kSample, to_message(samples_[1]));
  }
  const Recording recording = load_recording(file_);
  ASSERT_EQ(recording.samples[0].parts.size(), samples_[0].parts.size());
  const PartObservation& alone = recording.samples[0].parts[0];
  EXPECT_FALSE(alone.has_rotation);
  EXPECT_TRUE(alone.X_CB.linear().isIdentity(0));
  EXPECT_TRUE(alone.covariance.bottomRows<3>().isZero(0));
  EXPECT_GT(alone.covariance(0, 0), 0);
  ASSERT_EQ(recording.hints.size(), 1U);
  EXPECT_NE(recording.hints[0].find("1 of 2 observations are left out, which have no orientation"),
            std::string::npos)
      << recording.hints[0];
}

TEST_F(RecordingFileTest, OnlyTrainAndProbeAreLearnedFrom) {
  {
    LogAppender log(file_);
    const Purpose purposes[] = {Purpose::kTrain, Purpose::kTest, Purpose::kProbe,
                                Purpose::kControl};
    for (std::size_t i = 0; i < samples_.size(); ++i) {
      samples_[i].purpose = purposes[i % 4];
      log.append(kSample, to_message(samples_[i]));
    }
  }
  const Recording recording = load_recording(file_);
  EXPECT_EQ(recording.samples.size(), 12U);
  const auto training = recording.training();
  ASSERT_EQ(training.size(), 6U);
  for (const ActionPoseSample& sample : training) {
    EXPECT_TRUE(sample.purpose == Purpose::kTrain || sample.purpose == Purpose::kProbe);
    // Its number is that in the file, so that outliers can be found there.
    EXPECT_EQ(sample.action, recording.samples.at(sample.sample_index).action);
  }
}

TEST_F(RecordingFileTest, SignalNamesAndLimitsComeFromTheRecordedSchema) {
  BodySchema schema;
  schema.signals = {{"shoulder", -60, 60}, {"elbow", 0, 1}};
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) log.append(kSample, to_message(sample));
    log.append(kBodySchema, to_message(schema));
  }
  const Recording recording = load_recording(file_);
  EXPECT_EQ(recording.signals[1].name, "elbow");
  EXPECT_EQ(recording.signals[0].lower, -60);
}

TEST_F(RecordingFileTest, ATornTailOfALogIsNoError) {
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) log.append(kSample, to_message(sample));
  }
  std::filesystem::resize_file(file_, std::filesystem::file_size(file_) - 11);
  EXPECT_EQ(load_recording(file_).samples.size(), 11U);
}

TEST_F(RecordingFileTest, ALogThatIsOfNoUseIsRefused) {
  BodySchema schema;
  LogAppender(file_).append(kBodySchema, to_message(schema));
  EXPECT_EQ(load_error(), " expected SAMPLE messages, found none in 1 event");

  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    log.append(kSample, to_message(samples_[0]));
    sample_t longer = to_message(samples_[1]);
    set_array(longer.num_signals, longer.action, {1, 2, 3});
    log.append(kSample, longer);
  }
  EXPECT_EQ(load_error(), " sample 6 has 3 action signals, the first one 2");

  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    samples_[0].calibration_id = 1;
    samples_[1].calibration_id = 2;
    log.append(kSample, to_message(samples_[0]));
    log.append(kSample, to_message(samples_[1]));
  }
  EXPECT_EQ(load_error(),
            " sample 6 is of another calibration of the tags or lens than the first: markers.yaml "
            "or the camera's calibration changed in between; make a new run");

  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    log.append(kSample, to_message(samples_[0]));
    const std::vector<std::uint8_t> garbage(100, 7);
    log.append_bytes("SAMPLE", garbage, 1);
  }
  EXPECT_EQ(load_error().rfind(" event 1 (SAMPLE): ", 0), 0U);

  std::filesystem::resize_file(file_, 50);
  EXPECT_EQ(load_error(),
            " expected SAMPLE messages, found none in 0 events; it ends in the middle of an event "
            "at byte 0");
}

TEST(RecordingTest, BytesThatAreNoTextAreNotRepeated) {
  EXPECT_NE(error_of("\xED\x1b[2J\x9b,7\n").find(", found '? [2J?'"), std::string::npos);
}

TEST_F(RecordingFileTest, AFileThatCannotBeReadIsNamed) {
  EXPECT_EQ(load_error(), " cannot be read: no such file or no permission");
  std::filesystem::create_directory(file_);
  EXPECT_EQ(load_error(), " expected a CSV file or an LCM log, found a folder");
}

/// As gzip writes it.
void write_packed(const std::filesystem::path& file, const std::string& text) {
  const gzFile packed = gzopen(file.c_str(), "wb");
  ASSERT_NE(packed, nullptr);
  ASSERT_EQ(gzwrite(packed, text.data(), static_cast<unsigned>(text.size())),
            static_cast<int>(text.size()));
  ASSERT_EQ(gzclose(packed), Z_OK);
}

TEST_F(RecordingFileTest, APackedCsvIsReadAndPointedInto) {
  write_packed(file_, valid_csv());
  EXPECT_EQ(load_recording(file_).samples.size(), 6U);
  write_packed(file_, "t,q1\n");
  EXPECT_EQ(load_error(), "1:3: expected a column 'part' after the action signals");
}

TEST_F(RecordingFileTest, APackedLogIsRead) {
  {
    LogAppender log(file_);
    for (const ActionPoseSample& sample : samples_) log.append(kSample, to_message(sample));
    const std::vector<std::uint8_t> garbage(100, 7);
    log.append_bytes("OTHER", garbage, 1);
  }
  std::ifstream stream(file_, std::ios::binary);
  const std::string bytes(std::istreambuf_iterator<char>(stream), {});
  write_packed(file_, bytes);
  const Recording recording = load_recording(file_);
  EXPECT_TRUE(recording.is_log);
  EXPECT_EQ(recording.samples.size(), samples_.size());
  // Its own name stands in errors, as of every file.
  write_packed(file_, bytes.substr(0, 100));
  EXPECT_EQ(load_error().rfind(" expected SAMPLE messages", 0), 0U);
}

TEST_F(RecordingFileTest, APackedFileThatIsDamagedIsRefused) {
  write_packed(file_, valid_csv());
  std::ifstream stream(file_, std::ios::binary);
  const std::string packed(std::istreambuf_iterator<char>(stream), {});
  std::mt19937_64 rng(46);
  for (int n = 0; n < 500; ++n) {
    std::string bytes = packed;
    if (n % 2 == 0) {
      bytes.resize(11 + rng() % (bytes.size() - 11));
    } else {
      // Behind the header, whose time stamp nobody checks.
      bytes[10 + rng() % (bytes.size() - 10)] ^= static_cast<char>(1 << rng() % 8);
    }
    std::ofstream(file_, std::ios::trunc | std::ios::binary) << bytes;
    try {
      load_recording(file_);
      ADD_FAILURE() << "damage " << n << " was not seen";
    } catch (const RecordingError& error) {
      EXPECT_EQ(std::string(error.what()).rfind(file_.string() + ":", 0), 0U) << error.what();
    }
  }
}

TEST_F(RecordingFileTest, FilesShorterThanALogsMarkAreReadAsCsv) {
  for (const std::string text : {"", "t", "t,q", "\xED\xA1\xDA"}) {
    std::ofstream(file_, std::ios::trunc) << text;
    EXPECT_EQ(load_error().rfind("1:", 0), 0U);
  }
}

}  // namespace
}  // namespace bodyschema
