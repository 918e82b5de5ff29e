#include "processes/robot_driver_example/serial_line.h"

#include <fcntl.h>
#include <sys/file.h>
#include <termios.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

namespace bodyschema {
namespace {

/// A robot that sends this much without an end of line speaks another protocol.
constexpr std::size_t kMaxLine = 4096;

}  // namespace

bool SerialLine::open() {
  close();
  // O_NOCTTY: a hang-up must not become a SIGHUP. O_NONBLOCK: a port without carrier must not
  // block.
  file_ = ::open(device_.c_str(), O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
  if (file_ < 0) {
    fail(std::strerror(errno));
    return false;
  }
  // Two drivers on one port would each hear half of what the robot says.
  if (::flock(file_, LOCK_EX | LOCK_NB) != 0) {
    fail("another program has the port");
    return false;
  }
  termios settings{};
  if (::tcgetattr(file_, &settings) != 0) {
    fail("is no serial port");
    return false;
  }
  ::cfmakeraw(&settings);  // bytes as they are: no echo, no signals, no translation of line ends
  settings.c_cflag |= CLOCAL | CREAD;
  settings.c_cflag &= ~static_cast<tcflag_t>(CSTOPB | PARENB | CRTSCTS);
  ::cfsetspeed(&settings, B115200);
  if (::tcsetattr(file_, TCSANOW, &settings) != 0) {
    fail(std::strerror(errno));
    return false;
  }
  ::tcflush(file_, TCIOFLUSH);  // half a line from before
  problem_.clear();
  return true;
}

bool SerialLine::write_line(const std::string& text) {
  const std::string line = text + "\n";
  // A command is far shorter than the kernel's buffer: if it does not fit at once, the robot has
  // stopped reading.
  if (file_ >= 0 && ::write(file_, line.data(), line.size()) == static_cast<ssize_t>(line.size())) {
    return true;
  }
  if (file_ >= 0) fail("does not take commands");
  return false;
}

std::optional<std::string> SerialLine::read_line() {
  while (file_ >= 0) {
    if (const std::size_t end = received_.find('\n'); end != std::string::npos) {
      std::string line = received_.substr(0, end);
      received_.erase(0, end + 1);
      if (!line.empty() && line.back() == '\r') line.pop_back();
      return line;
    }
    char buffer[512];
    const ssize_t count = ::read(file_, buffer, sizeof buffer);
    if (count > 0) {
      received_.append(buffer, static_cast<std::size_t>(count));
      if (received_.size() > kMaxLine) fail("sends no lines: another protocol or baud rate?");
    } else if (count < 0 && (errno == EAGAIN || errno == EINTR)) {
      break;
    } else {
      fail("has vanished");  // 0 or EIO: unplugged
    }
  }
  return std::nullopt;
}

void SerialLine::close() {
  if (file_ >= 0) ::close(file_);
  file_ = -1;
  received_.clear();
}

void SerialLine::fail(const std::string& what) {
  close();
  problem_ = device_ + ": " + what;
}

}  // namespace bodyschema
