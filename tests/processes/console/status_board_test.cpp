#include "processes/console/status_board.h"

#include <gtest/gtest.h>
#include <pty.h>
#include <unistd.h>

#include <sstream>

#include "common/bus/convert.h"
#include "processes/console/hint.h"
#include "processes/console/views/status_view.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kSecond = 1'000'000;

process_info_t info(const std::string& name, std::int8_t phase = process_info_t::PHASE_WORKING,
                    const std::string& activity = "", std::int32_t pid = 1) {
  process_info_t message{};
  message.utime = 100 * kSecond;
  message.start_utime = 40 * kSecond;
  message.process_name = name;
  message.host = "lab";
  message.pid = pid;
  message.program_version = "1.2.3";
  message.phase = phase;
  message.activity = activity;
  message.resident_bytes = 50'000'000;
  return message;
}

motion_status_t at_rest() {
  motion_status_t status{};
  status.action_id = 7;
  status.source = "motor_babbler";
  status.state = motion_status_t::STATE_SETTLED;
  status.rest_since_utime = 5;
  return status;
}

/// A group of two in which all is well.
StatusBoard board() {
  StatusBoard board({"motor_babbler", "robot_simulator"}, "1.2.3");
  board.begin(0);
  for (const char* channel : {"PROCESS_INFO", "MOTION_STATUS"})
    board.on_arrival(channel, kSecond / 2);
  board.on_message(info("motor_babbler", process_info_t::PHASE_WORKING, "5 samples"));
  board.on_message(info("robot_simulator"));
  board.on_message(at_rest());
  board.end(2 * kSecond);
  return board;
}

BodySchema two_parts() {
  BodySchema schema;
  schema.version = 9;
  schema.num_samples = 7;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"q1", -1, 1}, {"q2", -1, 1}};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.joints = {ScrewJoint{.signal = 1, .turn = 1}, ScrewJoint{.signal = 0, .turn = 1}};
  edge.position_rms_m = 0.0012;
  schema.edges = {edge};
  schema.unconnected = {{3, Unconnected::kNotEnoughData, "seen once"}};
  return schema;
}

TEST(StatusBoardTest, TheFirstLineSaysWhatIsDone) {
  EXPECT_EQ(board().headline(), "Learning: 5 samples.");
  EXPECT_TRUE(status_text(board().status(), 100).starts_with("Learning: 5 samples.\n"));
  StatusBoard done = board();
  done.on_message(info("motor_babbler", process_info_t::PHASE_DONE, "60 samples"));
  EXPECT_EQ(done.headline(),
            "Done: 60 samples. No sample comes any more: what breaks from now on is not noticed.");
  StatusBoard waits = board();
  waits.on_message(info("motor_babbler", process_info_t::PHASE_WAITING, "waiting for SAMPLE"));
  EXPECT_EQ(waits.headline(), "Waits: waiting for SAMPLE.");
}

TEST(StatusBoardTest, WhoeverWaitsThoughThereIsASchemaIsNamed) {
  StatusBoard board_ = board();
  board_.on_message(
      info("observer", process_info_t::PHASE_WAITING, "samples.lcmlog: no space left on device"));
  board_.on_message(info("controller", process_info_t::PHASE_WAITING, "no target"));
  EXPECT_EQ(board_.headline(), "Learning: 5 samples.");
  board_.on_body_schema(to_message(two_parts()));
  EXPECT_EQ(board_.headline(),
            "Learning: 5 samples. observer waits: samples.lcmlog: no space left on device.");
  board_.on_message(info("observer", process_info_t::PHASE_WAITING, "waits for 2 of 2 frames"));
  EXPECT_EQ(board_.headline(), "Learning: 5 samples. observer waits for 2 of 2 frames.");
}

TEST(StatusBoardTest, AStopComesBeforeAllElseAndTheControllerBeforeTheBabbler) {
  StatusBoard board_ = board();
  control_status_t control{};
  control.owns_arm = 1;
  control.control_state = control_status_t::CONTROL_MOVING;
  control.why = "12 mm to go";
  board_.on_message(control);
  EXPECT_EQ(board_.headline(), "The controller has the arm, moving: 12 mm to go.");
  motion_status_t stopped = at_rest();
  stopped.stop_latched = 1;
  board_.on_message(stopped);
  EXPECT_EQ(board_.headline(), "Halted: nothing moves until `bodyschema resume`.");
}

TEST(StatusBoardTest, WhoIsMissingIsNamed) {
  StatusBoard alone({"motor_babbler", "camera", "robot_simulator"}, "1.2.3");
  alone.on_arrival("PROCESS_INFO", 1);
  alone.on_message(info("motor_babbler"));
  EXPECT_EQ(alone.headline(),
            "Waits for a driver: nobody sends MOTION_STATUS. Not heard: camera, robot_simulator.");
  EXPECT_NE(status_text(alone.status(), 100).find("! not heard: camera, robot_simulator\n"),
            std::string::npos);
  // Any driver will do.
  alone.on_message(at_rest());
  EXPECT_TRUE(alone.headline().ends_with("Not heard: camera."));
  // A process that has ended is as good as not there.
  alone.on_message(info("camera"));
  EXPECT_EQ(alone.headline().find("Not heard"), std::string::npos);
  alone.on_message(info("camera", process_info_t::PHASE_ENDED));
  EXPECT_TRUE(alone.headline().ends_with("Not heard: camera."));
}

TEST(StatusBoardTest, TwinsAndOtherVersionsAreNamed) {
  StatusBoard board_ = board();
  board_.on_message(info("motor_babbler", process_info_t::PHASE_WORKING, "", 22));
  process_info_t old = info("camera");
  old.program_version = "1.0.0";
  board_.on_message(old);
  const std::string text = status_text(board_.status(), 120);
  EXPECT_NE(text.find("! motor_babbler runs more than once (pid 1 on lab, pid 22 on lab)"),
            std::string::npos)
      << text;
  EXPECT_NE(text.find("! camera on lab is of version 1.0.0, this command of 1.2.3"),
            std::string::npos)
      << text;
  EXPECT_EQ(status_json(board_.status())["twins"], nlohmann::ordered_json({"motor_babbler"}));
  // One that was started again after it had ended is no twin.
  board_.on_message(info("motor_babbler", process_info_t::PHASE_ENDED));
  EXPECT_EQ(status_json(board_.status())["twins"], nlohmann::ordered_json::array());
}

TEST(StatusBoardTest, ProcessorTimeIsThatOfTheWindowWhereThereIsOne) {
  StatusBoard board_ = board();
  process_info_t first = info("camera");
  first.cpu_us = 30 * kSecond;  // half of its minute
  board_.on_message(first);
  EXPECT_DOUBLE_EQ(status_json(board_.status())["processes"][0]["cpu_percent"].get<double>(), 50);
  process_info_t second = first;
  second.utime += kSecond;
  second.cpu_us += kSecond / 4;
  board_.on_message(second);
  const auto json = status_json(board_.status())["processes"][0];
  EXPECT_EQ(json["name"], "camera");
  EXPECT_DOUBLE_EQ(json["cpu_percent"].get<double>(), 25);
  EXPECT_DOUBLE_EQ(json["age_s"].get<double>(), 61);
  EXPECT_EQ(json["resident_bytes"], 50'000'000);
}

TEST(StatusBoardTest, ChannelsHaveTheirRateAndAge) {
  StatusBoard board_({}, "1.2.3");
  board_.begin(0);
  for (int i = 1; i <= 10; ++i) board_.on_arrival("SAMPLE", i * kSecond / 10);
  board_.end(2 * kSecond);
  const auto json = status_json(board_.status())["channels"]["SAMPLE"];
  EXPECT_EQ(json["count"], 10);
  EXPECT_DOUBLE_EQ(json["rate_hz"].get<double>(), 5);
  EXPECT_DOUBLE_EQ(json["age_s"].get<double>(), 1);
}

TEST(StatusBoardTest, LossesAreThoseOfWhomTheyHitMost) {
  StatusBoard board_ = board();
  const auto with = [](process_info_t message, std::vector<std::pair<std::string, int>> counts) {
    for (const auto& [name, count] : counts) {
      counter_t counter{};
      counter.counter_name = name;
      counter.count = count;
      message.counters.push_back(counter);
    }
    message.num_counters = static_cast<std::int32_t>(message.counters.size());
    return message;
  };
  board_.on_message(
      with(info("motor_babbler"),
           {{"malformed SAMPLE", 3}, {"received SAMPLE", 99}, {"senseless SAMPLE", 0}}));
  board_.on_message(with(info("robot_simulator"),
                         {{"malformed SAMPLE", 5}, {"refused SAMPLE", 1}, {"tag too small", 4}}));
  board_.on_arrival("SAMPLE", 1);
  board_.on_own_counters({{"malformed SAMPLE", 2}, {"senseless CAMERA_INFO", 6}});
  const auto json = status_json(board_.status());
  EXPECT_EQ(json["channels"]["SAMPLE"]["dropped"],
            nlohmann::ordered_json({{"malformed", 5}, {"refused", 1}}));
  // Nothing but garbage came there.
  EXPECT_EQ(json["channels"]["CAMERA_INFO"]["count"], 0);
  EXPECT_TRUE(json["channels"]["CAMERA_INFO"]["age_s"].is_null());
  const std::string text = status_text(board_.status(), 100);
  EXPECT_NE(text.find("5 malformed, 1 refused"), std::string::npos) << text;
  EXPECT_NE(text.find("6 senseless"), std::string::npos) << text;
  EXPECT_NE(text.find("robot_simulator counted 4 tag too small"), std::string::npos) << text;
  EXPECT_EQ(text.find("99"), std::string::npos) << text;
}

TEST(StatusBoardTest, TheBodySchemaStandsBeforeAProposal) {
  StatusBoard board_ = board();
  EXPECT_NE(status_text(board_.status(), 100).find("schema   none yet"), std::string::npos);
  BodySchema proposal = two_parts();
  proposal.version = 0;
  board_.on_learned_schema(to_message(proposal));
  EXPECT_NE(status_text(board_.status(), 100)
                .find("none accepted yet; proposal, incomplete: 3 parts, 1 edges"),
            std::string::npos)
      << status_text(board_.status(), 100);
  EXPECT_FALSE(status_json(board_.status())["schema"]["accepted"].get<bool>());
  board_.on_body_schema(to_message(two_parts()));
  board_.on_learned_schema(to_message(proposal));
  EXPECT_EQ(status_json(board_.status())["schema"]["version"], 9);
  EXPECT_TRUE(status_json(board_.status())["schema"]["accepted"].get<bool>());
}

TEST(StatusBoardTest, TagsThatAreSetAsideAreNamedUntilTheyAreBack) {
  StatusBoard board_ = board();
  BodySchema schema = two_parts();
  schema.moved_tags = {{20, 40, 38, -1}, {21, 41, 39, 60}};
  board_.on_body_schema(to_message(schema));
  EXPECT_NE(status_text(board_.status(), 200).find("tag 20 is set aside since sample 40"),
            std::string::npos)
      << status_text(board_.status(), 200);
  EXPECT_EQ(status_text(board_.status(), 200).find("tag 21"), std::string::npos);
}

TEST(StatusBoardTest, AnEdgeIsShownWithItsHealth) {
  StatusBoard board_ = board();
  board_.on_body_schema(to_message(two_parts()));
  model_health_t health{};
  edge_health_t of_edge{};
  of_edge.health_from = 1;
  of_edge.health_to = 2;
  of_edge.edge_state = schema_edge_t::EDGE_SUSPECT;
  of_edge.num_tests = 4;
  of_edge.median_mahalanobis2 = 12.3;
  set_array(health.num_edges, health.edge_health, {of_edge});
  part_health_t part{};
  part.health_part = 2;
  part.visibility = 0.5;
  part.position_median_m = -1;
  set_array(health.num_parts, health.part_health, {part});
  health_event_t event{};
  event.event_sample = 14;
  event.event_text = "version 9 accepted";
  set_array(health.num_events, health.events, {event});
  board_.on_message(health);
  sample_t sample{};
  sample.sample_index = 37;
  sample.utime = 3'600'000'000;
  board_.on_message(sample);
  const auto edge = status_json(board_.status())["schema"]["edges"][0];
  EXPECT_EQ(edge["signals"], nlohmann::ordered_json({"q2", "q1"}));
  EXPECT_EQ(edge["state"], "SUSPECT");
  EXPECT_EQ(edge["median_mahalanobis2"], 12.3);
  const std::string text = status_text(board_.status(), 100);
  EXPECT_NE(text.find("1 → 2   SUSPECT      screw  {q2,q1}        1.20 mm   0.00°     4      12.3"),
            std::string::npos)
      << text;
  EXPECT_NE(text.find("not connected: not enough data yet: seen once"), std::string::npos) << text;
  EXPECT_NE(text.find("sample 14, 23 samples ago: version 9 accepted"), std::string::npos) << text;
  EXPECT_TRUE(status_json(board_.status())["parts"][0]["position_median_m"].is_null());
}

/// A joint that is stuck and mended, and another place that nothing explains.
model_health_t wrong_in_two_places() {
  model_health_t health{};
  finding_t stuck{};
  stuck.finding_state = finding_t::FINDING_CONFIRMED;
  stuck.finding_from = 1;
  stuck.finding_to = 2;
  stuck.finding_part = stuck.finding_tag = -1;
  stuck.finding_cause = health_event_t::CAUSE_JOINT_STUCK;
  stuck.finding_size.size_kind = change_size_t::SIZE_COMMAND;
  stuck.finding_size.size_signal = 1;
  set_array(stuck.finding_size.num_amounts, stuck.finding_size.amount, {-0.25});
  stuck.finding_size.amount_sd = {-1};
  stuck.finding_since = stuck.finding_found = 290;
  stuck.finding_adopted = 291;
  stuck.num_confirming = 40;
  stuck.finding_text =
      "q2 (1→2) stuck at −0.25 since sample 290, in the schema since 291, confirmed by 40 samples";
  finding_t open{};
  open.finding_from = open.finding_to = open.finding_tag = -1;
  open.finding_part = 3;
  open.finding_size.size_signal = -1;
  open.finding_since = 300;
  open.finding_found = 301;
  open.finding_adopted = -1;
  open.finding_text = "marker of part 3 not as known since sample 300, found at 301";
  set_array(health.num_findings, health.findings, {stuck, open});
  return health;
}

TEST(StatusBoardTest, WhatIsWrongStandsFirstAndNoTerminalIsTooNarrowForIt) {
  StatusBoard board_ = board();
  BodySchema schema = two_parts();
  schema.complete = true;
  board_.on_body_schema(to_message(schema));
  board_.on_message(model_health_t{});
  EXPECT_TRUE(
      status_text(board_.status(), 100)
          .starts_with("Learning: 5 samples.\nNothing is known to be wrong with the body.\n"))
      << status_text(board_.status(), 100);
  EXPECT_TRUE(status_json(board_.status())["wrong"].empty());
  model_health_t doubted{};
  edge_health_t edge{};
  edge.health_from = 1;
  edge.health_to = 2;
  edge.edge_state = schema_edge_t::EDGE_SUSPECT;
  set_array(doubted.num_edges, doubted.edge_health, {edge});
  board_.on_message(doubted);
  EXPECT_TRUE(
      status_text(board_.status(), 100)
          .starts_with(
              "Learning: 5 samples.\nNothing is known to be wrong with the body; in doubt: 1→2.\n"))
      << status_text(board_.status(), 100);
  board_.on_message(wrong_in_two_places());
  EXPECT_TRUE(
      status_text(board_.status(), 100)
          .starts_with("What is wrong now\n"
                       "  q2 (1→2) stuck at −0.25 since sample 290, in the schema since 291, "
                       "confirmed by 40 samples\n"
                       "  marker of part 3 not as known since sample 300, found at 301\n\n"
                       "Learning: 5 samples.\nThe body is not as the schema says in 1 place.\n"))
      << status_text(board_.status(), 100);
  const std::string narrow = status_text(board_.status(), 40);
  EXPECT_TRUE(
      narrow.starts_with("What is wrong now\n"
                         "  q2 (1→2) stuck at −0.25 since sample\n"
                         "    290, in the schema since 291,\n"
                         "    confirmed by 40 samples\n"))
      << narrow;
  const auto wrong = status_json(board_.status())["wrong"];
  ASSERT_EQ(wrong.size(), 2U);
  EXPECT_EQ(wrong[0]["state"], "confirmed");
  EXPECT_EQ(wrong[0]["signal"], "q2");
  EXPECT_EQ(wrong[0]["amount"]["command"], -0.25);
  EXPECT_TRUE(wrong[0]["amount_sd"]["command"].is_null());
  EXPECT_EQ(wrong[0]["since"], 290);
  EXPECT_EQ(wrong[0]["adopted"], 291);
  EXPECT_TRUE(wrong[1]["amount"].is_null());
  EXPECT_TRUE(wrong[1]["signal"].is_null());
  EXPECT_TRUE(wrong[1]["adopted"].is_null());
  // Before the body is known nothing can be said of it.
  schema.complete = false;
  board_.on_body_schema(to_message(schema));
  EXPECT_TRUE(status_text(board_.status(), 100).starts_with("Learning: 5 samples.\n\n"))
      << status_text(board_.status(), 100);
}

TEST(StatusBoardTest, ANarrowTerminalKeepsTheHealthOfAnEdge) {
  StatusBoard board_ = board();
  board_.on_body_schema(to_message(two_parts()));
  model_health_t health{};
  edge_health_t of_edge{};
  of_edge.health_from = 1;
  of_edge.health_to = 2;
  of_edge.edge_state = schema_edge_t::EDGE_PROVISIONAL;
  set_array(health.num_edges, health.edge_health, {of_edge});
  part_health_t part{};
  part.health_part = 2;
  part.part_state = schema_edge_t::EDGE_INVALID;
  set_array(health.num_parts, health.part_health, {part});
  board_.on_message(health);
  const std::string text = status_text(board_.status(), 30);
  EXPECT_NE(text.find("1 → 2   PROVISIONAL"), std::string::npos) << text;
  EXPECT_NE(text.find("2         INVALID"), std::string::npos) << text;
}

TEST(StatusBoardTest, FaultsAreMarkedAsGroundTruth) {
  StatusBoard board_ = board();
  EXPECT_EQ(status_text(board_.status(), 100).find("faults"), std::string::npos);
  EXPECT_TRUE(status_json(board_.status())["faults"].is_null());
  sim_state_t state{};
  set_array(state.num_faults, state.faults, {"stuck q3", "bend link2 10°"});
  board_.on_message(state);
  EXPECT_NE(status_text(board_.status(), 100)
                .find("faults   stuck q3, bend link2 10°   (ground truth of the simulation)"),
            std::string::npos)
      << status_text(board_.status(), 100);
}

TEST(StatusBoardTest, WhatWasNotHeardIsNull) {
  StatusBoard board_({}, "1.2.3");
  board_.begin(0);
  for (const char* key : {"arm", "control", "newest_sample", "faults", "schema", "parts", "events"})
    EXPECT_TRUE(status_json(board_.status()).at(key).is_null()) << key;
  control_status_t control{};
  control.target_part = -1;
  control.predicted_error_m = control.observed_error_m = -1;
  board_.on_message(control);
  motion_status_t motion{};
  motion.action_id = -1;
  board_.on_message(motion);
  board_.on_message(model_health_t{});
  const auto json = status_json(board_.status());
  for (const char* key : {"target_part", "predicted_error_m", "observed_error_m"})
    EXPECT_TRUE(json["control"].at(key).is_null()) << key;
  EXPECT_TRUE(json["arm"]["action_id"].is_null());
  EXPECT_EQ(json["parts"], nlohmann::ordered_json::array());
  control.observed_error_m = 0.25;
  board_.on_message(control);
  EXPECT_EQ(status_json(board_.status())["control"]["observed_error_m"], 0.25);
}

TEST(StatusBoardTest, SilenceAndGarbageAreTold) {
  StatusBoard board_({"camera"}, "1.2.3");
  board_.begin(0);
  board_.end(kSecond);
  EXPECT_TRUE(board_.is_silent());
  board_.on_own_counters({{"received SAMPLE", 0}, {"malformed SAMPLE", 0}});
  EXPECT_TRUE(board_.is_silent());
  board_.on_own_counters({{"malformed SAMPLE", 3}});
  EXPECT_FALSE(board_.is_silent());
  EXPECT_TRUE(board_.headline().starts_with("Nothing but garbage"));
  EXPECT_NO_THROW(status_json(board_.status()));
}

TEST(StatusBoardTest, NoLineIsWiderThanTheTerminalAndNoneObeysAMessage) {
  StatusBoard board_ = board();
  std::string hostile = "\x1b[2J\nmm·°→";
  for (int i = 0; i < 6; ++i) hostile += hostile;
  board_.on_message(info("motor_babbler", process_info_t::PHASE_WORKING, hostile));
  board_.on_message(info(std::string(63, 'n'), process_info_t::PHASE_WAITING, hostile));
  board_.on_body_schema(to_message(two_parts()));
  const std::string text = status_text(board_.status(), 60);
  EXPECT_EQ(text.find('\x1b'), std::string::npos);
  std::istringstream lines(text);
  std::string line;
  std::getline(lines, line);  // the headline is never cut
  int num_cut = 0;
  while (std::getline(lines, line)) {
    const auto is_first_byte = [](char c) {
      return (static_cast<unsigned char>(c) & 0xC0) != 0x80;
    };
    EXPECT_LE(std::count_if(line.begin(), line.end(), is_first_byte), 60) << line;
    num_cut += line.ends_with("…");
  }
  EXPECT_GT(num_cut, 2);
}

TEST(WrapTest, BreaksBetweenWords) {
  EXPECT_EQ(wrap("one two three", 9, 0), "one two\n  three\n");
  EXPECT_EQ(wrap("one two three", 100, 4), "    one two three\n");
  EXPECT_EQ(wrap("äöü äöü", 3, 0), "äöü\n  …\n");
  EXPECT_EQ(wrap("", 5, 2), "  \n");
}

TEST(FitTest, CutsBetweenCharacters) {
  EXPECT_EQ(fit("abc", 3), "abc");
  EXPECT_EQ(fit("abcd", 3), "ab…");
  EXPECT_EQ(fit("äöüß", 4), "äöüß");
  EXPECT_EQ(fit("äöüßx", 4), "äöü…");
  EXPECT_EQ(fit("a\tb\nc", 10), "a b c");
  EXPECT_EQ(fit("a\xC2\x9B"
                "b",
                10),
            "a b");  // a control character of two bytes
  EXPECT_EQ(fit("", 0), "");
}

TEST(InPlaceTest, ALineFitsTheTerminal) {
  int outer = -1, terminal = -1;
  const winsize size{24, 8, 0, 0};
  ASSERT_EQ(::openpty(&outer, &terminal, nullptr, nullptr, &size), 0);
  EXPECT_EQ(terminal_width(terminal), 8);
  EXPECT_EQ(in_place("12 of 300 samples", terminal), "\r\x1b[2K12 of 3…");
  ::close(outer);
  ::close(terminal);
}

}  // namespace
}  // namespace bodyschema
