// imaginary_robot: plays a robot arm behind a serial port, for tests and for trying the example.
//
//   imaginary_robot --link /tmp/robot --signals 3 --speed 20
//
// makes a pseudo terminal, puts a symbolic link to it at --link and speaks this protocol on it, one
// line each way; N counts the orders, so that an answer can be distinguished from an older one:
//
//   GO N Q1 … QM    move all joints to Q1 … QM [deg], together, the farthest at --speed
//   HALT N          stop where you are
//   ?               where are you?  →  AT N REST|MOVING Q1 … QM, N of the newest order
//
// It moves in real time. Like many a robot it finishes its motion when nobody listens any more.

#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <termios.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <filesystem>
#include <iomanip>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

volatile std::sig_atomic_t ended = 0;

using Clock = std::chrono::steady_clock;

class Arm {
 public:
  Arm(std::size_t num_signals, double speed) : speed_(speed), at_(num_signals), to_(num_signals) {}

  void step(double seconds) {
    double farthest = 0;
    for (std::size_t i = 0; i < at_.size(); ++i) {
      farthest = std::max(farthest, std::abs(to_[i] - at_[i]));
    }
    const double share = farthest > 0 ? std::min(1.0, speed_ * seconds / farthest) : 1;
    for (std::size_t i = 0; i < at_.size(); ++i) {
      at_[i] = share < 1 ? at_[i] + share * (to_[i] - at_[i]) : to_[i];
    }
  }

  /// The robot's answer; "" if it has none.
  std::string obey(const std::string& line) {
    std::istringstream words(line);
    std::string verb;
    words >> verb;
    if (verb == "?") {
      std::ostringstream answer;
      answer << "AT " << order_ << (at_ == to_ ? " REST" : " MOVING") << std::setprecision(15);
      for (const double q : at_) answer << ' ' << q;
      return answer.str();
    }
    long order = 0;
    std::vector<double> target(at_.size());
    if (!(words >> order)) return "ERR " + line;
    if (verb == "HALT") {
      target = at_;
    } else if (verb == "GO") {
      for (double& q : target) {
        if (!(words >> q)) return "ERR " + line;
      }
    } else {
      return "ERR " + line;
    }
    order_ = order;
    to_ = target;
    return "";
  }

 private:
  const double speed_;
  long order_ = 0;
  std::vector<double> at_, to_;
};

/// The master's side of a new pseudo terminal, in raw mode; its slave's name in `name`.
int open_terminal(std::string* name) {
  const int master = ::posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
  if (master < 0 || ::grantpt(master) != 0 || ::unlockpt(master) != 0) {
    throw std::runtime_error("cannot make a pseudo terminal");
  }
  *name = ::ptsname(master);
  // Open for as long as the robot lives: a driver that leaves must not look like a cable pulled.
  const int slave = ::open(name->c_str(), O_RDWR | O_NOCTTY | O_CLOEXEC);
  termios settings{};
  if (slave < 0 || ::tcgetattr(slave, &settings) != 0)
    throw std::runtime_error("cannot open " + *name);
  ::cfmakeraw(&settings);
  ::tcsetattr(slave, TCSANOW, &settings);
  return master;
}

void play(const std::string& link, std::size_t num_signals, double speed) {
  std::string name;
  const int master = open_terminal(&name);
  // Renamed into place: behind a link that exists there is a robot.
  const std::string temporary = link + "." + std::to_string(::getpid());
  std::filesystem::create_symlink(name, temporary);
  std::filesystem::rename(temporary, link);

  Arm arm(num_signals, speed);
  std::string received;
  auto before = Clock::now();
  while (!ended) {
    pollfd waits{master, POLLIN, 0};
    ::poll(&waits, 1, 10);
    const auto now = Clock::now();
    arm.step(std::chrono::duration<double>(now - before).count());
    before = now;
    if (!(waits.revents & POLLIN)) continue;
    char buffer[512];
    const ssize_t count = ::read(master, buffer, sizeof buffer);
    if (count > 0) received.append(buffer, static_cast<std::size_t>(count));
    for (std::size_t end; (end = received.find('\n')) != std::string::npos;) {
      std::string answer = arm.obey(received.substr(0, end));
      received.erase(0, end + 1);
      if (answer.empty()) continue;
      answer += '\n';
      if (::write(master, answer.data(), answer.size()) < 0) break;
    }
  }
  std::filesystem::remove(link);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Plays a robot behind a serial port", "imaginary_robot");
  std::string link;
  std::size_t num_signals = 3;
  double speed = 20;
  app.add_option("--link", link, "Where the port appears")->required();
  app.add_option("--signals", num_signals, "Number of joints")->check(CLI::Range(1, 100));
  app.add_option("--speed", speed, "Of the fastest joint [deg/s]")->check(CLI::Range(1e-3, 1e6));
  CLI11_PARSE(app, argc, argv);
  std::signal(SIGTERM, [](int) { ended = 1; });
  std::signal(SIGINT, [](int) { ended = 1; });
  try {
    play(link, num_signals, speed);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "imaginary_robot: %s\n", error.what());
    return 1;
  }
  return 0;
}
