#include "processes/console/watch.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <spawn.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <deque>
#include <fstream>
#include <iostream>
#include <iterator>
#include <memory>
#include <set>
#include <system_error>
#include <utility>

#include "common/bus/bus.h"
#include "common/bus/event_log.h"
#include "common/bus/images_url.h"
#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "common/config/rig.h"
#include "common/geometry/angle.h"
#include "processes/console/health_view.h"
#include "processes/console/interruption.h"
#include "processes/console/picture.h"
#include "processes/console/run_watch.h"
#include "processes/console/schema_json.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema {
namespace {

using Clock = std::chrono::steady_clock;

struct WatchArguments {
  std::string in = default_url();
  std::string images;
  std::string rig_folder;
  std::string rig;
  std::string out;
  std::int64_t seed = 0;
  std::int64_t samples = 0;
  double patience_s = 120;
  std::set<std::string> processes;
  std::string replay;
  std::string replay_from;
  double speed = 0;
};

/// Keeps the picture with the most markers whose image and markers were both heard.
class BestPicture {
 public:
  void on_image(const camera_image_t& image) {
    images_.push_back(image);
    if (images_.size() > 8) images_.pop_front();
    match();
  }
  void on_markers(const marker_poses_t& markers) {
    markers_.push_back(markers);
    if (markers_.size() > 8) markers_.pop_front();
    match();
  }
  void on_info(const camera_info_t& info) { info_ = info; }
  bool write(const std::filesystem::path& png) const {
    if (!best_image_ || !info_) return false;
    write_detections(*best_image_, best_markers_, *info_, png);
    return true;
  }

 private:
  void match() {
    for (const camera_image_t& image : images_) {
      for (const marker_poses_t& markers : markers_) {
        if (image.utime != markers.utime || image.camera_name != markers.camera_name ||
            markers.num_markers <= best_markers_.num_markers)
          continue;
        best_image_ = image;
        best_markers_ = markers;
      }
    }
  }

  std::deque<camera_image_t> images_;
  std::deque<marker_poses_t> markers_;
  std::optional<camera_info_t> info_;
  std::optional<camera_image_t> best_image_;
  marker_poses_t best_markers_{};
};

class ProgressLine {
 public:
  void show(const std::string& line, bool now) {
    const auto time = Clock::now();
    const double age = std::chrono::duration<double>(time - shown_).count();
    // A terminal gets a line that rewrites itself, a file one line every five seconds.
    if (!now && age < (is_terminal_ ? 0.1 : 5.0)) return;
    shown_ = time;
    if (is_terminal_) {
      std::cerr << "\r\x1b[2K" << line << std::flush;
    } else {
      std::cerr << line << std::endl;
    }
  }
  void end() {
    if (is_terminal_) std::cerr << std::endl;
  }

 private:
  const bool is_terminal_ = isatty(STDERR_FILENO);
  Clock::time_point shown_{};
};

/// Plays a recording onto the bus with lcm-logplayer: what the learning half of the group needs,
/// never a command.
class Player {
 public:
  ~Player() {
    if (pid_ <= 0 || has_ended_) return;
    ::kill(pid_, SIGTERM);
    ::waitpid(pid_, nullptr, 0);
  }

  bool has_started() const { return pid_ > 0; }
  void start(const WatchArguments& arguments) {
    const std::string channels =
        arguments.replay_from == kSample.name
            ? kSample.name
            : fmt::format("({}|{}|{})", kMarkerPoses.name, kMotionStatus.name, kCameraInfo.name);
    const std::vector<std::string> words = {"setpriv",
                                            "--pdeathsig",
                                            "TERM",
                                            "lcm-logplayer",
                                            "-s",
                                            fmt::format("{}", arguments.speed),
                                            "-e",
                                            channels,
                                            "--lcm-url=" + arguments.in,
                                            arguments.replay};
    std::vector<char*> argv;
    for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
    argv.push_back(nullptr);
    posix_spawn_file_actions_t actions;
    ::posix_spawn_file_actions_init(&actions);
    ::posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
    const int error = ::posix_spawnp(&pid_, argv[0], &actions, nullptr, argv.data(), environ);
    ::posix_spawn_file_actions_destroy(&actions);
    if (error != 0) {
      throw std::runtime_error(fmt::format("lcm-logplayer: {}; it is in Debian's liblcm-bin",
                                           std::generic_category().message(error)));
    }
  }
  /// @throws std::runtime_error if it failed.
  bool is_running() {
    if (pid_ <= 0 || has_ended_) return false;
    int status = 0;
    if (::waitpid(pid_, &status, WNOHANG) == 0) return true;
    has_ended_ = true;
    if (status != 0) throw std::runtime_error("lcm-logplayer failed");
    return false;
  }

 private:
  pid_t pid_ = -1;
  bool has_ended_ = false;
};

/// The simulator's truth of a recorded run is read from the recording: it does not go on a bus.
void read_truth(const std::string& log, RunWatch& watch) {
  try {
    for_each_event(log, [&](const LogEvent& event) {
      if (event.channel != kSimState.name) return;
      const auto state = decode<sim_state_t>(event.data.data(), event.data.size());
      if (state.message) watch.on_sim_state(*state.message);
    });
  } catch (const std::runtime_error&) {
    // Damaged in the middle: what stands before that is used, as everywhere.
  }
}

/// Messages of a channel in a recording, as far as it can be read.
std::int64_t count_messages(const std::string& log, const std::string& channel) {
  std::int64_t count = 0;
  try {
    for_each_event(log, [&](const LogEvent& event) { count += event.channel == channel; });
  } catch (const std::runtime_error&) {
    // As above.
  }
  return count;
}

/// What a replay could not use.
struct Lost {
  std::vector<std::pair<std::int64_t, std::int64_t>> samples;  ///< first and last index
  std::int64_t frames = 0;                                     ///< that were played and not heard
};

/// What was learned from all samples. The body schema is the monitor's where it accepted one; a
/// schema does not carry its outliers, so learning again from the same samples names them.
struct Learned {
  BodySchema schema;
  std::vector<Outlier> outliers;
  bool is_accepted = false;
};

Learned learn_again(const RunWatch& watch, const WatchArguments& arguments) {
  const StructureLearnerConfig config = StructureLearnerConfig::load(
      std::filesystem::path(arguments.rig_folder) / "structure_learner.yaml");
  std::vector<ActionPoseSample> training;
  for (const ActionPoseSample& sample : watch.samples()) {
    if (sample.purpose == Purpose::kTrain || sample.purpose == Purpose::kProbe)
      training.push_back(sample);
  }
  LearnOptions options = config.options;
  if (std::none_of(training.begin(), training.end(), [&](const ActionPoseSample& sample) {
        return options.root && sample.find(*options.root);
      })) {
    options.root.reset();
  }
  const LearnResult learned = learn(config.signals, training, options);
  return {watch.schema().value_or(learned.schema), learned.outliers, watch.schema().has_value()};
}

/// What MODEL_HEALTH last said, of a schema that the monitor accepted.
model_health_t health_of(const RunWatch& watch) {
  return watch.health().value_or(model_health_t{});
}

/// How many samples there will be; std::nullopt in a replay, which has what it has.
std::optional<SampleGoal> goal_of(const WatchArguments& arguments) {
  if (!arguments.replay.empty()) return std::nullopt;
  if (arguments.samples > 0) return SampleGoal{arguments.samples, true};
  const auto file = std::filesystem::path(arguments.rig_folder) / "motor_babbler.yaml";
  // A rig that is moved by somebody else has none.
  if (!std::filesystem::exists(file)) return std::nullopt;
  return SampleGoal{MotorBabblerConfig::load(file).stop.max_samples, false};
}

nlohmann::ordered_json result_json(const RunWatch& watch, const Learned& learned,
                                   const WatchArguments& arguments, const Lost& lost,
                                   double seconds) {
  const Signals signals = load_signals(arguments.rig_folder);
  const auto held_out = watch.held_out(watch.body_since());
  nlohmann::ordered_json json = {
      {"rig", arguments.rig},
      {"seed", arguments.replay.empty() ? nlohmann::ordered_json(arguments.seed) : nullptr},
      {"samples", watch.num_samples()},
      {"seconds", std::round(seconds * 10) / 10},
      {"end_effector", signals.end_effector_part},
      {"accepted", learned.is_accepted},
      {"structure", structure_json(learned.schema, learned.outliers)},
      {"held_out", watch.has_truth() ? errors_json(static_cast<int>(held_out.size()),
                                                   judge(learned.schema, held_out, held_out))
                                     : errors_json(static_cast<int>(held_out.size()),
                                                   evaluate(learned.schema, held_out))},
      {"held_out_since", watch.body_since()},
      {"held_out_against", watch.has_truth() ? "noise-free simulator" : "observations"},
      {"visibility", nlohmann::ordered_json::object()}};
  if (!arguments.replay.empty()) {
    json["replay_of"] = arguments.replay;
    json["lost_frames"] = lost.frames;
  }
  json["lost_samples"] = lost.samples;
  std::vector<std::string> names;
  for (const Signal& signal : learned.schema.signals) names.push_back(signal.name);
  json["wrong"] = nlohmann::ordered_json::array();
  for (const finding_t& finding : health_of(watch).findings)
    json["wrong"].push_back(finding_json(finding, names));
  for (const auto& [part, share] : watch.visibility())
    json["visibility"][std::to_string(part)] = share;
  return json;
}

void report(const RunWatch& watch, const BestPicture& picture, const WatchArguments& arguments,
            const Lost& lost, double seconds) {
  const std::filesystem::path folder = arguments.out;
  const Learned learned = learn_again(watch, arguments);
  write_file_atomically(folder / "result.json",
                        result_json(watch, learned, arguments, lost, seconds).dump(2) + "\n");
  picture.write(folder / "detections.png");

  const auto held_out = watch.held_out(watch.body_since());
  const std::string origin = arguments.replay.empty() ? fmt::format("seed {}", arguments.seed)
                                                      : "replay of " + arguments.replay;
  std::cout << fmt::format("\n{} · {} · {} samples, {} of them held out · {:.0f} s\n\n",
                           arguments.rig, origin, watch.num_samples(), held_out.size(), seconds);
  const BodyVerdict verdict = verdict_of(health_of(watch));
  if (!verdict.wrong.empty()) {
    std::cout << kWhatIsWrong << "\n";
    for (const std::string& wrong : verdict.wrong) std::cout << "  " << wrong << "\n";
    std::cout << verdict.sentence << "\n" << kNobodyWatches << "\n\n";
  } else if (verdict.is_in_doubt) {
    std::cout << verdict.sentence << "\n\n";
  }
  for (const auto& [first, last] : lost.samples) {
    std::cout << (first == last ? fmt::format("lost SAMPLE {}\n", first)
                                : fmt::format("lost SAMPLE {}…{}\n", first, last));
  }
  if (lost.frames > 0) {
    std::cout << fmt::format(
        "{} of the played {} were not heard: play it slower, or at --speed 0\n", lost.frames,
        arguments.replay_from);
  }
  if (!learned.is_accepted) {
    std::cout << "The monitor accepted no body schema: too few samples, or each proposal was "
                 "refuted. The newest proposal:\n";
  }
  std::cout << structure_text(learned.schema);
  if (!held_out.empty()) {
    std::cout << "\nHeld-out error of each part relative to the root, against "
              << (watch.has_truth() ? "the simulator's noise-free truth" : "what the camera saw")
              << (watch.body_since() > 0
                      ? fmt::format(", since the body last changed (sample {})", watch.body_since())
                      : "")
              << "\n"
              << (watch.has_truth() ? errors_text(judge(learned.schema, held_out, held_out))
                                    : errors_text(evaluate(learned.schema, held_out)));
    if (watch.has_truth() && watch.health() && watch.health()->worst_position_m >= 0) {
      std::cout << fmt::format(
          "(The line of progress and `status` go by what the camera sees, noise and bias of the "
          "markers included: worst part {:.1f} mm {:.2f}°.)\n",
          watch.health()->worst_position_m * 1e3, watch.health()->worst_rotation_rad / kDegree);
    }
  }
  std::cout << "\nFiles in " << folder.string() << "\n";
  // On one of several hosts, or in a replay, not all of them are here.
  const std::vector<std::pair<std::string, std::string>> files = {
      {"result.json", "this table"},
      {"report.html", "the same with pictures and plots, for a browser"},
      {"detections.png", "a camera frame with the markers found in it"},
      {"schema.lcmlog", "the body schema: ./run show FILE"},
      {"samples.lcmlog", "the samples: ./run learn FILE"},
      {"run.lcmlog.00", "everything on the bus but images"}};
  for (const auto& [name, what] : files) {
    if (std::filesystem::exists(folder / name))
      std::cout << fmt::format("  {:<18} {}\n", name, what);
  }
  std::cout << std::flush;
}

/// Tells once of each process that ended (it is heard again and again as it starts). @throws
/// std::runtime_error if the rig's files are to blame: those do not mend themselves.
void tell_of_failures(const WatchArguments& arguments, std::set<std::string>* told) {
  for (const std::string& name : arguments.processes) {
    std::ifstream file(std::filesystem::path(arguments.out) / (name + ".log"));
    const std::string why = last_words({std::istreambuf_iterator<char>(file), {}}, name);
    if (why.empty()) continue;
    const std::string text = name + " does not start: " + why;
    if (why.find(arguments.rig_folder) != std::string::npos)
      throw std::runtime_error(text + "\nThat is this run's copy of the rig: mend the rig's own " +
                               "file and start again.");
    if (told->insert(text).second) std::cerr << "\n" << text << "; it is tried again" << std::endl;
  }
}

void run_watch(const WatchArguments& arguments) {
  // stdout is for the result.
  spdlog::set_default_logger(spdlog::stderr_color_mt("watch"));
  catch_interruption();
  RunWatch watch;
  BestPicture picture;
  const auto microseconds = [](auto duration) {
    return std::chrono::duration_cast<std::chrono::microseconds>(duration).count();
  };
  const auto now_us = [&] { return microseconds(Clock::now().time_since_epoch()); };
  const bool is_replay = !arguments.replay.empty();
  Bus bus(arguments.in, is_replay ? "" : arguments.in);
  Bus images(arguments.images.empty() ? images_url(arguments.in) : arguments.images, "");
  const bool is_played = is_replay && arguments.speed > 0;
  const std::string listener =
      arguments.replay_from == kSample.name ? "structure_learner" : "observer";
  // Where the observer runs on another host, a sample that a lost frame took is asked for.
  SampleIntake::Ask ask = [&](sample_request_t request) {
    request.process_name = "watch";
    bus.publish(kSampleRequest, request);
  };
  if (is_replay && !(is_played && listener == "observer")) ask = nullptr;
  // What another rig's group says, or a recording that is played, is none of this run.
  const RigDoor door(arguments.rig_folder);
  SampleIntake intake((std::filesystem::path(arguments.out) / "samples.lcmlog").string(),
                      [&](const sample_t& m) {
                        if (door.objection(m).empty()) watch.on_sample(m);
                      },
                      ask);
  const auto hear = [&](const auto& channel, auto handler) {
    bus.subscribe(channel, [&door, handler](const auto& m) {
      if (door.objection(m).empty()) handler(m);
    });
  };
  hear(kSample, [&](const sample_t& m) { intake.on_sample(m); });
  hear(kBodySchema, [&](const body_schema_t& m) { watch.on_body_schema(m); });
  hear(kLearnedSchema, [&](const body_schema_t& m) { watch.on_learned_schema(m); });
  hear(kModelHealth, [&](const model_health_t& m) { watch.on_model_health(m); });
  hear(kSimState, [&](const sim_state_t& m) { watch.on_sim_state(m); });
  hear(kMarkerPoses, [&](const marker_poses_t& m) { picture.on_markers(m); });
  hear(kCameraInfo, [&](const camera_info_t& m) { picture.on_info(m); });
  bus.subscribe(kProcessInfo, [&](const process_info_t& m) {
    const auto wall_clock_us = microseconds(std::chrono::system_clock::now().time_since_epoch());
    if (is_live(m, wall_clock_us)) watch.on_process_info(m, now_us());
  });
  images.subscribe<camera_image_t>(kCameraImage,
                                   [&](const camera_image_t& m) { picture.on_image(m); });

  const auto start = Clock::now();
  const auto seconds = [&start] {
    return std::chrono::duration<double>(Clock::now() - start).count();
  };
  ProgressLine line;
  Player player;
  if (is_replay) read_truth(arguments.replay, watch);
  // ./run starts this again after a crash: what went over the bus before is in the run's logs.
  for (int part = 0; !is_replay; ++part) {
    const std::string log = fmt::format("{}/run.lcmlog.{:02}", arguments.out, part);
    if (!std::filesystem::exists(log)) break;
    read_truth(log, watch);
  }
  std::int64_t last_progress = 0;
  double progressed_s = 0, warned_s = 0, played_s = 0, looked_s = 0;
  const std::optional<SampleGoal> goal = goal_of(arguments);
  Pace pace;
  const auto progress_line = [&] {
    const auto left_s =
        goal ? pace.seconds_for(goal->most - watch.num_samples()) : std::optional<double>();
    return fmt::format("{} · {:.0f} s", watch.progress(goal, left_s), seconds());
  };
  std::set<std::string> told;
  // Every message that is played is heard by who makes samples of it, or lost.
  const std::int64_t num_played =
      is_played ? count_messages(arguments.replay, arguments.replay_from) : 0;
  const auto num_heard = [&] {
    return watch.counter(listener, "received " + arguments.replay_from);
  };
  const auto is_finished = [&] {
    if (!is_replay) return watch.is_finished();
    if (arguments.speed == 0) return watch.is_caught_up();
    // What is played before somebody listens is lost.
    if (!player.has_started() && watch.are_listening(arguments.processes, now_us()))
      player.start(arguments);
    if (!player.has_started() || player.is_running()) {
      played_s = seconds();
      return false;
    }
    // Whoever listens may have messages before it still; what is lost will not come.
    const double waited_s = seconds() - std::max(played_s, progressed_s);
    if (num_heard() < num_played && waited_s < 5) return false;
    if (watch.num_samples() == 0 && seconds() - played_s > 10)
      throw std::runtime_error(
          "the recording gave no sample: it holds no settled action that was seen");
    return waited_s > 1 && watch.is_caught_up();
  };
  while (!is_finished() && !is_interrupted()) {
    images.handle(std::chrono::milliseconds(0));
    bus.handle(std::chrono::milliseconds(50));
    intake.on_tick(now_us());
    const std::int64_t progress = watch.num_samples() + watch.learned_sample() + num_heard();
    if (std::exchange(last_progress, progress) != progress) progressed_s = seconds();
    pace.note(seconds(), watch.num_samples());
    line.show(progress_line(), false);
    if (seconds() - looked_s > 2 && watch.num_samples() == 0) {
      looked_s = seconds();
      tell_of_failures(arguments, &told);
    }
    const double stalled_s = seconds() - std::max(progressed_s, warned_s);
    if (stalled_s > 20) {
      warned_s = seconds();
      line.end();
      std::cerr << fmt::format("nothing new for {:.0f} s:\n", seconds() - progressed_s)
                << watch.diagnosis(arguments.processes, now_us());
    }
    if (seconds() - progressed_s > arguments.patience_s) {
      throw std::runtime_error(
          fmt::format("nothing new for {:.0f} s, so I give up; the processes' own words are in {}",
                      arguments.patience_s, arguments.out));
    }
  }
  line.show(progress_line(), true);
  line.end();
  const Lost lost{intake.lost(), std::max<std::int64_t>(0, num_played - num_heard())};
  report(watch, picture, arguments, lost, seconds());
  if (is_interrupted()) throw std::runtime_error("interrupted before the end");
}

}  // namespace

void add_watch_command(Arguments console) {
  const auto arguments = std::make_shared<WatchArguments>();
  Arguments watch = console.add_subcommand("watch", "Follow a learning run and sum it up");
  watch.add_option("--in", arguments->in, "URL of the bus");
  watch.add_option("--images", arguments->images, "URL of the images' bus");
  watch.add_option("--rig-folder", arguments->rig_folder, "The rig's configuration").required();
  watch.add_option("--rig", arguments->rig, "Name of the rig").required();
  watch.add_option("--out", arguments->out, "Folder for result.json and detections.png").required();
  watch.add_option("--seed", arguments->seed, "Seed of the run, for the record");
  watch.add_option("--samples", arguments->samples,
                   "How many samples the run is to have; default: at most as many as the rig's "
                   "motor_babbler.yaml says");
  watch.add_option("--patience-s", arguments->patience_s,
                   "Give up after so long without a new sample or proposal [s]");
  watch.add_option("--processes", arguments->processes,
                   "Processes that should be heard of; says who is silent when nothing goes on");
  const Argument replay = watch.add_option(
      "--replay", arguments->replay, "The recording that is replayed; then there is no babbler");
  watch
      .add_option("--speed", arguments->speed,
                  "Play the recording so many times faster than it was; 0: somebody else does")
      .needs(replay);
  watch.add_option("--replay-from", arguments->replay_from, "What is played, as `log` says")
      .one_of({kMarkerPoses.name, kSample.name})
      .needs(replay);
  watch.callback([arguments] { run_watch(*arguments); });
}

}  // namespace bodyschema
