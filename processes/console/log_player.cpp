#include "processes/console/log_player.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <stdexcept>
#include <system_error>
#include <vector>

#include "common/bus/channels.h"

namespace bodyschema {

LogPlayer::~LogPlayer() {
  if (pid_ <= 0 || has_ended_) return;
  ::kill(pid_, SIGTERM);
  ::waitpid(pid_, nullptr, 0);
}

void LogPlayer::start(const std::string& log, const std::string& from, double speed,
                      const std::string& url) {
  const std::string channels =
      from == kSample.name
          ? kSample.name
          : fmt::format("({}|{}|{})", kMarkerPoses.name, kMotionStatus.name, kCameraInfo.name);
  std::vector<std::string> words = {
      "setpriv", "--pdeathsig",      "TERM", "lcm-logplayer", "-s", fmt::format("{}", speed), "-e",
      channels,  "--lcm-url=" + url, log};
  std::vector<char*> argv;
  for (std::string& word : words) argv.push_back(word.data());
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

bool LogPlayer::is_running() {
  if (pid_ <= 0 || has_ended_) return false;
  int status = 0;
  if (::waitpid(pid_, &status, WNOHANG) == 0) return true;
  has_ended_ = true;
  if (status != 0) throw std::runtime_error("lcm-logplayer failed");
  return false;
}

}  // namespace bodyschema
