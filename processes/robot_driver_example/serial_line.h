#pragma once

#include <optional>
#include <string>

namespace bodyschema {

/// A serial port that speaks in lines: 115200 baud, 8N1, no flow control. Never blocks. Any fault
/// of the port (unplugged, never there) closes it; open() again when is_open() is false.
class SerialLine {
 public:
  explicit SerialLine(std::string device) : device_(std::move(device)) {}
  ~SerialLine() { close(); }
  SerialLine(const SerialLine&) = delete;
  SerialLine& operator=(const SerialLine&) = delete;

  /// False, with a reason in problem(), if it cannot be opened.
  bool open();
  bool is_open() const { return file_ >= 0; }
  const std::string& problem() const { return problem_; }

  /// Sends `text` and a newline. False, and closed, if the port does not take it.
  bool write_line(const std::string& text);
  /// The next whole line, without its end; none: nothing more has come, or the port was closed.
  std::optional<std::string> read_line();

 private:
  void close();
  void fail(const std::string& what);

  const std::string device_;
  int file_ = -1;
  std::string received_;
  std::string problem_ = "not opened yet";
};

}  // namespace bodyschema
