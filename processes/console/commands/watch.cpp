#include <fcntl.h>
#include <fmt/format.h>
#include <signal.h>
#include <spawn.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <fstream>
#include <iostream>
#include <iterator>
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
#include "common/text/clock.h"
#include "processes/console/commands/commands.h"
#include "processes/console/hint.h"
#include "processes/console/interruption.h"
#include "processes/console/picture.h"
#include "processes/console/progress_line.h"
#include "processes/console/run_watch.h"
#include "processes/console/views/run_result.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema {
namespace {

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

/// Plays onto the bus, with lcm-logplayer, what learning needs of a recording.
class LogPlayer {
 public:
  ~LogPlayer() {
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
    std::vector<std::string> words = {"setpriv", "--pdeathsig", "TERM", "lcm-logplayer"};
    words.insert(words.end(), {"-s", fmt::format("{}", arguments.speed), "-e", channels,
                               "--lcm-url=" + arguments.in, arguments.replay});
    std::vector<char*> argv;
    for (std::string& word : words) argv.push_back(word.data());
    argv.push_back(nullptr);
    posix_spawn_file_actions_t actions;
    ::posix_spawn_file_actions_init(&actions);
    ::posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
    const int error = ::posix_spawnp(&pid_, argv[0], &actions, nullptr, argv.data(), environ);
    ::posix_spawn_file_actions_destroy(&actions);
    if (error != 0)
      throw std::runtime_error(fmt::format("lcm-logplayer: {}; it is in Debian's liblcm-bin",
                                           std::generic_category().message(error)));
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

/// The events of a recording, up to where it is damaged.
void for_each_readable(const std::string& log, const std::function<void(const LogEvent&)>& visit) {
  try {
    for_each_event(log, visit);
  } catch (const std::runtime_error&) {
    // What stands before the damage is used, as everywhere.
  }
}

/// The schema is the monitor's where it accepted one; its outliers are found by learning again.
void learn_again(const RunWatch& watch, const WatchArguments& arguments, RunResult* result) {
  const StructureLearnerConfig config = StructureLearnerConfig::load(
      std::filesystem::path(arguments.rig_folder) / "structure_learner.yaml");
  std::vector<ActionPoseSample> training = watch.samples();
  std::erase_if(training, [](const auto& sample) { return !is_learned_from(sample); });
  LearnOptions options = config.options;
  const auto shows_root = [&](const auto& sample) {
    return options.root && sample.find(*options.root);
  };
  if (std::ranges::none_of(training, shows_root)) options.root.reset();
  const LearnResult learned = learn(config.signals, training, options);
  result->schema = watch.schema().value_or(learned.schema);
  result->outliers = learned.outliers;
  result->is_accepted = watch.schema().has_value();
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

/// Tells once of each process that ended. @throws std::runtime_error if the rig's files are to
/// blame: those do not mend themselves.
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

/// Follows one run from its first message to its result.
class WatchSession {
 public:
  explicit WatchSession(const WatchArguments& arguments)
      : arguments_(arguments),
        is_replay_(!arguments.replay.empty()),
        is_played_(is_replay_ && arguments.speed > 0),
        listener_(arguments.replay_from == kSample.name ? "structure_learner" : "observer"),
        goal_(goal_of(arguments)),
        bus_(arguments.in, is_replay_ ? "" : arguments.in),
        images_(arguments.images.empty() ? images_url(arguments.in) : arguments.images, ""),
        door_(arguments.rig_folder),
        intake_((std::filesystem::path(arguments.out) / "samples.lcmlog").string(),
                [this](const sample_t& m) {
                  if (door_.objection(m).empty()) watch_.on_sample(m);
                },
                ask_again()) {
    subscribe();
    if (is_replay_) read_truth(arguments_.replay);
    // ./run starts this again after a crash: what went over the bus before is in the run's logs.
    for (int part = 0; !is_replay_; ++part) {
      const std::string log = fmt::format("{}/run.lcmlog.{:02}", arguments_.out, part);
      if (!std::filesystem::exists(log)) break;
      read_truth(log);
    }
    if (is_played_)
      for_each_readable(arguments_.replay, [this](const LogEvent& event) {
        num_played_ += event.channel == arguments_.replay_from;
      });
  }

  void run() {
    while (!is_finished() && !is_interrupted()) {
      images_.handle(std::chrono::milliseconds(0));
      bus_.handle(std::chrono::milliseconds(50));
      intake_.on_tick(clock_us());
      note_progress();
      line_.show_throttled(progress_line());
      tell_of_trouble();
    }
    line_.show(progress_line());
    line_.end();
    finish();
    if (is_interrupted()) throw std::runtime_error("interrupted before the end");
  }

 private:
  /// The simulator's truth of a recorded run is read from the recording: it does not go on a bus.
  void read_truth(const std::string& log) {
    for_each_readable(log, [this](const LogEvent& event) {
      if (const auto state = message_of(event, kSimState)) watch_.on_sim_state(*state);
    });
  }

  /// Asks for samples that lost frames took, as from an observer on another host.
  SampleIntake::Ask ask_again() {
    if (is_replay_ && !(is_played_ && listener_ == "observer")) return nullptr;
    return [this](sample_request_t request) {
      request.process_name = "watch";
      bus_.publish(kSampleRequest, request);
    };
  }

  /// Messages of another rig's group or of a recording that is played are none of this run.
  template <class Message, class Handler>
  void hear(const Channel<Message>& channel, Handler handler) {
    bus_.subscribe(channel, [this, handler](const Message& m) {
      if (door_.objection(m).empty()) handler(m);
    });
  }

  void subscribe() {
    hear(kSample, [this](const sample_t& m) { intake_.on_sample(m); });
    hear(kBodySchema, [this](const body_schema_t& m) { watch_.on_body_schema(m); });
    hear(kLearnedSchema, [this](const body_schema_t& m) { watch_.on_learned_schema(m); });
    hear(kModelHealth, [this](const model_health_t& m) { watch_.on_model_health(m); });
    hear(kSimState, [this](const sim_state_t& m) { watch_.on_sim_state(m); });
    hear(kMarkerPoses, [this](const marker_poses_t& m) { picture_.on_markers(m); });
    hear(kCameraInfo, [this](const camera_info_t& m) { picture_.on_info(m); });
    bus_.subscribe(kProcessInfo, [this](const process_info_t& m) {
      if (is_live(m, wall_clock_us())) watch_.on_process_info(m, clock_us());
    });
    images_.subscribe<camera_image_t>(kCameraImage,
                                      [this](const camera_image_t& m) { picture_.on_image(m); });
  }

  double seconds() const { return bodyschema::seconds(clock_us() - start_us_); }
  std::int64_t num_heard() const {
    return watch_.counter(listener_, "received " + arguments_.replay_from);
  }

  std::string progress_line() const {
    const auto left_s =
        goal_ ? pace_.seconds_for(goal_->most - watch_.num_samples()) : std::optional<double>();
    return fmt::format("{} · {:.0f} s", watch_.progress(goal_, left_s), seconds());
  }

  bool is_finished() {
    if (!is_replay_) return watch_.is_finished();
    return is_played_ ? is_played_out() : watch_.is_caught_up();
  }

  bool is_played_out() {
    // Messages that are played before somebody listens are lost.
    if (!player_.has_started() && watch_.are_listening(arguments_.processes, clock_us()))
      player_.start(arguments_);
    if (!player_.has_started() || player_.is_running()) {
      played_s_ = seconds();
      return false;
    }
    // The listener may have messages in its queue still; lost ones will not come.
    const double waited_s = seconds() - std::max(played_s_, progressed_s_);
    if (num_heard() < num_played_ && waited_s < 5) return false;
    if (watch_.num_samples() == 0 && seconds() - played_s_ > 10)
      throw std::runtime_error(
          "the recording gave no sample: it holds no settled action that was seen");
    return waited_s > 1 && watch_.is_caught_up();
  }

  void note_progress() {
    const std::int64_t progress = watch_.num_samples() + watch_.learned_sample() + num_heard();
    if (std::exchange(last_progress_, progress) != progress) progressed_s_ = seconds();
    pace_.note(seconds(), watch_.num_samples());
  }

  void tell_of_trouble() {
    if (seconds() - looked_s_ > 2 && watch_.num_samples() == 0) {
      looked_s_ = seconds();
      tell_of_failures(arguments_, &told_);
    }
    if (seconds() - std::max(progressed_s_, warned_s_) > 20) {
      warned_s_ = seconds();
      line_.end();
      std::cerr << fmt::format("nothing new for {:.0f} s:\n", seconds() - progressed_s_)
                << watch_.diagnosis(arguments_.processes, clock_us());
    }
    if (seconds() - progressed_s_ > arguments_.patience_s)
      throw std::runtime_error(
          fmt::format("nothing new for {:.0f} s, so I give up; the processes' own words are in {}",
                      arguments_.patience_s, arguments_.out));
  }

  void finish() {
    RunResult result;
    result.rig = arguments_.rig;
    if (!is_replay_) result.seed = arguments_.seed;
    result.replay_of = arguments_.replay;
    result.replay_from = arguments_.replay_from;
    result.num_samples = watch_.num_samples();
    result.seconds = seconds();
    result.end_effector = load_signals(arguments_.rig_folder).end_effector_part;
    learn_again(watch_, arguments_, &result);
    result.health = watch_.health();
    const auto held_out = watch_.held_out(watch_.body_since());
    result.num_held_out = static_cast<int>(held_out.size());
    result.held_out_since = watch_.body_since();
    result.has_truth = watch_.has_truth();
    if (result.has_truth)
      result.held_out = judge(result.schema, held_out, held_out);
    else
      result.held_out.parts = evaluate(result.schema, held_out);
    result.visibility = watch_.visibility();
    result.lost_samples = intake_.lost();
    result.lost_frames = std::max<std::int64_t>(0, num_played_ - num_heard());

    const std::filesystem::path folder = arguments_.out;
    write_file_atomically(folder / "result.json", run_result_json(result).dump(2) + "\n");
    picture_.write(folder / "detections.png");
    std::cout << run_result_text(result, folder) << std::flush;
  }

  const WatchArguments& arguments_;
  const bool is_replay_, is_played_;
  const std::string listener_;  ///< who makes samples, or a schema, of what is played
  const std::optional<SampleGoal> goal_;
  RunWatch watch_;
  BestPicture picture_;
  Bus bus_, images_;
  const RigDoor door_;
  SampleIntake intake_;
  const std::int64_t start_us_ = clock_us();
  ProgressLine line_;
  LogPlayer player_;
  Pace pace_;
  std::set<std::string> told_;
  /// Every message that is played is heard by the listener, or lost.
  std::int64_t num_played_ = 0;
  std::int64_t last_progress_ = 0;
  double progressed_s_ = 0, warned_s_ = 0, played_s_ = 0, looked_s_ = 0;
};

void run_watch(const WatchArguments& arguments) {
  // stdout is for the result.
  spdlog::set_default_logger(spdlog::stderr_color_mt("watch"));
  catch_interruption();
  WatchSession(arguments).run();
}

}  // namespace

void add_watch_command(Arguments console) {
  auto [watch, arguments] =
      console.add_command("watch", "Follow a learning run and sum it up", run_watch);
  watch.add_option("--in", arguments.in, "URL of the bus");
  watch.add_option("--images", arguments.images, "URL of the images' bus");
  watch.add_option("--rig-folder", arguments.rig_folder, "The rig's configuration").required();
  watch.add_option("--rig", arguments.rig, "Name of the rig").required();
  watch.add_option("--out", arguments.out, "Folder for result.json and detections.png").required();
  watch.add_option("--seed", arguments.seed, "Seed of the run, for the record");
  watch.add_option("--samples", arguments.samples,
                   "How many samples the run is to have; default: at most as many as the rig's "
                   "motor_babbler.yaml says");
  watch.add_option("--patience-s", arguments.patience_s,
                   "Give up after so long without a new sample or proposal [s]");
  watch.add_option("--processes", arguments.processes,
                   "Processes that should be heard of; says who is silent when nothing goes on");
  const Argument replay = watch.add_option(
      "--replay", arguments.replay, "The recording that is replayed; then there is no babbler");
  watch
      .add_option("--speed", arguments.speed,
                  "Play the recording so many times faster than it was; 0: somebody else does")
      .needs(replay);
  watch.add_option("--replay-from", arguments.replay_from, "What is played, as `log` says")
      .one_of({kMarkerPoses.name, kSample.name})
      .needs(replay);
}

}  // namespace bodyschema
