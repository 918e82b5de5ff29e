#include "common/bus/pieces.h"

#include <spdlog/fmt/fmt.h>

#include <algorithm>
#include <random>
#include <stdexcept>
#include <utility>

#include "bodyschema/message_piece_t.hpp"

namespace bodyschema {
namespace {

std::int64_t fingerprint_of(std::span<const std::uint8_t> bytes) {
  std::uint64_t fingerprint = 0;
  for (std::size_t i = 0; i < 8; ++i) fingerprint = (fingerprint << 8) | bytes[i];
  return static_cast<std::int64_t>(fingerprint);
}

/// Length of the shortest message: a fingerprint.
constexpr std::size_t kLeastMessage = 8;

/// Problem of the contents of an encoded piece; "" if there is none.
std::string check_piece(const message_piece_t& piece) {
  if (piece.num_pieces < 2 || piece.num_pieces > kMostPieces)
    return fmt::format("a message of {} pieces, outside 2 … {}", piece.num_pieces, kMostPieces);
  if (piece.piece_index < 0 || piece.piece_index >= piece.num_pieces)
    return fmt::format("piece {} of {}", piece.piece_index, piece.num_pieces);
  if (piece.piece.empty() || piece.piece.size() > kPieceBytes)
    return fmt::format("a piece of {} bytes, outside 1 … {}", piece.piece.size(), kPieceBytes);
  if (piece.whole_fingerprint == message_piece_t::getHash()) return "a piece of a piece";
  return "";
}

}  // namespace

bool is_piece(std::span<const std::uint8_t> bytes) {
  return bytes.size() >= kLeastMessage && fingerprint_of(bytes) == message_piece_t::getHash();
}

PieceMaker::PieceMaker()
    : sender_([] {
        std::random_device random;
        return static_cast<std::int64_t>((std::uint64_t{random()} << 32) | random());
      }()) {}

std::vector<std::vector<std::uint8_t>> PieceMaker::split(std::span<const std::uint8_t> whole) {
  if (whole.size() > kLargestInPieces) {
    throw std::runtime_error(
        fmt::format("a message of {} bytes, at most {} travel", whole.size(), kLargestInPieces));
  }
  if (whole.size() < kLeastMessage) throw std::logic_error("too short for a message");
  message_piece_t piece{};
  piece.piece_sender = sender_;
  piece.whole_number = next_number_++;
  piece.whole_fingerprint = fingerprint_of(whole);
  piece.num_pieces = static_cast<std::int32_t>((whole.size() + kPieceBytes - 1) / kPieceBytes);
  std::vector<std::vector<std::uint8_t>> pieces;
  for (; !whole.empty(); ++piece.piece_index) {
    const auto part = whole.first(std::min(kPieceBytes, whole.size()));
    whole = whole.subspan(part.size());
    piece.piece.assign(part.begin(), part.end());
    piece.num_bytes = static_cast<std::int32_t>(part.size());
    std::vector<std::uint8_t>& bytes = pieces.emplace_back(piece.getEncodedSize());
    piece.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  }
  return pieces;
}

std::optional<std::vector<std::uint8_t>> PieceJoiner::add(std::span<const std::uint8_t> bytes,
                                                          std::string* problem) {
  message_piece_t piece{};
  const bool is_decoded = bytes.size() <= kLargestInPieces &&
                          piece.decode(bytes.data(), 0, static_cast<int>(bytes.size())) ==
                              static_cast<int>(bytes.size());
  *problem = is_decoded ? check_piece(piece)
                        : fmt::format("{} bytes do not decode as a piece", bytes.size());
  if (!problem->empty()) return std::nullopt;

  auto message = std::find_if(unfinished_.begin(), unfinished_.end(), [&](const Unfinished& m) {
    return m.sender == piece.piece_sender && m.number == piece.whole_number;
  });
  if (message == unfinished_.end()) {
    const std::pair of_piece{piece.piece_sender, piece.whole_number};
    if (std::count(newest_whole_.begin(), newest_whole_.end(), of_piece) > 0)
      return std::nullopt;  // a datagram that came twice
    if (unfinished_.size() == kMostUnfinished) {
      unfinished_.pop_front();
      ++num_lost_;
    }
    const auto n = static_cast<std::size_t>(piece.num_pieces);
    unfinished_.push_back({piece.piece_sender, piece.whole_number, piece.whole_fingerprint,
                           std::vector<std::vector<std::uint8_t>>(n), n});
    message = std::prev(unfinished_.end());
  }
  if (message->pieces.size() != static_cast<std::size_t>(piece.num_pieces) ||
      message->fingerprint != piece.whole_fingerprint) {
    *problem = "a piece that does not go with the others of its message";
    return std::nullopt;
  }
  std::vector<std::uint8_t>& place = message->pieces[static_cast<std::size_t>(piece.piece_index)];
  if (!place.empty()) return std::nullopt;  // a datagram that came twice
  place = std::move(piece.piece);
  if (--message->num_missing > 0) return std::nullopt;

  std::vector<std::uint8_t> whole;
  for (const auto& part : message->pieces) whole.insert(whole.end(), part.begin(), part.end());
  const bool is_of_its_type =
      whole.size() >= kLeastMessage && fingerprint_of(whole) == message->fingerprint;
  const std::int64_t sender = message->sender, number = message->number;
  unfinished_.erase(message);
  std::erase_if(newest_whole_, [&](const auto& newest) { return newest.first == sender; });
  if (newest_whole_.size() == kMostUnfinished) newest_whole_.pop_front();
  newest_whole_.emplace_back(sender, number);
  num_lost_ += static_cast<std::int64_t>(std::erase_if(
      unfinished_, [&](const Unfinished& m) { return m.sender == sender && m.number < number; }));
  if (!is_of_its_type) {
    *problem = "pieces that make no message of the type that they name";
    return std::nullopt;
  }
  return whole;
}

}  // namespace bodyschema
