// Decoding of any bytes must neither crash nor allocate wildly. Always built with
// AddressSanitizer and UBSan, whatever the rest is built with: an out-of-bounds read is a failure
// here even if it would go unnoticed elsewhere.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "bodyschema/message_piece_t.hpp"
#include "common/bus/check.h"
#include "common/bus/codec.h"
#include "tests/lcmtypes/example_messages.h"

// g++ 12 does not install sanitizer/allocator_interface.h.
extern "C" int __sanitizer_install_malloc_and_free_hooks(void (*on_malloc)(const volatile void*,
                                                                           std::size_t),
                                                         void (*on_free)(const volatile void*));

namespace bodyschema::test {
namespace {

constexpr int kMutationsPerChannel = 100'000;

using Bytes = std::vector<std::uint8_t>;
using Rng = std::mt19937_64;

std::size_t allocated_bytes = 0;

void on_allocation(const volatile void*, std::size_t size) { allocated_bytes += size; }
void on_free(const volatile void*) {}

/// AddressSanitizer tells of every allocation.
const int hooks_installed = __sanitizer_install_malloc_and_free_hooks(&on_allocation, &on_free);

std::size_t below(Rng& rng, std::size_t bound) { return bound == 0 ? 0 : rng() % bound; }

void write_int32(Bytes& bytes, std::size_t at, std::uint32_t value) {
  for (std::size_t i = 0; i < 4 && at + i < bytes.size(); ++i) {
    bytes[at + i] = static_cast<std::uint8_t>(value >> (8 * (3 - i)));
  }
}

/// One to four mutations. The fingerprint is spared, or the bytes after it would not be tested.
Bytes mutate(const Bytes& original, Rng& rng) {
  constexpr std::uint32_t kEvilCounts[] = {0,          1,          2,          0x7FFFFFFF,
                                           0xFFFFFFFF, 0x80000000, 0x10000000, 0x20000000,
                                           0x40000000, 255,        65536,      1000000};
  Bytes bytes = original;
  for (std::size_t n = 1 + below(rng, 4); n > 0; --n) {
    const std::size_t body = bytes.size() > 8 ? bytes.size() - 8 : 0;
    const std::size_t at = 8 + below(rng, body);
    if (body == 0) break;
    switch (below(rng, 6)) {
      case 0:
        bytes[at] ^= static_cast<std::uint8_t>(1U << below(rng, 8));
        break;
      case 1:
        bytes[at] = static_cast<std::uint8_t>(rng());
        break;
      case 2:
        write_int32(bytes, at, kEvilCounts[below(rng, std::size(kEvilCounts))]);
        break;
      case 3:
        bytes.resize(at);
        break;
      case 4:
        bytes.insert(bytes.begin() + static_cast<std::ptrdiff_t>(at), below(rng, 40),
                     static_cast<std::uint8_t>(rng()));
        break;
      default:
        bytes.erase(bytes.begin() + static_cast<std::ptrdiff_t>(at),
                    bytes.begin() +
                        static_cast<std::ptrdiff_t>(std::min(bytes.size(), at + below(rng, 40))));
    }
  }
  return bytes;
}

/// Copied to the exact size on the heap, so that AddressSanitizer detects the first byte beyond.
template <class Message>
bool decodes(const Bytes& bytes) {
  const std::unique_ptr<std::uint8_t[]> exact(new std::uint8_t[bytes.size()]);
  std::copy(bytes.begin(), bytes.end(), exact.get());
  allocated_bytes = 0;
  Message message{};
  const int size = static_cast<int>(bytes.size());
  const bool is_good = message.decode(exact.get(), 0, size) == size;
  EXPECT_LE(allocated_bytes, 12 * bytes.size() + 4096)
      << Message::getTypeName() << " of " << bytes.size() << " bytes";
  // Decoded messages must be safe to check, and checked ones safe to encode.
  if (is_good && check(message).empty()) {
    Bytes again(static_cast<std::size_t>(message.getEncodedSize()));
    EXPECT_EQ(message.encode(again.data(), 0, static_cast<int>(again.size())),
              static_cast<int>(again.size()));
  }
  return is_good;
}

TEST(Mutation, NoDamagedMessageCrashesTheDecoderOrMakesItAllocateWildly) {
  ASSERT_NE(hooks_installed, 0);
  Rng rng(20240229);
  for_each_channel([&](const auto& channel, const auto& message) {
    using Message = std::decay_t<decltype(message)>;
    // BODY_SCHEMA's type.
    if (std::string(channel.name) == kLearnedSchema.name) return;
    if (std::string(channel.name) == kRefinedSchema.name) return;
    const Bytes original = encode(channel, message);
    ASSERT_TRUE(decodes<Message>(original));
    int num_refused = 0;
    for (int n = 0; n < kMutationsPerChannel; ++n) {
      if (!decodes<Message>(mutate(original, rng))) ++num_refused;
      if (testing::Test::HasFailure()) return;
    }
    EXPECT_GT(num_refused, kMutationsPerChannel / 10) << channel.name;
  });
}

TEST(Mutation, NoDamagedPieceCrashesTheJoinerOrMakesItKeepMuch) {
  message_piece_t piece{};
  piece.piece_sender = 7;
  piece.whole_fingerprint = sample_t::getHash();
  piece.num_pieces = 3;
  piece.num_bytes = 100;
  piece.piece.assign(100, 1);
  std::vector<Bytes> originals;
  for (; piece.piece_index < piece.num_pieces; ++piece.piece_index) {
    Bytes& bytes = originals.emplace_back(static_cast<std::size_t>(piece.getEncodedSize()));
    piece.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  }
  Rng rng(20240301);
  PieceJoiner joiner;
  int num_refused = 0;
  for (int n = 0; n < kMutationsPerChannel; ++n) {
    const Bytes bytes = mutate(originals[below(rng, originals.size())], rng);
    const std::unique_ptr<std::uint8_t[]> exact(new std::uint8_t[bytes.size()]);
    std::copy(bytes.begin(), bytes.end(), exact.get());
    std::string problem;
    allocated_bytes = 0;
    joiner.add({exact.get(), bytes.size()}, &problem);
    // An unfinished message has room for all its pieces' names.
    ASSERT_LE(allocated_bytes, 12 * bytes.size() + 16'384);
    num_refused += problem.empty() ? 0 : 1;
  }
  EXPECT_GT(num_refused, kMutationsPerChannel / 10);
  EXPECT_LE(joiner.num_unfinished(), static_cast<std::int64_t>(PieceJoiner::kMostUnfinished));
}

TEST(Mutation, EveryTruncationIsRefused) {
  for_each_channel([&](const auto& channel, const auto& message) {
    using Message = std::decay_t<decltype(message)>;
    const Bytes original = encode(channel, message);
    for (std::size_t size = 0; size < original.size(); ++size) {
      ASSERT_FALSE(decodes<Message>(
          Bytes(original.begin(), original.begin() + static_cast<std::ptrdiff_t>(size))))
          << channel.name << " cut to " << size;
    }
  });
}

TEST(Mutation, EveryCountOfEveryMessageMayBeHuge) {
  for_each_channel([&](const auto& channel, const auto& message) {
    using Message = std::decay_t<decltype(message)>;
    const Bytes original = encode(channel, message);
    for (std::size_t at = 8; at + 4 <= original.size(); ++at) {
      for (const std::uint32_t evil : {0x7FFFFFFFU, 0x80000000U, 0xFFFFFFFFU, 0x20000001U}) {
        Bytes bytes = original;
        write_int32(bytes, at, evil);
        decodes<Message>(bytes);
      }
    }
  });
}

TEST(Mutation, AMessageWithTooLargeACountIsNeverEncoded) {
  sample_t sample = example_sample();
  ++sample.num_parts;
  EXPECT_THROW(encode(kSample, sample), std::logic_error);
  sample = example_sample();
  ++sample.parts[1].num_tags;
  EXPECT_THROW(encode(kSample, sample), std::logic_error);
  sim_state_t state = example_sim_state();
  state.geom_alpha.pop_back();
  EXPECT_THROW(encode(kSimState, state), std::logic_error);
}

}  // namespace
}  // namespace bodyschema::test
