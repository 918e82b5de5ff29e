#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <type_traits>
#include <vector>

#include "common/bus/channels.h"
#include "common/bus/pieces.h"

namespace bodyschema {

/// LCM's own limit [bytes], for images.
inline constexpr std::size_t kLargestMessage = std::size_t{1} << 28;

/// Limit of all other messages [bytes]. Images travel in LCM's fragments, all else in our pieces.
template <class Message>
inline constexpr std::size_t kLargestOf =
    std::is_same_v<Message, camera_image_t> ? kLargestMessage : kLargestInPieces;

/// Result of decoding: a message, or the reason why there is none.
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
Decoded<Message> decode(const void* data, std::size_t size);

/// The encoded bytes. The message is checked first, because the generated encoder trusts the
/// counts: a count above the length of its array would be read out of bounds.
/// @throws std::logic_error if the message does not pass check(): a bug of its sender;
/// std::runtime_error if it is larger than kLargestOf.
template <class Message>
std::vector<std::uint8_t> encode(const Channel<Message>& channel, const Message& message);

}  // namespace bodyschema
