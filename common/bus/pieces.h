#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <list>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

namespace bodyschema {

// A message beyond one datagram travels as numbered pieces (message_piece_t) on its own channel,
// whole or not at all. The fingerprint distinguishes a piece from a whole message.

/// The largest message that travels whole [bytes]. LCM has fragments of its own from 65 487 B on,
/// which two forged packets turn into a crash of any receiver.
inline constexpr std::size_t kLargestDatagram = 64'000;
/// The largest message that travels in pieces [bytes]: twice a schema of 10 000 parts, the most
/// that check() lets pass. It bounds the memory for pieces of messages that stay incomplete.
inline constexpr std::size_t kLargestInPieces = std::size_t{16} << 20;
/// Bytes of the whole message in each piece but the last: with its head a piece is no larger than
/// kLargestDatagram.
inline constexpr std::size_t kPieceBytes = kLargestDatagram - 64;
inline constexpr std::int32_t kMostPieces =
    static_cast<std::int32_t>((kLargestInPieces + kPieceBytes - 1) / kPieceBytes);

bool is_piece(std::span<const std::uint8_t> bytes);

/// Splits the messages of one sender.
class PieceMaker {
 public:
  PieceMaker();
  /// The encoded pieces of an encoded message.
  /// @throws std::runtime_error if it is larger than kLargestInPieces.
  std::vector<std::vector<std::uint8_t>> split(std::span<const std::uint8_t> whole);

 private:
  const std::int64_t sender_;
  std::int64_t next_number_ = 0;
};

/// Joins the pieces of one channel: in any order, of several senders at a time. Keeps
/// kMostUnfinished messages at most; the one that was begun first gives way. A message with a
/// missing piece is lost once a later one of its sender is whole.
class PieceJoiner {
 public:
  static constexpr std::size_t kMostUnfinished = 4;

  /// The whole message if this is its last missing piece. Otherwise std::nullopt, and `problem` is
  /// "" or says why the piece is left out.
  std::optional<std::vector<std::uint8_t>> add(std::span<const std::uint8_t> piece,
                                               std::string* problem);
  /// Messages with missing pieces, except those that may still become whole.
  std::int64_t num_lost() const { return num_lost_; }
  std::int64_t num_unfinished() const { return static_cast<std::int64_t>(unfinished_.size()); }

 private:
  struct Unfinished {
    std::int64_t sender = 0, number = 0, fingerprint = 0;
    std::vector<std::vector<std::uint8_t>> pieces;  ///< empty: missing
    std::size_t num_missing = 0;
  };
  std::list<Unfinished> unfinished_;  ///< in the order of their first pieces
  std::deque<std::pair<std::int64_t, std::int64_t>> newest_whole_;  ///< (sender, number)
  std::int64_t num_lost_ = 0;
};

}  // namespace bodyschema
