#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/codec.h"

namespace bodyschema {

// LCM event logs, as lcm-logger writes and lcm-logplayer reads them. An event is a header of 28
// bytes, all big-endian: 0xEDA1DA01, int64 event number, int64 event time [µs since 1970], int32
// length of the channel's name, int32 length of the data; then the name and the data.
//
// An event written here has a checksum in the upper half of its event number, which LCM's tools
// carry along unused: the CRC-32C of all that follows (the lower half, a count, up to the data),
// 0xFFFFFFFF in place of 0. An upper half of 0 is an event without one, as lcm-logger writes it.
// Every reader here checks it: it finds any three flipped bits and any damage within 32 adjacent
// bits, and misses one of 2^32 others.
//
// LCM's own reader is not used: it stops silently at the first damaged byte, drops the whole event
// before it, cannot say where it was and does not open an empty log.

/// One event of a log.
struct LogEvent {
  std::string channel;
  std::vector<std::uint8_t> data;
  /// Time of recording, or the message's own utime in files that must be reproducible [µs].
  std::int64_t event_utime = 0;
  std::int64_t event_number = 0;  ///< modulo 2^32
};

/// The event as a message of the channel; std::nullopt where it is of another channel or cannot be
/// decoded.
template <class Message>
std::optional<Message> message_of(const LogEvent& event, const Channel<Message>& channel) {
  if (event.channel != channel.name) return std::nullopt;
  return decode<Message>(event.data.data(), event.data.size()).message;
}

/// Joins the messages of a log that were recorded in pieces (common/bus/pieces.h).
class EventJoiner {
 public:
  /// Turns the last missing piece into the whole message's event. False for the other pieces, which
  /// stay hidden until their message is whole; bad ones count as incomplete messages.
  bool join(LogEvent* event);
  /// Messages of which pieces are missing so far.
  std::int64_t num_incomplete() const;

 private:
  std::map<std::string, PieceJoiner> joiners_;
  std::int64_t num_bad_ = 0;
};

/// Contents and damage of a log.
struct LogReport {
  /// Whole events read, pieces of messages included.
  std::int64_t events = 0;
  /// Messages that were recorded in pieces, with a piece missing.
  std::int64_t incomplete = 0;
  /// Offset of the last event, if the file ends before that event does: left by a writer that was
  /// killed or ran out of disk. Everything before it is good.
  std::optional<std::int64_t> truncated_at_byte;
  /// Offset of the first damage that was skipped (OnDamage::kSkip), and number of skipped bytes.
  std::optional<std::int64_t> damaged_at_byte;
  std::int64_t damaged_bytes = 0;
  /// Description of that damage, for people: "is damaged: …"; "" if there is none.
  std::string damage;
};

/// Reaction to damage in the middle of a log (bytes that are no event, a wrong checksum, an event
/// that cannot be decoded): throw, or go on at the next event.
enum class OnDamage { kThrow, kSkip };

/// kJoin: an event is a whole message. kAsRecorded: it may be a piece of one.
enum class Pieces { kJoin, kAsRecorded };

/// Reads a log from its beginning, event by event. A message that was recorded in pieces is one
/// event, with number and time of the last piece.
class LogReader {
 public:
  /// Begins at `from_byte`, where an event must begin: the position() of an earlier reader.
  /// @throws std::runtime_error if there is no such file, it cannot be read or is not an LCM log.
  explicit LogReader(const std::filesystem::path& path, OnDamage on_damage = OnDamage::kThrow,
                     std::int64_t from_byte = 0, Pieces pieces = Pieces::kJoin);
  ~LogReader();
  LogReader(const LogReader&) = delete;
  LogReader& operator=(const LogReader&) = delete;

  /// Reads the next event into event(). False at the end, also where the tail is truncated.
  /// @throws std::runtime_error naming the byte where something begins that is not an event, or one
  /// that is not as it was written (with OnDamage::kSkip only if there is no event at all).
  bool next();
  /// Goes to the start of an event, an earlier position().
  void seek(std::int64_t position);
  const LogEvent& event() const { return event_; }
  const LogReport& report() const { return report_; }
  /// Offset of the next event [bytes].
  std::int64_t position() const { return position_; }

 private:
  enum class Found { kEvent, kEnd, kTruncated, kDamaged, kWrongChecksum };
  bool next_recorded();
  Found read_event(bool looks_behind);
  Found look_behind(std::int64_t end);
  std::optional<std::int64_t> find_event(std::int64_t from);

  std::filesystem::path path_;
  OnDamage on_damage_;
  Pieces pieces_;
  EventJoiner joiner_;
  std::FILE* file_ = nullptr;
  std::int64_t position_ = 0;
  LogEvent event_;
  LogReport report_;
};

/// Calls `visit` with every event of the log. @throws as LogReader does.
LogReport for_each_event(const std::filesystem::path& path,
                         const std::function<void(const LogEvent&)>& visit,
                         OnDamage on_damage = OnDamage::kThrow);

/// All messages of one channel, in order. A truncated tail is no error but reported.
/// @throws std::runtime_error as LogReader does, and if a message of that channel is malformed or
/// makes no sense (naming the event); with OnDamage::kSkip it is left out and its bytes count as
/// damaged.
template <class Message>
std::vector<Message> read_log(const std::filesystem::path& path, const Channel<Message>& channel,
                              LogReport* report = nullptr, OnDamage on_damage = OnDamage::kThrow) {
  std::vector<Message> messages;
  std::int64_t undecoded_bytes = 0;
  LogReport found = for_each_event(
      path,
      [&](const LogEvent& event) {
        if (event.channel != channel.name) return;
        Decoded<Message> decoded = decode<Message>(event.data.data(), event.data.size());
        if (decoded.message) {
          messages.push_back(*std::move(decoded.message));
        } else if (on_damage == OnDamage::kSkip) {
          undecoded_bytes += static_cast<std::int64_t>(event.data.size());
        } else {
          throw std::runtime_error(path.string() + ": event " + std::to_string(event.event_number) +
                                   " (" + event.channel + "): " + decoded.problem);
        }
      },
      on_damage);
  found.damaged_bytes += undecoded_bytes;
  if (report != nullptr) *report = found;
  return messages;
}

/// While it lives no LogAppender can open the log: held while a damaged one is replaced.
class LogLock {
 public:
  /// The file is created where there is none.
  /// @throws std::runtime_error if it cannot be written or is being written by somebody else.
  explicit LogLock(const std::filesystem::path& path);
  ~LogLock();
  LogLock(const LogLock&) = delete;
  LogLock& operator=(const LogLock&) = delete;

  /// The locked file, open for reading and writing; the caller closes it and so ends the lock.
  int release();

 private:
  int file_ = -1;
};

/// Writes events at the end of a log, each in one write, so that a killed writer leaves at most one
/// torn event behind. While it lives no other LogAppender can open the same file.
class LogAppender {
 public:
  enum class Mode { kAppend, kOverwrite };
  /// kToDisk: append() returns after fdatasync (0.1 ms … 10 ms): the event survives a power cut.
  /// kToKernel: the event survives the death of the process only.
  enum class Durability { kToDisk, kToKernel };

  /// Opens or creates the log. A torn tail is cut off, so that later events can be read.
  /// @throws std::runtime_error if the file cannot be written, is damaged elsewhere than at its
  /// tail, or is being written by somebody else.
  explicit LogAppender(const std::filesystem::path& path, Mode mode = Mode::kAppend,
                       Durability durability = Durability::kToDisk);
  ~LogAppender();
  LogAppender(const LogAppender&) = delete;
  LogAppender& operator=(const LogAppender&) = delete;

  /// Appends the message with its utime as event time.
  /// @throws std::logic_error if it does not pass check(); std::runtime_error if the disk is full
  /// (the log then ends after the event before).
  template <class Message>
  void append(const Channel<Message>& channel, const Message& message) {
    append_bytes(channel.name, encode(channel, message), message.utime);
  }
  void append_bytes(const std::string& channel, std::span<const std::uint8_t> data,
                    std::int64_t event_utime);

  /// Contents of the log when it was opened.
  const LogReport& found() const { return found_; }
  /// Offset of the next event [bytes].
  std::int64_t position() const { return end_; }

 private:
  std::filesystem::path path_;
  Durability durability_;
  int file_ = -1;
  std::int64_t end_ = 0;
  std::int64_t next_number_ = 0;
  LogReport found_;
};

/// CRC-32C (Castagnoli), as iSCSI and ext4 use it.
std::uint32_t crc32c(std::span<const std::uint8_t> bytes);

/// The bytes of one event as they stand in a log, with their checksum.
std::vector<std::uint8_t> encode_event(const std::string& channel,
                                       std::span<const std::uint8_t> data, std::int64_t event_utime,
                                       std::int64_t event_number);

/// Replaces a file as a whole: a temporary file in the same folder, synced, renamed, the folder
/// synced. A reader of `file` sees the old or the new text, also after a power cut. Where it is a
/// symbolic link, what it leads to is replaced; what is no regular file is not.
/// @throws std::runtime_error naming the file.
void write_file_atomically(const std::filesystem::path& file, const std::string& text);

/// Copies a file that cannot be used as it is to "PATH.bad-1" (-2, …, the first name that is free),
/// before it is replaced. Returns the new name. @throws std::runtime_error naming the file.
std::filesystem::path copy_aside(const std::filesystem::path& path);

/// A log of one event, written atomically: the form of a schema file. Its event time is the
/// message's utime, so equal messages make equal files.
template <class Message>
void write_one_event_log(const std::filesystem::path& path, const Channel<Message>& channel,
                         const Message& message) {
  const std::vector<std::uint8_t> event =
      encode_event(channel.name, encode(channel, message), message.utime, 0);
  write_file_atomically(path, std::string(event.begin(), event.end()));
}

}  // namespace bodyschema
