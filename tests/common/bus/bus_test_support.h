#pragma once

#include <sys/types.h>

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "common/bus/bus.h"
#include "common/bus/process.h"
#include "tests/support/temporary_folder.h"

namespace bodyschema::test {

std::vector<std::uint8_t> read_bytes(const std::filesystem::path& file);
void write_bytes(const std::filesystem::path& file, const std::vector<std::uint8_t>& bytes);

/// A process's class on the log `in`, as its program would be: what it writes is in `out`. Returns
/// the exit code.
template <class Subscriber>
int run_on_log(const std::string& name, const std::filesystem::path& rig,
               const std::filesystem::path& in, const std::filesystem::path& out,
               const std::vector<std::string>& flags) {
  std::vector<std::string> words = {name,
                                    "--config",
                                    rig / (name + ".yaml"),
                                    "--in",
                                    "file://" + in.string() + "?speed=0",
                                    "--out",
                                    "file://" + out.string() + "?mode=w"};
  words.insert(words.end(), flags.begin(), flags.end());
  std::vector<char*> argv;
  for (std::string& word : words) argv.push_back(word.data());
  return run_process<Subscriber>(name, static_cast<int>(argv.size()), argv.data());
}

/// Asks `is_done()` between waits of `ask()` until it is true; false after ten seconds.
template <class Ask, class IsDone>
bool ask_until(Ask ask, IsDone is_done) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(10);
  while (!is_done()) {
    if (std::chrono::steady_clock::now() > end) return false;
    ask();
  }
  return true;
}

/// Handles messages until `is_done()`; false after ten seconds.
template <class IsDone>
bool handle_until(Bus& bus, IsDone is_done) {
  return ask_until([&] { bus.handle(std::chrono::milliseconds(20)); }, is_done);
}

/// A program that runs beside the test; killed and reaped when this goes away.
class Program {
 public:
  explicit Program(const std::vector<std::string>& arguments);
  ~Program();
  Program(const Program&) = delete;
  Program& operator=(const Program&) = delete;

  /// Waits until stdout holds `text`; false after the timeout or at its end.
  bool wait_for_output(const std::string& text, int timeout_ms = 10'000);
  void send_signal(int number) const;
  /// Waits for the end. Exit code, or 128 + signal; −1 after thirty seconds.
  int wait();
  /// Everything written until now (all of it after wait()).
  const std::string& out() const { return texts_[0]; }
  const std::string& err() const { return texts_[1]; }
  pid_t pid() const { return pid_; }

 private:
  /// Reads what is there; false when both ends are closed.
  bool read_some(int timeout_ms);
  pid_t pid_ = -1;
  int pipes_[2] = {-1, -1};
  std::string texts_[2];
};

}  // namespace bodyschema::test
