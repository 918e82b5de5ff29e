#include "processes/robot_driver_example/robot_driver_example.h"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <stdlib.h>
#include <unistd.h>

#include <cmath>
#include <limits>
#include <sstream>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "processes/robot_driver_example/serial_line.h"

namespace bodyschema {
namespace {

using Command = action_command_t;
using Status = motion_status_t;

constexpr std::int64_t kStart = 1'700'000'000'000'000;
constexpr std::int64_t kBoot = kStart - 1'000'000;
constexpr std::int64_t kHour = 3'600'000'000;

/// A driver and an obedient robot of three joints, on a clock of their own.
class Lab {
 public:
  explicit Lab(std::optional<Status> record = std::nullopt, std::int64_t now = kStart)
      : now_(now),
        driver(
            RobotDriverConfig::load(std::string(EXAMPLE_RIG) + "/robot_driver_example.yaml"),
            std::move(record), [this](const Status& s) { return save(s); }, this->now()) {}

  RobotDriver::Now now() const { return {now_ - kBoot, now_ + clock_error}; }

  void connect() {
    take(driver.on_connect(now()));
    tick();
  }
  /// A tick later; the robot answers the driver's question, unless it is silent.
  void tick(int times = 1) {
    for (; times > 0; --times) {
      now_ += 100'000;
      take(driver.on_tick(now()));
    }
  }
  Status send(const Command& command) {
    take(driver.on_command(command, now()));
    EXPECT_FALSE(heard.empty());
    return heard.back();
  }
  Command make(std::int8_t kind, std::vector<double> action = {}) {
    Command command{};
    command.utime = driver.status().utime;
    command.source = "test";
    command.epoch = 1;
    command.action_id = next_id_++;
    command.kind = kind;
    command.expiry_utime = command.utime + 10'000'000;
    set_array(command.num_signals, command.action, std::move(action));
    return command;
  }
  Command move(std::vector<double> action = {10, 10, 10}) {
    return make(Command::KIND_MOVE, std::move(action));
  }

  void take(RobotDriver::Answer answer) {
    std::vector<std::string> reports;
    for (const std::string& line : answer.lines) {
      lines.push_back(line);
      std::istringstream words(line);
      std::string verb;
      words >> verb;
      if (verb != "?") deeds.push_back(verb);
      if (is_silent || (is_deaf && verb == "HALT")) continue;
      if (verb == "HALT") is_moving = false;
      if (verb == "GO") is_moving = true;
      if (verb != "?") {
        words >> order;
      } else {
        reports.push_back("AT " + std::to_string(order) + (is_moving ? " MOVING" : " REST") +
                          " 1 2 3");
      }
    }
    driver.save(answer);
    for (const Status& status : answer.statuses) {
      EXPECT_EQ(check(status), "");
      EXPECT_GE(status.utime, heard.empty() ? 0 : heard.back().utime);
      heard.push_back(status);
    }
    for (const std::string& report : reports) take(driver.on_line(report, now()));
  }
  std::string save(const Status& status) {
    deeds.push_back("save");
    if (disk_is_full) return "disk full";
    record = status;
    return "";
  }
  bool was_told(const std::string& verb) const {
    return std::any_of(lines.begin(), lines.end(), [&](const std::string& line) {
      return line.compare(0, verb.size(), verb) == 0;
    });
  }

  std::int64_t now_;
  std::int64_t clock_error = 0;
  std::vector<Status> heard;
  std::vector<std::string> lines;
  std::vector<std::string> deeds;  // orders and saves, in their order
  bool is_silent = false, is_deaf = false, is_moving = false, disk_is_full = false;
  long order = 0;
  std::optional<Status> record;
  RobotDriver driver;

 private:
  std::int64_t next_id_ = 0;
};

TEST(RobotDriver, HaltsTheRobotBeforeAnythingElse) {
  Lab lab;
  EXPECT_FALSE(lab.driver.is_at_rest());
  EXPECT_EQ(lab.send(lab.move()).state, Status::STATE_REJECTED);
  lab.is_moving = true;
  lab.connect();
  ASSERT_FALSE(lab.lines.empty());
  EXPECT_EQ(lab.lines[0].substr(0, 4), "HALT");
  EXPECT_FALSE(lab.was_told("GO"));
  EXPECT_TRUE(lab.driver.is_at_rest());
  EXPECT_EQ(lab.heard.back().state, Status::STATE_IDLE);
  EXPECT_EQ(lab.heard.back().commanded, (std::vector<double>{1, 2, 3}));
}

TEST(RobotDriver, TakesNoReportOfBeforeTheOrderForAnAnswer) {
  Lab lab;
  lab.connect();
  lab.send(lab.move());
  const long before = lab.order - 1;
  lab.take(lab.driver.on_line("AT " + std::to_string(before) + " REST 1 2 3", lab.now()));
  EXPECT_EQ(lab.driver.status().state, Status::STATE_MOVING);
  lab.tick();
  EXPECT_EQ(lab.driver.status().state, Status::STATE_MOVING);
  lab.is_moving = false;
  lab.tick();
  EXPECT_EQ(lab.driver.status().state, Status::STATE_SETTLED);
  EXPECT_EQ(lab.driver.status().rest_since_utime, lab.now().clock_us);
}

TEST(RobotDriver, LosesASilentRobotAndHaltsItWhenItIsBack) {
  Lab lab;
  lab.connect();
  const Command motion = lab.move();
  lab.send(motion);
  lab.is_silent = true;
  lab.tick(5);
  EXPECT_EQ(lab.driver.status().state, Status::STATE_MOVING);
  lab.tick(1);
  EXPECT_EQ(lab.driver.status().state, Status::STATE_STOPPED);
  EXPECT_NE(lab.driver.status().reason.find("silent"), std::string::npos);
  EXPECT_EQ(lab.driver.status().rest_since_utime, -1);
  EXPECT_EQ(lab.send(lab.move()).state, Status::STATE_REJECTED);

  // The robot may still hear, though it is not heard.
  EXPECT_TRUE(lab.was_told("HALT"));
  lab.lines.clear();
  lab.tick(1);
  EXPECT_TRUE(lab.was_told("HALT"));

  lab.lines.clear();
  lab.take(lab.driver.on_line("AT " + std::to_string(lab.order) + " REST 1 2 3", lab.now()));
  EXPECT_FALSE(lab.driver.is_at_rest());  // said before it heard the HALT
  lab.is_silent = false;                  // and still moving
  lab.tick(1);
  EXPECT_TRUE(lab.was_told("HALT"));
  EXPECT_TRUE(lab.driver.is_at_rest());
  EXPECT_FALSE(lab.was_told("GO"));
  EXPECT_EQ(lab.send(motion).state, Status::STATE_STOPPED);
  EXPECT_FALSE(lab.was_told("GO"));
}

TEST(RobotDriver, NoLongerVouchesForAnArmThatItLostAtRest) {
  Lab lab;
  lab.connect();
  lab.send(lab.move());
  lab.is_moving = false;
  lab.tick();
  ASSERT_EQ(lab.driver.status().state, Status::STATE_SETTLED);
  lab.take(lab.driver.on_disconnect("unplugged", lab.now()));
  EXPECT_EQ(lab.driver.status().state, Status::STATE_STOPPED);
  EXPECT_EQ(lab.driver.status().reason, "unplugged");
  EXPECT_EQ(lab.driver.status().rest_since_utime, -1);
}

TEST(RobotDriver, HaltsAgainWhereAHaltWasLost) {
  Lab lab;
  lab.is_silent = true;
  lab.connect();
  lab.is_silent = false;
  lab.is_moving = true;
  lab.tick();
  EXPECT_TRUE(lab.driver.is_at_rest());

  lab.send(lab.move());
  lab.is_deaf = true;
  lab.send(lab.make(Command::KIND_HOLD));
  lab.tick();
  EXPECT_TRUE(lab.is_moving);
  lab.is_deaf = false;
  lab.tick();
  EXPECT_FALSE(lab.is_moving);
  EXPECT_TRUE(lab.driver.is_at_rest());
  lab.lines.clear();
  lab.tick();
  EXPECT_FALSE(lab.was_told("HALT"));
}

TEST(RobotDriver, NeverHaltsAMotionForAHaltOfBeforeIt) {
  Lab lab;
  lab.connect();
  lab.is_deaf = true;
  lab.send(lab.make(Command::KIND_HOLD));
  lab.is_deaf = false;
  EXPECT_EQ(lab.send(lab.move()).state, Status::STATE_MOVING);
  lab.tick(3);
  EXPECT_TRUE(lab.is_moving);
}

TEST(RobotDriver, WatchesTheRobotWhenTheClockIsSetBack) {
  Lab lab;
  lab.connect();
  lab.clock_error = -kHour;
  std::size_t num_heard = lab.heard.size();
  std::int64_t utime = lab.driver.status().utime;
  lab.tick(30);
  EXPECT_GE(lab.heard.size(), num_heard + 3);
  EXPECT_GE(lab.driver.status().utime, utime + 2'000'000);

  lab.send(lab.move());
  lab.tick(301);
  EXPECT_NE(lab.driver.status().reason.find("in time"), std::string::npos);
  EXPECT_FALSE(lab.is_moving);

  ASSERT_EQ(lab.send(lab.move()).state, Status::STATE_MOVING);
  lab.is_silent = true;
  lab.tick(6);
  EXPECT_NE(lab.driver.status().reason.find("silent"), std::string::npos);
}

TEST(RobotDriver, MeetsTheClockAgainWhenItIsALittleAhead) {
  Lab lab;
  lab.connect();
  lab.clock_error = -2'000'000;
  lab.tick(10);
  EXPECT_GT(lab.driver.status().utime, lab.now().clock_us);
  lab.tick(50);
  EXPECT_LE(lab.driver.status().utime, lab.now().clock_us);
}

TEST(RobotDriver, HaltsBeforeItWritesToTheDisk) {
  for (const std::int8_t kind : {Command::KIND_HOLD, Command::KIND_STOP}) {
    Lab lab;
    lab.connect();
    lab.deeds.clear();
    lab.send(lab.move());
    lab.send(lab.make(kind));
    EXPECT_EQ(lab.deeds, (std::vector<std::string>{"save", "GO", "HALT", "save"}));
  }
  Lab lab;
  lab.connect();
  lab.send(lab.move());
  lab.deeds.clear();
  lab.take(lab.driver.on_end(lab.now()));
  EXPECT_EQ(lab.deeds, (std::vector<std::string>{"HALT", "save"}));
}

TEST(RobotDriver, SaysThatAStopCouldNotBeKeptAndTriesAgain) {
  Lab lab;
  lab.connect();
  lab.disk_is_full = true;
  const Command stop = lab.make(Command::KIND_STOP);
  const Status answer = lab.send(stop);
  EXPECT_EQ(answer.state, Status::STATE_STOPPED);
  EXPECT_EQ(answer.stop_latched, 1);
  EXPECT_NE(answer.reason.find("disk full"), std::string::npos) << answer.reason;
  lab.tick(15);
  EXPECT_NE(lab.heard.back().reason.find("disk full"), std::string::npos);
  lab.disk_is_full = false;
  lab.tick(11);
  ASSERT_TRUE(lab.record.has_value());
  EXPECT_EQ(lab.record->stop_latched, 1);
  EXPECT_EQ(lab.record->action_id, stop.action_id);
  EXPECT_EQ(lab.heard.back().reason.find("disk full"), std::string::npos);
  // A recorded STOP needs no further save.
  lab.disk_is_full = true;
  lab.tick(100);
  EXPECT_EQ(lab.heard.back().reason.find("disk full"), std::string::npos);
}

TEST(RobotDriver, SaysSoWhenTheRobotMovesByItself) {
  Lab lab;
  lab.connect();
  lab.lines.clear();
  lab.is_moving = true;
  lab.tick();
  EXPECT_TRUE(lab.was_told("HALT"));
  EXPECT_EQ(lab.heard.back().rest_since_utime, -1);
  EXPECT_EQ(lab.heard.back().state, Status::STATE_STOPPED);
}

TEST(RobotDriver, HaltsAMotionThatDoesNotEnd) {
  Lab lab;
  lab.connect();
  lab.send(lab.move());
  lab.lines.clear();
  lab.tick(301);
  EXPECT_TRUE(lab.was_told("HALT"));
  EXPECT_EQ(lab.driver.status().state, Status::STATE_STOPPED);
  EXPECT_NE(lab.driver.status().reason.find("in time"), std::string::npos);
}

TEST(RobotDriver, DoesNotMoveWithoutARecordOfTheMotion) {
  Lab lab;
  lab.connect();
  lab.disk_is_full = true;
  const Status answer = lab.send(lab.move());
  EXPECT_EQ(answer.state, Status::STATE_REJECTED);
  EXPECT_NE(answer.reason.find("disk full"), std::string::npos);
  EXPECT_FALSE(lab.was_told("GO"));
  // HOLD and STOP need no record.
  lab.lines.clear();
  EXPECT_EQ(lab.send(lab.make(Command::KIND_STOP)).state, Status::STATE_STOPPED);
  EXPECT_TRUE(lab.was_told("HALT"));
}

TEST(RobotDriver, KnowsAfterARestartWhatItHadBegun) {
  Lab lab;
  lab.connect();
  const Command motion = lab.move();
  lab.send(motion);
  ASSERT_TRUE(lab.record.has_value());
  EXPECT_EQ(lab.record->action_id, motion.action_id);

  // The clock was set back meanwhile.
  Lab restarted(lab.record, kStart - kHour);
  EXPECT_GT(restarted.driver.status().utime, lab.record->utime);
  restarted.is_moving = true;
  restarted.connect();
  restarted.tick();
  EXPECT_TRUE(restarted.driver.is_at_rest());
  const Status answer = restarted.send(motion);
  EXPECT_EQ(answer.state, Status::STATE_STOPPED);
  EXPECT_NE(answer.reason.find("restarted"), std::string::npos);
  Command old = lab.move();
  EXPECT_EQ(restarted.send(old).state, Status::STATE_EXPIRED);
  EXPECT_FALSE(restarted.was_told("GO"));
}

TEST(RobotDriver, BeginsAfterTheLastWordOfTheOneBeforeWhateverTheClockSays) {
  for (const int num_ticks : {1, 37, 200}) {
    Lab lab;
    lab.connect();
    lab.tick(num_ticks);
    ASSERT_TRUE(lab.record.has_value());
    const Lab restarted(lab.record, kStart - kHour);
    EXPECT_GT(restarted.driver.status().utime, lab.driver.status().utime);
    // And not far ahead of a clock that is right.
    const Lab soon(lab.record, lab.now_);
    EXPECT_LE(soon.driver.status().utime, lab.now_ + 5'100'000);
  }
}

TEST(RobotDriver, HaltsTheArmWhenItIsToldToEnd) {
  Lab lab;
  lab.connect();
  lab.send(lab.move());
  lab.lines.clear();
  lab.take(lab.driver.on_end(lab.now()));
  EXPECT_TRUE(lab.was_told("HALT"));
  EXPECT_EQ(lab.driver.status().state, Status::STATE_STOPPED);
  EXPECT_TRUE(lab.driver.is_at_rest());
}

TEST(RobotDriver, RefusesWhatIsNoAction) {
  Lab lab;
  lab.connect();
  for (const std::vector<double>& action :
       std::vector<std::vector<double>>{{0, 0},
                                        {0, 0, 0, 0},
                                        {0, 61, 0},
                                        {-90.001, 0, 0},
                                        {0, std::nan(""), 0},
                                        {std::numeric_limits<double>::infinity(), 0, 0}}) {
    const Status answer = lab.send(lab.move(action));
    EXPECT_EQ(answer.state, Status::STATE_REJECTED);
    EXPECT_NE(answer.reason, "");
  }
  EXPECT_FALSE(lab.was_told("GO"));
}

TEST(RobotDriver, CountsLinesThatAreNoReports) {
  Lab lab;
  lab.connect();
  const std::string n = std::to_string(lab.order);
  for (const std::string& line : {std::string("ERR GO"), std::string(""), "AT " + n + " REST 1 2",
                                  "AT " + n + " REST 1 2 3 4", "AT " + n + " ASLEEP 1 2 3",
                                  "AT " + n + " REST 1 2 x", std::string("AT x REST 1 2 3")}) {
    lab.take(lab.driver.on_line(line, lab.now()));
  }
  EXPECT_EQ(lab.driver.num_strange_lines(), 7);
}

TEST(SerialLine, SpeaksInLinesAndSaysWhenThePortIsGone) {
  const int master = ::posix_openpt(O_RDWR | O_NOCTTY);
  ASSERT_GE(master, 0);
  ASSERT_EQ(::grantpt(master), 0);
  ASSERT_EQ(::unlockpt(master), 0);
  SerialLine port(::ptsname(master));
  ASSERT_TRUE(port.open()) << port.problem();
  EXPECT_FALSE(port.read_line().has_value());
  ASSERT_EQ(::write(master, "one\r\ntw", 7), 7);
  EXPECT_EQ(port.read_line(), "one");
  EXPECT_FALSE(port.read_line().has_value());
  ASSERT_EQ(::write(master, "o\n", 2), 2);
  EXPECT_EQ(port.read_line(), "two");
  EXPECT_TRUE(port.write_line("GO 1"));
  char buffer[16] = "";
  EXPECT_EQ(::read(master, buffer, sizeof buffer), 5);
  EXPECT_STREQ(buffer, "GO 1\n");

  SerialLine second(::ptsname(master));
  EXPECT_FALSE(second.open());
  EXPECT_NE(second.problem().find("another program"), std::string::npos);

  ::close(master);
  EXPECT_FALSE(port.read_line().has_value());
  EXPECT_FALSE(port.is_open());
  EXPECT_FALSE(port.write_line("GO 2"));
  EXPECT_NE(port.problem().find("vanished"), std::string::npos);
  EXPECT_FALSE(SerialLine("/dev/null").open());
}

}  // namespace
}  // namespace bodyschema
