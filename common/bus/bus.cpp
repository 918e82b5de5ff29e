#include "common/bus/bus.h"

#include <lcm/lcm.h>
#include <poll.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <filesystem>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <vector>

#include "common/bus/bus_url.h"
#include "common/bus/event_log.h"
#include "common/text/clock.h"

namespace bodyschema {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds kLongestBatch{100};
/// Events of other channels that one handle() skips in a replay.
constexpr int kMostSkipped = 10'000;
constexpr const char* kDefaultUrl = "udpm://239.255.76.67:7667?ttl=0";

/// LCM takes a channel for a regular expression between ^ and $.
std::string escape(const std::string& channel) {
  std::string pattern;
  for (const char c : channel) {
    if (std::isalnum(static_cast<unsigned char>(c)) == 0 && c != '_') pattern += '\\';
    pattern += c;
  }
  return pattern;
}

}  // namespace

struct Bus::Impl {
  struct Subscriber {
    Handler handler;
    bool latest_only = false;
    std::shared_ptr<const void> newest;
  };
  struct ChannelState {
    std::string name;
    Decoder decoder = nullptr;
    /// Handlers may subscribe, and a deque keeps its elements in place.
    std::deque<Subscriber> subscribers;
    std::int64_t received = 0;
    std::int64_t malformed = 0;
    std::int64_t senseless = 0;
    std::int64_t skipped = 0;
    PieceJoiner pieces;
    Impl* bus = nullptr;
  };
  struct Pending {
    ChannelState* channel;
    std::vector<std::uint8_t> bytes;
  };

  std::string in_url;
  std::string out_url;
  LcmPointer input;
  LcmPointer output;
  std::unique_ptr<LogAppender> output_log;

  std::unique_ptr<LogReader> log;
  bool log_has_event = false;
  double log_speed = 1;
  std::int64_t log_first_utime = -1;
  std::int64_t log_event_utime = -1;
  Clock::time_point log_start;

  std::map<std::string, ChannelState> channels;
  /// In order of subscription.
  std::vector<ChannelState*> order;
  std::deque<Pending> pending;
  std::int64_t last_utime = -1;

  /// Counters are read and publish() is called by other threads as well.
  mutable std::mutex mutex;
  std::map<std::string, std::int64_t> published;
  std::map<std::string, std::int64_t> failed;  ///< not sent, by channel
  bool is_sending = true;
  PieceMaker piece_maker;
  std::int64_t truncated_logs = 0;

  void open_log(const Url& url) {
    if (url.target.empty()) throw url_error(in_url, "names no file. Type file://PATH?speed=0");
    if (url.options.contains("mode") && url.options.at("mode") != "r") {
      throw url_error(in_url, "an input is not written: mode belongs to --out");
    }
    if (url.options.contains("speed")) {
      log_speed = parse_number(in_url, "speed", url.options.at("speed"));
    }
    log = std::make_unique<LogReader>(url.target);
    log_has_event = log->next();
    if (log_has_event) log_first_utime = log_event_utime = log->event().event_utime;
    if (!log_has_event) report_tail();
  }

  void open_output_log(const Url& url) {
    const auto mode = url.options.find("mode");
    if (url.target.empty() || mode == url.options.end() ||
        (mode->second != "w" && mode->second != "a") || url.options.contains("speed")) {
      throw url_error(out_url,
                      "as an output type file://PATH?mode=w (a new log) or "
                      "file://PATH?mode=a (extend it)");
    }
    output_log = std::make_unique<LogAppender>(
        url.target,
        mode->second == "w" ? LogAppender::Mode::kOverwrite : LogAppender::Mode::kAppend,
        LogAppender::Durability::kToKernel);
  }

  void report_tail() {
    const auto& truncated = log->report().truncated_at_byte;
    if (!truncated) return;
    const std::scoped_lock lock(mutex);
    ++truncated_logs;
    spdlog::warn("{}: log ends in the middle of an event at byte {}; the {} before it are used",
                 in_url, *truncated, log->report().events);
  }

  void advance_log() {
    try {
      log_has_event = log->next();
      if (!log_has_event) report_tail();
    } catch (const std::runtime_error& error) {
      // The events before this byte are good and were used; nothing after it can be trusted.
      log_has_event = false;
      const std::scoped_lock lock(mutex);
      ++truncated_logs;
      spdlog::warn("{}; the {} events before it are used", error.what(), log->report().events);
    }
  }

  /// A piece is handled with the last one of its message.
  void receive(ChannelState& channel, std::span<const std::uint8_t> bytes) {
    if (!is_piece(bytes)) return dispatch(channel, bytes);
    std::string problem;
    std::unique_lock lock(mutex);
    const auto whole = channel.pieces.add(bytes, &problem);
    if (!problem.empty()) {
      ++channel.received;
      count_dropped(channel, problem, true);
    }
    lock.unlock();
    if (whole) dispatch(channel, *whole);
  }

  /// Requires the mutex.
  void count_dropped(ChannelState& channel, const std::string& problem, bool is_malformed) {
    std::int64_t& count = is_malformed ? channel.malformed : channel.senseless;
    if (++count == 1) {
      spdlog::warn("{}: dropped a {} message: {} (further ones are only counted)", channel.name,
                   is_malformed ? "malformed" : "senseless", problem);
    }
  }

  void dispatch(ChannelState& channel, std::span<const std::uint8_t> bytes) {
    Incoming incoming = channel.decoder(bytes.data(), bytes.size());
    {
      const std::scoped_lock lock(mutex);
      ++channel.received;
      if (incoming.message == nullptr) {
        return count_dropped(channel, incoming.problem, incoming.is_malformed);
      }
    }
    if (channel.name != kProcessInfo.name) last_utime = std::max(last_utime, incoming.utime);
    bool skips = false;
    for (Subscriber& subscriber : channel.subscribers) {
      if (!subscriber.latest_only) continue;
      skips = skips || subscriber.newest != nullptr;
      subscriber.newest = incoming.message;
    }
    if (skips) {
      const std::scoped_lock lock(mutex);
      ++channel.skipped;
    }
    // By index: a handler may subscribe to its own channel.
    for (std::size_t i = 0; i < channel.subscribers.size(); ++i) {
      if (!channel.subscribers[i].latest_only)
        channel.subscribers[i].handler(incoming.message.get());
    }
  }

  void dispatch_newest() {
    for (std::size_t c = 0; c < order.size(); ++c) {
      for (std::size_t i = 0; i < order[c]->subscribers.size(); ++i) {
        Subscriber& subscriber = order[c]->subscribers[i];
        // Taken before the call, so that a message whose handler threw is not handled twice.
        const auto newest = std::exchange(subscriber.newest, nullptr);
        if (newest != nullptr) subscriber.handler(newest.get());
      }
    }
  }

  /// Called by LCM, from C: only takes the bytes along.
  static void on_lcm_message(const lcm_recv_buf_t* buffer, const char*, void* user) noexcept {
    auto* channel = static_cast<ChannelState*>(user);
    const auto* bytes = static_cast<const std::uint8_t*>(buffer->data);
    channel->bus->pending.push_back({channel, {bytes, bytes + buffer->data_size}});
  }

  void subscribe_lcm(ChannelState& channel, int queue_capacity) {
    lcm_subscription_t* subscription =
        lcm_subscribe(input.get(), escape(channel.name).c_str(), &on_lcm_message, &channel);
    if (subscription == nullptr || lcm_get_fileno(input.get()) < 0) {
      throw url_error(in_url, "the connection is dead: cannot subscribe to " + channel.name);
    }
    lcm_subscription_set_queue_capacity(subscription, queue_capacity);
  }

  /// Lets LCM hand over what has arrived, without waiting.
  void take_from_lcm() {
    // Never lcm_handle(): on memq:// it crashes when a signal interrupts its wait.
    if (lcm_handle_timeout(input.get(), 0) < 0 && errno != EINTR && errno != EAGAIN) {
      throw url_error(in_url, "the connection broke");
    }
  }

  /// −1, or errno, which may be 0.
  int send(const std::string& channel, std::span<const std::uint8_t> bytes) {
    errno = 0;
    return lcm_publish(output.get(), channel.c_str(), bytes.data(),
                       static_cast<unsigned>(bytes.size())) < 0
               ? errno
               : -1;
  }

  int send_pieces(const std::string& channel, std::span<const std::uint8_t> bytes) {
    for (const auto& piece : piece_maker.split(bytes))
      if (const int error = send(channel, piece); error >= 0) return error;
    return -1;
  }

  bool handle_live(std::chrono::milliseconds timeout) {
    const auto wait_ms = static_cast<int>(std::max<std::int64_t>(0, timeout.count()));
    if (input == nullptr) {
      ::poll(nullptr, 0, wait_ms);
      return true;
    }
    if (pending.empty()) {
      pollfd ready{lcm_get_fileno(input.get()), POLLIN, 0};
      // Interrupted by a signal or silent: the caller has other things to look at.
      if (::poll(&ready, 1, wait_ms) <= 0) return true;
    }
    const Clock::time_point begin = Clock::now();
    do {
      if (pending.empty()) take_from_lcm();
      if (pending.empty()) break;
      const Pending message = std::move(pending.front());
      pending.pop_front();
      receive(*message.channel, message.bytes);
    } while (Clock::now() - begin < kLongestBatch);
    dispatch_newest();
    return true;
  }

  /// A datagram refused by the system is lost like one dropped by the network: an interface that is
  /// down comes up again. Every other error (a dead relay, a message that is too large) stays.
  bool may_send_later(int error) const {
    return out_url.rfind("udpm://", 0) == 0 && error != 0 && error != EMSGSIZE && error != EBADF;
  }

  /// Waits until the log's next event is due. False if that is later or a signal came.
  bool wait_until_due(std::chrono::milliseconds timeout) {
    if (log_speed <= 0) return true;
    if (log_start == Clock::time_point{}) log_start = Clock::now();
    const std::chrono::duration<double, std::micro> offset(
        static_cast<double>(log->event().event_utime - log_first_utime) / log_speed);
    const auto due = log_start + std::chrono::duration_cast<Clock::duration>(offset);
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(due - Clock::now());
    if (left.count() <= 0) return true;
    const auto wait = std::max(std::chrono::milliseconds(0), std::min(left, timeout));
    return ::poll(nullptr, 0, static_cast<int>(wait.count())) == 0 && left <= timeout;
  }

  bool handle_replay(std::chrono::milliseconds timeout) {
    for (int skipped = 0; log_has_event && skipped < kMostSkipped; ++skipped) {
      const auto channel = channels.find(log->event().channel);
      if (channel == channels.end()) {
        advance_log();
        continue;
      }
      if (!wait_until_due(timeout)) return true;
      const LogEvent event = log->event();
      log_event_utime = event.event_utime;
      // First, so that an exception of a handler does not bring the same event again.
      advance_log();
      dispatch(channel->second, event.data);
      dispatch_newest();
      return true;
    }
    return log_has_event;
  }
};

Bus::Bus(const std::string& in_url, const std::string& out_url) : impl_(std::make_unique<Impl>()) {
  impl_->in_url = in_url;
  impl_->out_url = out_url;
  std::optional<Url> in;
  if (!in_url.empty()) {
    in = parse_url(in_url);
    if (in->is_file()) {
      impl_->open_log(*in);
    } else {
      impl_->input = open_lcm(in_url, *in);
    }
  }
  if (out_url.empty()) return;
  const Url out = parse_url(out_url);
  if (out.is_file()) {
    std::error_code error;
    if (in && in->is_file() && std::filesystem::equivalent(in->target, out.target, error)) {
      throw url_error(out_url, "is the log that is read");
    }
    impl_->open_output_log(out);
  } else if (in_url == out_url) {
    impl_->output = impl_->input;
  } else if (out.scheme == "memq") {
    throw url_error(out_url, "is heard by nobody unless it is the input as well");
  } else {
    impl_->output = open_lcm(out_url, out);
  }
}

Bus::~Bus() = default;

void Bus::subscribe_raw(const std::string& channel, Decoder decoder, int queue_capacity,
                        Handler handler, bool latest_only) {
  if (channel.empty() || channel.size() > LCM_MAX_CHANNEL_NAME_LENGTH) {
    throw std::logic_error("a channel's name has 1 to 63 bytes: \"" + channel + "\"");
  }
  const auto [place, is_new] = impl_->channels.try_emplace(channel);
  Impl::ChannelState& state = place->second;
  if (is_new) {
    state.name = channel;
    state.decoder = decoder;
    state.bus = impl_.get();
    impl_->order.push_back(&state);
    if (impl_->input != nullptr) impl_->subscribe_lcm(state, queue_capacity);
  } else if (state.decoder != decoder) {
    throw std::logic_error(channel + " is subscribed with two types");
  }
  state.subscribers.push_back({std::move(handler), latest_only, nullptr});
}

void Bus::publish_raw(const std::string& channel, std::span<const std::uint8_t> bytes,
                      bool may_be_split) {
  if (channel.empty() || channel.size() > LCM_MAX_CHANNEL_NAME_LENGTH) {
    throw std::logic_error("a channel's name has 1 to 63 bytes: \"" + channel + "\"");
  }
  const std::scoped_lock lock(impl_->mutex);
  if (impl_->output_log != nullptr) {
    impl_->output_log->append_bytes(channel, bytes,
                                    is_replay() ? impl_->log_event_utime : wall_clock_us());
  } else if (impl_->output != nullptr) {
    const int error = may_be_split && bytes.size() > kLargestDatagram
                          ? impl_->send_pieces(channel, bytes)
                          : impl_->send(channel, bytes);
    if (error >= 0) {
      const std::string problem =
          fmt::format("{}: cannot send {}: {}", impl_->out_url, channel,
                      error != 0 ? std::strerror(error) : "LCM refuses the message");
      if (!impl_->may_send_later(error)) throw std::runtime_error(problem);
      ++impl_->failed[channel];
      if (std::exchange(impl_->is_sending, false)) {
        spdlog::warn("{} (further ones are only counted)", problem);
      }
      return;
    }
    if (!std::exchange(impl_->is_sending, true)) spdlog::info("{}: sends again", impl_->out_url);
  } else {
    return;
  }
  ++impl_->published[channel];
}

bool Bus::handle(std::chrono::milliseconds timeout) {
  return is_replay() ? impl_->handle_replay(timeout) : impl_->handle_live(timeout);
}

bool Bus::is_replay() const { return impl_->log != nullptr; }

bool Bus::is_recording() const { return impl_->output_log != nullptr; }

std::int64_t Bus::last_utime() const { return impl_->last_utime; }

std::int64_t Bus::event_utime() const { return impl_->log_event_utime; }

std::map<std::string, std::int64_t> Bus::counters() const {
  const std::scoped_lock lock(impl_->mutex);
  std::map<std::string, std::int64_t> counters;
  for (const Impl::ChannelState* channel : impl_->order) {
    counters["received " + channel->name] = channel->received;
    counters["malformed " + channel->name] = channel->malformed;
    counters["senseless " + channel->name] = channel->senseless;
    counters["skipped " + channel->name] = channel->skipped;
    if (const std::int64_t lost = channel->pieces.num_lost(); lost > 0)
      counters["incomplete " + channel->name] = lost;
  }
  for (const auto& [channel, count] : impl_->published) counters["published " + channel] = count;
  for (const auto& [channel, count] : impl_->failed) counters["send failed " + channel] = count;
  if (impl_->log != nullptr && impl_->log->report().incomplete > 0)
    counters["incomplete messages of log"] = impl_->log->report().incomplete;
  if (impl_->truncated_logs > 0) counters["truncated log"] = impl_->truncated_logs;
  return counters;
}

std::string default_url() {
  const char* url = std::getenv("LCM_DEFAULT_URL");
  return url != nullptr && *url != '\0' ? url : kDefaultUrl;
}

}  // namespace bodyschema
