#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <type_traits>
#include <utility>

#include "common/bus/channels.h"
#include "common/bus/codec.h"

namespace bodyschema {

/// The one class that knows LCM. It owns an LCM object for input and one for output (the same one
/// where both URLs are equal and live), and closes LCM's traps: a message must decode to its last
/// byte and make sense (check()) or it is dropped, counted and reported once a channel; handlers
/// run after LCM has returned, so their exceptions leave through handle() and never through LCM's C
/// frames; EINTR is no error; a message in pieces is handled when it is whole; channel names are
/// matched literally; a dead URL throws here, at once.
///
/// URLs, for input (in) and output (out):
///   udpm://239.255.76.67:7667?ttl=0    in, out: multicast (live)
///   tcpq://host:7700                   in, out: LCM's TCP relay (live)
///   memq://                            in: this Bus's own messages; out: only if in is memq://
///   file://PATH?speed=0                in: a log; 0: at once, 1: paced
///   file://PATH?mode=w, …?mode=a       out: a log, replaced or extended
///   (empty)                            in: hears nothing; out: publishes nowhere
///
/// PATH may be relative and hold spaces. A udpm URL without recv_buf_size gets one of 2 MiB,
/// because LCM's default loses images. The network is trusted: forged packets can crash any LCM 1.x
/// subscriber, so keep ttl=0 or a firewall around the robot.
///
/// Use one Bus from one thread; publish() and counters() alone are thread safe.
class Bus {
 public:
  /// @throws std::runtime_error with what to type, if a URL cannot be opened.
  Bus(const std::string& in_url, const std::string& out_url);
  ~Bus();
  Bus(const Bus&) = delete;
  Bus& operator=(const Bus&) = delete;

  /// Calls `handler` from handle() with every message of the channel, in order. Up to
  /// queue_capacity() messages wait for a process that is busy.
  /// @throws std::runtime_error if the connection is dead; std::logic_error if the channel was
  /// subscribed with another type.
  template <class Message>
  void subscribe(const Channel<Message>& channel,
                 std::type_identity_t<std::function<void(const Message&)>> handler) {
    subscribe_raw(channel.name, &decode_incoming<Message>, queue_capacity<Message>(),
                  erase(std::move(handler)), false);
  }

  /// Calls `handler` once per handle() with the newest good message of the channel; older ones are
  /// skipped (and counted as "skipped CHANNEL"). A replay skips nothing, because it dispatches one
  /// event at a time; so it does not depend on the machine's speed.
  template <class Message>
  void subscribe_latest(const Channel<Message>& channel,
                        std::type_identity_t<std::function<void(const Message&)>> handler) {
    subscribe_raw(channel.name, &decode_incoming<Message>, queue_capacity<Message>(),
                  erase(std::move(handler)), true);
  }

  /// Encodes and sends; beyond kLargestDatagram in pieces, images excepted (common/bus/pieces.h). A
  /// log gets the whole message. A message that does not pass check() is a bug: @throws
  /// std::logic_error.
  /// @throws std::runtime_error if it is larger than kLargestOf, the disk is full or the relay
  /// gone. A datagram that cannot be sent (the interface is down) is lost: counted as "send failed
  /// CHANNEL" and warned of once. In a log the event time is now, in a replay that of the event in
  /// hand: a replayed log makes the same bytes again.
  template <class Message>
  void publish(const Channel<Message>& channel, const Message& message) {
    publish_raw(channel.name, encode(channel, message), !std::is_same_v<Message, camera_image_t>);
  }

  /// Waits up to `timeout` for a message, then dispatches all messages that have come (for at most
  /// 100 ms, so that the caller's ticks are not starved), latest-only handlers last. A replay
  /// dispatches one event of a subscribed channel. Returns false at the end of a log; a truncated
  /// log is warned of and counted as "truncated log". A signal ends the wait early. Rethrows an
  /// exception of a handler; the messages after it are kept for the next call.
  /// @throws std::runtime_error if the connection breaks.
  bool handle(std::chrono::milliseconds timeout);

  /// True where the input is a log: time then comes from messages.
  bool is_replay() const;
  /// True where the output is a log.
  bool is_recording() const;
  /// Largest utime of a message handled, PROCESS_INFO excepted (its time is the clock's); −1 before
  /// the first. It never runs backwards.
  std::int64_t last_utime() const;
  /// Event time of the log's event in hand, of its first event before that [µs since 1970]; −1
  /// where the input is no log or an empty one.
  std::int64_t event_utime() const;
  /// Name → count, for every subscribed channel "received CHANNEL" (all that arrived), "malformed
  /// …", "senseless …", "skipped …"; "incomplete CHANNEL" (messages that lost a piece, if there are
  /// any), "published CHANNEL", "send failed CHANNEL", "truncated log", "incomplete messages of
  /// log".
  std::map<std::string, std::int64_t> counters() const;

 private:
  struct Incoming {
    std::shared_ptr<const void> message;  ///< null if it is malformed or makes no sense
    std::int64_t utime = -1;
    std::string problem;
    bool is_malformed = false;
  };
  using Decoder = Incoming (*)(const void* data, std::size_t size);
  using Handler = std::function<void(const void* message)>;

  template <class Message>
  static Incoming decode_incoming(const void* data, std::size_t size) {
    Decoded<Message> decoded = decode<Message>(data, size);
    Incoming incoming;
    incoming.problem = std::move(decoded.problem);
    incoming.is_malformed = decoded.is_malformed;
    if (decoded.message) {
      incoming.utime = decoded.message->utime;
      incoming.message = std::make_shared<const Message>(*std::move(decoded.message));
    }
    return incoming;
  }

  template <class Message>
  static Handler erase(std::function<void(const Message&)> handler) {
    return [handler = std::move(handler)](const void* message) {
      handler(*static_cast<const Message*>(message));
    };
  }

  /// When a queue is full LCM drops the *newest* message, so queues must not fill up. LCM's 30 are
  /// a third of a second at 100 Hz, less than a slow handler may take. 10 000 small messages are
  /// some 10 MB; 60 frames are 4 s of images at 15 Hz and 75 MB.
  template <class Message>
  static constexpr int queue_capacity() {
    return std::is_same_v<Message, camera_image_t> ? 60 : 10'000;
  }

  void subscribe_raw(const std::string& channel, Decoder decoder, int queue_capacity,
                     Handler handler, bool latest_only);
  void publish_raw(const std::string& channel, std::span<const std::uint8_t> bytes,
                   bool may_be_split);

  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// The default URL: $LCM_DEFAULT_URL, else udpm://239.255.76.67:7667?ttl=0.
std::string default_url();

}  // namespace bodyschema
