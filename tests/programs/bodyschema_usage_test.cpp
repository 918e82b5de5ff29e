// The command line of bodyschema: options, files, exit codes, and the commands of a rig.

#include <gtest/gtest.h>
#include <sys/wait.h>

#include <cstdlib>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "tests/programs/bodyschema_program.h"

namespace bodyschema::test {
namespace {

TEST_F(BodyschemaProgramTest, SenselessOptionsAreRefused) {
  const auto csv = write_robot("s.csv");
  expect_failure({"learn", csv, "--root", "9", "--out", "schema.lcmlog"},
                 "--root: part 9 is never seen");
  for (const std::string noise : {"0", "nan", "inf"}) {
    expect_failure({"learn", csv, "--noise", noise, "1", "--out", "schema.lcmlog"}, "--noise");
    expect_failure({"learn", csv, "--noise", "0.001", noise, "--out", "schema.lcmlog"}, "--noise");
  }
  expect_failure({"learn", csv, "--noise", "-0.001", "1", "--out", "schema.lcmlog"}, "--noise");
  expect_failure({"learn", csv, "--noise", "0.001", "--out", "schema.lcmlog"}, "--noise");
  expect_failure({"learn", csv, "--speed", "3"}, "--speed");
  expect_failure({"learn"}, "SAMPLES");
  expect_failure({"predict", csv}, "SAMPLES");
  expect_failure({"forget", csv}, "bodyschema: unknown command 'forget'; there are: learn ");
  expect_failure({}, "subcommand is required");
  EXPECT_FALSE(exists("schema.lcmlog"));
}

TEST_F(BodyschemaProgramTest, ExitCodesTellWrongUsageFromABadInput) {
  const auto csv = write_robot("s.csv");
  for (const std::vector<std::string>& wrong : std::vector<std::vector<std::string>>{
           {},
           {"forget"},
           {"learn"},
           {"learn", csv, "--speed", "3"},
           {"learn", csv, "--noise", "1"},
           {"learn", csv, "--noise", "x", "1"},
           {"learn", csv, "--noise", "0", "1"},
           {"learn", csv, "--root", "1e3"},
           {"learn", csv, "--method", "magic"},
           {"target"},
           {"target", "--part", "-1", "--position", "0", "0", "0"},
           {"target", "--part", "1"},
           {"target", "--part", "1", "--tag", "40", "--position", "0", "0", "0"},
           {"target", "--part", "1", "--tag", "40", "--orientation", "1", "0", "0", "0"},
           {"target", "--part", "1", "--orientation", "1", "0", "0", "0"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--orientation", "0", "0", "0",
            "0"},
           {"target", "--part", "1", "--position", "0", "0"},
           {"target", "--part", "1", "--position", "0", "0", std::string(309, '9')},
           {"target", "--part", "1", "--position", "nan", "0", "0"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--timeout", "1e300"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--timeout", "nan"},
           {"target", "--part", "1", "--position", "0", "0", "0", "--keep", "inf"},
           {"log"},
           {"status", "--seconds", "0"},
           {"fault", "target", "40", "0", "0"},
           {"fault", "melt"}}) {
    const Outcome outcome = run(wrong);
    EXPECT_EQ(outcome.exit_code, 2) << Json(wrong) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_LT(outcome.err.size(), 300U) << outcome.err;
  }
  for (const std::vector<std::string>& bad :
       std::vector<std::vector<std::string>>{{"learn", "none.csv"},
                                             {"learn", csv, "--root", "9"},
                                             {"show", csv},
                                             {"log", "none.lcmlog"},
                                             {"rig", "nonesuch"},
                                             {"learn", csv, "--out", "no/where"}}) {
    EXPECT_EQ(run(bad).exit_code, 1) << Json(bad);
  }
  EXPECT_NE(run({"--help"}).out.find("2 wrong usage"), std::string::npos);
}

TEST_F(BodyschemaProgramTest, ItsVersionIsAResult) {
  const Outcome outcome = run({"--version"});
  EXPECT_EQ(outcome.exit_code, 0);
  EXPECT_EQ(outcome.out.rfind("bodyschema 0.", 0), 0U) << outcome.out;
}

// It once latched the arm, and ./run stop ends the group.
TEST_F(BodyschemaProgramTest, StopDoesNothingButSayWhichIsMeant) {
  for (const std::vector<std::string>& arguments :
       {std::vector<std::string>{"stop"}, {"stop", "--in", "memq://"}}) {
    const Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.exit_code, 2);
    EXPECT_EQ(outcome.out, "");
    EXPECT_NE(outcome.err.find("`bodyschema halt` stops the arm; a group is ended by `./run stop`"),
              std::string::npos)
        << outcome.err;
  }
  EXPECT_NE(run({"stop"}, "BODYSCHEMA_COMMAND=./run ").err.find("`./run halt`"), std::string::npos);
  const std::string help = run({"--help"}).out;
  EXPECT_NE(help.find("\n  halt "), std::string::npos) << help;
  EXPECT_EQ(help.find("\n  stop "), std::string::npos) << help;
}

// Today's time-out of a target is 120 s.
TEST_F(BodyschemaProgramTest, WhereNobodyIsOnTheBusEveryCommandEndsAtOnceAndSaysWhatToType) {
  for (const std::vector<std::string>& command :
       std::vector<std::vector<std::string>>{{"target", "--part", "1", "--position", "0", "0", "0"},
                                             {"target", "--part", "1", "--tag", "40"},
                                             {"hold"},
                                             {"release"},
                                             {"halt"},
                                             {"resume"}}) {
    std::vector<std::string> arguments = command;
    arguments.insert(arguments.end(), {"--in", "memq://"});
    expect_failure(arguments, "nothing is heard on memq://: no group runs there. ./run --keep", 1);
  }
}

TEST_F(BodyschemaProgramTest, AToleranceOfAnOrientationThatIsNotAskedIsRefused) {
  expect_failure({"target", "--part", "1", "--position", "0", "0", "0", "--tolerance-deg", "1"},
                 "--orientation");
}

TEST_F(BodyschemaProgramTest, OfASchemaThatIsCutOffTheByteIsTold) {
  const auto schema = folder_ / "schema.lcmlog";
  run({"learn", write_robot("s.csv"), "--noise", "0.001", "0.3", "--out", schema.string()});
  std::filesystem::resize_file(schema, std::filesystem::file_size(schema) - 1);
  expect_failure({"show", schema.string()}, "ends within the event at byte", 1);
}

TEST_F(BodyschemaProgramTest, ANoiseThatIsNoneIsAskedBack) {
  const auto csv = write_robot("s.csv");
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  for (const std::vector<std::string>& command :
       std::vector<std::vector<std::string>>{{"learn", csv}, {"monitor", "schema.lcmlog", csv}}) {
    const auto expect = [&](const std::string& position, const std::string& rotation,
                            const std::string& what) {
      std::vector<std::string> arguments = command;
      arguments.insert(arguments.end(), {"--noise", position, rotation});
      expect_failure(arguments, what, 2);
    };
    expect("3", "1", "3 m is no noise of a marker; did you mean: --noise 0.003 1");
    expect("1e6", "1", "1000000 m is no noise of a marker; at most");
    expect("0.003", "57", "57 degrees are no noise of a marker");
    expect(std::string(309, '9'), "1", "--noise");
  }
  EXPECT_NE(run({"learn", csv, "--noise", "0.003", "0.0175"}).err.find("looks like radians"),
            std::string::npos);
  EXPECT_EQ(run({"learn", csv, "--noise", "0.0254", "6.1"}).exit_code, 0);
}

TEST_F(BodyschemaProgramTest, StdinAndPackedFilesAreReadLikeFiles) {
  const auto csv = write_robot("s.csv");
  const std::string expected = run({"learn", csv, "--json"}).out;
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  EXPECT_EQ(run({"learn", "-", "--json"}, "cat s.csv | ").out, expected);
  EXPECT_EQ(run({"learn", "-", "--json"}, "gzip -c s.csv | ").out, expected);
  ASSERT_EQ(run({"show", "schema.lcmlog"}, "gzip -k s.csv && ").exit_code, 0);
  EXPECT_EQ(run({"learn", "s.csv.gz", "--json"}).out, expected);
  EXPECT_EQ(run({"predict", "schema.lcmlog", "-", "--json"}, "cat s.csv | ").out,
            run({"predict", "schema.lcmlog", csv, "--json"}).out);
  const Outcome broken = run({"learn", "-"}, "head -c 90 s.csv | ");
  EXPECT_EQ(broken.exit_code, 1);
  EXPECT_EQ(broken.err.rfind("bodyschema: stdin:", 0), 0U) << broken.err;
}

TEST_F(BodyschemaProgramTest, AHintIsGivenBesideTheResultAndChangesNothing) {
  write_robot("s.csv");
  Rng rng(80);
  auto samples = babble(robot_, 30, {}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& part : sample.parts) part.X_CB.translation() *= 1000;
  const Outcome outcome = run({"learn", write("mm.csv", samples), "--json"});
  EXPECT_EQ(outcome.exit_code, 0);
  EXPECT_NE(outcome.err.find("mm.csv: positions look like millimetres"), std::string::npos);
  EXPECT_EQ(outcome.json()["samples"], 30);
}

TEST_F(BodyschemaProgramTest, HelpIsAResult) {
  for (const auto& arguments : std::vector<std::vector<std::string>>{
           {"--help"}, {"learn", "--help"}, {"predict", "--help"}, {"show", "--help"}}) {
    const Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.exit_code, 0);
    EXPECT_EQ(outcome.err, "");
    EXPECT_GT(outcome.out.size(), 100U);
  }
}

TEST_F(BodyschemaProgramTest, ABrokenFileIsPointedAtAndNothingIsWritten) {
  const std::string header = "t,q1,part,x,y,z,qw,qx,qy,qz\n";
  const std::string row = "0,1,1,0,0,0,1,0,0,0\n";
  write("schema.lcmlog", "what was there before");
  const auto expect = [&](const std::string& text, const std::string& what) {
    write("broken.csv", text);
    expect_failure({"learn", "broken.csv", "--out", "schema.lcmlog", "--json"}, what);
    EXPECT_EQ(text_of(folder_ / "schema.lcmlog"), "what was there before");
  };
  expect(header + row + "1,1,1,0,0,zero,1,0,0,0\n",
         "broken.csv:3:11: z: expected a finite number, found 'zero'");
  expect(header + row + "1,1,1,0,0,0,1,1,0,0\n", "broken.csv:3:13: qw,qx,qy,qz: expected a unit");
  expect("time,q1\n", "broken.csv:1:1: expected the header");
  expect("", "broken.csv:1:1: expected a header line");
  expect(header, "broken.csv:2:1: expected at least one row");
  // A name that JSON could not hold, after everything was learned and written.
  expect("t,\xE9paule,part,x,y,z,qw,qx,qy,qz\n" + row, "broken.csv:1:3: expected the name");
  expect_failure({"learn", "no such.csv", "--out", "new.lcmlog"}, "no such.csv: cannot be read");
  expect_failure({"learn", ".", "--out", "new.lcmlog"}, "found a folder");
  EXPECT_FALSE(exists("new.lcmlog"));
  for (const auto& entry : std::filesystem::directory_iterator(folder_)) {
    const std::string name = entry.path().filename();
    EXPECT_TRUE(name == "broken.csv" || name == "schema.lcmlog" || name == "stdout.txt" ||
                name == "stderr.txt")
        << name << " was left behind";
  }
}

TEST_F(BodyschemaProgramTest, AResultThatCannotBeWrittenIsAFailure) {
  const auto csv = write_robot("s.csv");
  expect_failure({"learn", csv, "--out", "no such folder/schema.lcmlog", "--json"},
                 "no such folder/schema.lcmlog");
  std::filesystem::create_directory(folder_ / "taken");
  expect_failure({"learn", csv, "--out", "taken", "--json"}, "taken");
  // A full disk behind stdout.
  const std::string command = "cd '" + folder_.string() + "' && '" + BODYSCHEMA_PROGRAM +
                              "' learn s.csv --json >/dev/full 2>stderr.txt";
  const int status = std::system(command.c_str());
  ASSERT_TRUE(WIFEXITED(status));
  EXPECT_NE(WEXITSTATUS(status), 0);
  EXPECT_NE(text_of(folder_ / "stderr.txt").find("stdout"), std::string::npos);
}

TEST_F(BodyschemaProgramTest, FilesOfTheWrongKindAreRefused) {
  const auto csv = write_robot("s.csv");
  ASSERT_EQ(run({"learn", csv, "--out", "schema.lcmlog"}).exit_code, 0);
  expect_failure({"learn", "schema.lcmlog"}, "schema.lcmlog: expected SAMPLE messages");
  expect_failure({"show", csv}, "s.csv");
  expect_failure({"show", "no such.lcmlog"}, "no such.lcmlog");
  expect_failure({"predict", csv, csv}, "s.csv");
  write("empty.lcmlog", "");
  expect_failure({"show", "empty.lcmlog"}, "empty.lcmlog: expected a schema");
  // Cut anywhere, a schema file is an error, never a crash.
  const std::string whole = text_of(folder_ / "schema.lcmlog");
  for (std::size_t size = 1; size < whole.size(); size += whole.size() / 12) {
    write("cut.lcmlog", whole.substr(0, size));
    expect_failure({"show", "cut.lcmlog"}, "cut.lcmlog");
  }
  // A recording of another robot.
  const auto other = write("other.csv", "t,q1,part,x,y,z,qw,qx,qy,qz\n0,1,1,0,0,0,1,0,0,0\n");
  expect_failure({"predict", "schema.lcmlog", other},
                 "other.csv: the signals of the samples are q1; those of the schema q1, q2");
  // The same one with other names.
  std::string renamed = text_of(folder_ / csv);
  renamed.replace(renamed.find("q1,q2"), 5, "q2,q3");
  expect_failure({"predict", "schema.lcmlog", write("renamed.csv", renamed)},
                 "renamed.csv: the signals of the samples are q2, q3");
}

TEST_F(BodyschemaProgramTest, RigPrintsTheNetworkOfAGoodRigOnly) {
  const Outcome outcome = run({"rig", std::string(BODYSCHEMA_CONFIG) + "/arm2"});
  EXPECT_EQ(outcome.exit_code, 0);
  std::istringstream words(outcome.out);
  std::string kind, bus, images;
  words >> kind >> bus >> images;
  EXPECT_TRUE(kind == "private" || kind == "host") << outcome.out;
  EXPECT_EQ(bus.rfind("udpm://", 0), 0U);
  EXPECT_EQ(images.rfind("udpm://", 0), 0U);
  EXPECT_NE(bus, images);
  EXPECT_TRUE(outcome.out.ends_with("\nOK: 5 parts, 2 signals, 16 tags\n")) << outcome.out;
  EXPECT_EQ(outcome.err, "");
  expect_failure({"rig", "."}, "yaml: cannot be read", 1);
  run({"learn", write_robot("robot.csv"), "--out", "schema.lcmlog"});
  EXPECT_EQ(run({"rig", std::string(BODYSCHEMA_CONFIG) + "/arm2", "--initial", "schema.lcmlog"})
                .exit_code,
            0);
  expect_failure({"rig", std::string(BODYSCHEMA_CONFIG) + "/arm7", "--initial", "schema.lcmlog"},
                 "schema.lcmlog: it has 2 action signals");
}

TEST_F(BodyschemaProgramTest, ARigIsFoundByItsName) {
  std::filesystem::create_directory(folder_ / "config");
  std::filesystem::copy(std::string(BODYSCHEMA_CONFIG) + "/arm2", folder_ / "config" / "myarm");
  EXPECT_EQ(run({"rig", "myarm"}).exit_code, 0);
  EXPECT_EQ(run({"rig", "config/myarm"}).exit_code, 0);
  EXPECT_EQ(run({"rig", "../config/myarm"}, "cd config && ").exit_code, 0);
  expect_failure({"rig", "myram"},
                 "there is no rig 'myram'; there are: myarm; did you mean 'myarm'?", 1);
  expect_failure({"rig", "config/myram"}, "config/myram: expected the folder of a rig", 1);
  // Every problem at once, each with its place.
  write("config/myarm/motor_babbler.yaml", "choice: smart\n");
  write("config/myarm/network.yaml", "network: wifi\n");
  const Outcome outcome = run({"rig", "myarm"});
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_EQ(outcome.out, "");
  EXPECT_NE(outcome.err.find("motor_babbler.yaml:1: choice: 'smart' is none of: active, random"),
            std::string::npos)
      << outcome.err;
  EXPECT_NE(outcome.err.find("network.yaml:1: network: 'wifi'"), std::string::npos) << outcome.err;
}

TEST_F(BodyschemaProgramTest, ALogTellsItsRig) {
  const std::string log = std::string(BODYSCHEMA_LOGS) + "/arm2_15.lcmlog";
  const Outcome outcome = run({"log", log, "--rig-of", BODYSCHEMA_CONFIG});
  EXPECT_EQ(outcome.exit_code, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "arm2\n");
  std::filesystem::create_directory(folder_ / "rigs");
  const auto copy = [&](const std::string& from, const std::string& to) {
    std::filesystem::copy(BODYSCHEMA_CONFIG + from, folder_ / "rigs" / to);
  };
  copy("/arm7", "arm7");
  expect_failure({"log", log, "--rig-of", "rigs"}, "arm7: ", 1);
  copy("/arm2", "here");
  EXPECT_EQ(run({"log", log, "--rig-of", "rigs"}).out, "here\n");
  copy("/arm2", "there");
  expect_failure({"log", log, "--rig-of", "rigs"}, "may be of several rigs: here, there", 1);
  run({"learn", write_robot("s.csv"), "--out", "schema.lcmlog"});
  expect_failure({"log", "schema.lcmlog", "--rig-of", "nowhere"}, "nowhere", 1);
}

TEST_F(BodyschemaProgramTest, AFaultWithoutASimulatorSaysSo) {
  expect_failure({"fault", "repair", "--in", "memq://"}, "no simulator is heard on memq://");
}

TEST_F(BodyschemaProgramTest, AFaultIsCheckedBeforeItIsSent) {
  expect_failure({"fault"}, "subcommand is required");
  expect_failure({"fault", "bend", "forearm"}, "DEG is required");
  expect_failure({"fault", "bend", "forearm", "91"}, "not in range");
  expect_failure({"fault", "tool", "-1"}, "not in range");
  expect_failure({"fault", "marker-lost", "twelve"}, "not in range");
  expect_failure({"fault", "melt"}, "fault: unknown command 'melt'; there are: stuck bend ");
}

TEST_F(BodyschemaProgramTest, ADriverTestWithoutADriverSaysSo) {
  const std::string rig = std::string(BODYSCHEMA_CONFIG) + "/arm2";
  expect_failure({"driver-test", "--rig-folder", rig, "--in", "memq://", "--yes"},
                 "no MOTION_STATUS within 5 s");
  expect_failure({"driver-test", "--yes"}, "--rig-folder is required");
  expect_failure({"driver-test", "--rig-folder", rig, "--kill", "x", "--restart", "y"}, "excludes");
}

}  // namespace
}  // namespace bodyschema::test
