#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "common/bus/channels.h"
#include "common/bus/check.h"
#include "common/bus/pieces.h"

namespace bodyschema {

/// LCM's own limit [bytes]. Images may be so large.
inline constexpr std::size_t kLargestMessage = std::size_t{1} << 28;

/// [bytes]. Images travel in LCM's own fragments, on a port of their own; all else in our pieces.
template <class Message>
inline constexpr std::size_t kLargestOf =
    std::is_same_v<Message, camera_image_t> ? kLargestMessage : kLargestInPieces;

/// What came of received bytes: a message, or the reason why there is none.
template <class Message>
struct Decoded {
  std::optional<Message> message;
  std::string problem;
  /// True if `problem` was found by decoding, false if by check().
  bool is_malformed = false;
};

/// Text for a fingerprint that is not the expected one, and for other malformed bytes.
std::string describe_malformed(const void* data, std::size_t size, const char* type_name,
                               std::int64_t fingerprint);

/// Decodes to the last byte and checks that the result makes sense. Never throws on bad bytes.
template <class Message>
Decoded<Message> decode(const void* data, std::size_t size) {
  Decoded<Message> result;
  Message message{};
  if (size > kLargestOf<Message> ||
      message.decode(data, 0, static_cast<int>(size)) != static_cast<int>(size)) {
    result.problem = describe_malformed(data, size, Message::getTypeName(), Message::getHash());
    result.is_malformed = true;
    return result;
  }
  result.problem = check(message);
  if (result.problem.empty()) result.message = std::move(message);
  return result;
}

/// The bytes that travel. Checked first, because the generated encoder trusts the counts: a count
/// above the length of its array would be read out of bounds.
/// @throws std::logic_error if the message does not pass check(): a bug of its sender;
/// std::runtime_error if it is larger than kLargestOf.
template <class Message>
std::vector<std::uint8_t> encode(const Channel<Message>& channel, const Message& message) {
  const std::string problem = check(message);
  if (!problem.empty()) {
    throw std::logic_error(std::string(channel.name) + " must not be sent: " + problem);
  }
  std::vector<std::uint8_t> bytes(static_cast<std::size_t>(message.getEncodedSize()));
  if (bytes.size() > kLargestOf<Message>) {
    throw std::runtime_error(std::string(channel.name) + " of " + std::to_string(bytes.size()) +
                             " bytes: at most " + std::to_string(kLargestOf<Message>) + " travel");
  }
  const int size = static_cast<int>(bytes.size());
  if (message.encode(bytes.data(), 0, size) != size) {
    throw std::logic_error(std::string(channel.name) + " could not be encoded");
  }
  return bytes;
}

}  // namespace bodyschema
