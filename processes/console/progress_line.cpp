#include "processes/console/progress_line.h"

#include <unistd.h>

#include <iostream>

#include "common/text/clock.h"
#include "processes/console/hint.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kOnTerminal_us = 100'000, kInFile_us = 5'000'000;

}  // namespace

ProgressLine::ProgressLine() : is_terminal_(isatty(STDERR_FILENO) == 1) {}

ProgressLine::~ProgressLine() {
  if (is_terminal_ && !shown_.empty()) std::cerr << "\r\x1b[2K" << std::flush;
}

void ProgressLine::show(const std::string& line) {
  if (line == shown_) return;
  shown_ = line;
  shown_us_ = clock_us();
  std::cerr << (is_terminal_ ? in_place(line, STDERR_FILENO) : line + "\n") << std::flush;
}

void ProgressLine::show_throttled(const std::string& line) {
  if (clock_us() - shown_us_ >= (is_terminal_ ? kOnTerminal_us : kInFile_us)) show(line);
}

void ProgressLine::end() {
  if (is_terminal_ && !shown_.empty()) std::cerr << std::endl;
  shown_.clear();
}

}  // namespace bodyschema
