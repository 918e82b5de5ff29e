#include "tests/common/bus/bus_test_support.h"

#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <stdexcept>

namespace bodyschema::test {

std::vector<std::uint8_t> read_bytes(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

void write_bytes(const std::filesystem::path& file, const std::vector<std::uint8_t>& bytes) {
  std::ofstream(file, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()),
             static_cast<std::streamsize>(bytes.size()));
}

Program::Program(const std::vector<std::string>& arguments) {
  int out[2];
  int err[2];
  if (::pipe2(out, O_CLOEXEC) != 0 || ::pipe2(err, O_CLOEXEC) != 0) {
    throw std::runtime_error("no pipes");
  }
  std::vector<char*> argv;
  for (const std::string& argument : arguments) argv.push_back(const_cast<char*>(argument.c_str()));
  argv.push_back(nullptr);
  pid_ = ::fork();
  if (pid_ == 0) {
    ::dup2(out[1], STDOUT_FILENO);
    ::dup2(err[1], STDERR_FILENO);
    ::execvp(argv[0], argv.data());
    ::_exit(127);
  }
  ::close(out[1]);
  ::close(err[1]);
  pipes_[0] = out[0];
  pipes_[1] = err[0];
}

Program::~Program() {
  if (pid_ > 0) {
    ::kill(pid_, SIGKILL);
    ::waitpid(pid_, nullptr, 0);
  }
  for (const int pipe : pipes_) {
    if (pipe >= 0) ::close(pipe);
  }
}

bool Program::read_some(int timeout_ms) {
  // poll() leaves negative descriptors alone.
  pollfd ready[2] = {{pipes_[0], POLLIN, 0}, {pipes_[1], POLLIN, 0}};
  ::poll(ready, 2, timeout_ms);
  for (int i = 0; i < 2; ++i) {
    if (ready[i].revents == 0) continue;
    char buffer[4096];
    const ssize_t size = ::read(pipes_[i], buffer, sizeof buffer);
    if (size > 0) {
      texts_[i].append(buffer, static_cast<std::size_t>(size));
    } else {
      ::close(pipes_[i]);
      pipes_[i] = -1;
    }
  }
  return pipes_[0] >= 0 || pipes_[1] >= 0;
}

bool Program::wait_for_output(const std::string& text, int timeout_ms) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(timeout_ms);
  bool is_open = true;
  while (is_open && out().find(text) == std::string::npos) {
    if (std::chrono::steady_clock::now() > end) return false;
    is_open = read_some(std::min(100, timeout_ms));
  }
  return out().find(text) != std::string::npos;
}

void Program::send_signal(int number) const { ::kill(pid_, number); }

int Program::wait() {
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(30);
  while (read_some(100)) {
    if (std::chrono::steady_clock::now() > end) return -1;
  }
  int status = 0;
  ::waitpid(pid_, &status, 0);
  pid_ = -1;
  return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

}  // namespace bodyschema::test
