#include "common/bus/pieces.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>

#include "bodyschema/message_piece_t.hpp"
#include "common/bus/bus.h"
#include "common/bus/event_log.h"
#include "common/bus/log_summary.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes message_of(std::size_t size, int seed = 1) {
  std::mt19937 rng(static_cast<unsigned>(seed));
  Bytes bytes(size);
  for (std::uint8_t& byte : bytes) byte = static_cast<std::uint8_t>(rng());
  return bytes;
}

/// Joins pieces in the order given; complete messages go to `whole`.
struct Receiver {
  void hear(const Bytes& piece) {
    std::string problem;
    if (auto message = joiner.add(piece, &problem)) whole.push_back(*std::move(message));
    if (!problem.empty()) problems.push_back(problem);
  }
  void hear(const std::vector<Bytes>& pieces) {
    for (const Bytes& piece : pieces) hear(piece);
  }
  PieceJoiner joiner;
  std::vector<Bytes> whole;
  std::vector<std::string> problems;
};

message_piece_t decoded(const Bytes& bytes) {
  message_piece_t piece{};
  EXPECT_EQ(piece.decode(bytes.data(), 0, static_cast<int>(bytes.size())),
            static_cast<int>(bytes.size()));
  return piece;
}

Bytes encoded(const message_piece_t& piece) {
  Bytes bytes(static_cast<std::size_t>(piece.getEncodedSize()));
  piece.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  return bytes;
}

TEST(Pieces, EachFitsOneDatagramAndTogetherTheyAreTheMessage) {
  for (const std::size_t size :
       {kLargestDatagram + 1, 2 * kPieceBytes, 2 * kPieceBytes + 1, kLargestInPieces}) {
    const Bytes message = message_of(size);
    const auto pieces = PieceMaker().split(message);
    EXPECT_EQ(pieces.size(), (size + kPieceBytes - 1) / kPieceBytes);
    Receiver receiver;
    for (const Bytes& piece : pieces) {
      EXPECT_LE(piece.size(), kLargestDatagram);
      EXPECT_TRUE(is_piece(piece));
      receiver.hear(piece);
    }
    EXPECT_EQ(receiver.whole, std::vector<Bytes>{message}) << size;
  }
  EXPECT_FALSE(is_piece(message_of(100)));
  EXPECT_FALSE(is_piece(Bytes(7)));
  EXPECT_THROW(PieceMaker().split(Bytes(kLargestInPieces + 1)), std::runtime_error);
}

TEST(Pieces, MayComeInAnyOrderAndTwice) {
  const Bytes message = message_of(5 * kPieceBytes);
  std::vector<Bytes> pieces = PieceMaker().split(message);
  std::mt19937 rng(4);
  for (int n = 0; n < 20; ++n) {
    std::shuffle(pieces.begin(), pieces.end(), rng);
    Receiver receiver;
    receiver.hear(pieces[0]);
    receiver.hear(pieces);
    receiver.hear(pieces[1]);
    EXPECT_EQ(receiver.whole, std::vector<Bytes>{message});
    EXPECT_TRUE(receiver.problems.empty());
    EXPECT_EQ(receiver.joiner.num_unfinished(), 0);
  }
}

TEST(Pieces, AMessageOfWhichOneIsMissingIsLostAndCountedAndTheNextIsWhole) {
  PieceMaker sender;
  Receiver receiver;
  auto pieces = sender.split(message_of(3 * kPieceBytes));
  pieces.erase(pieces.begin() + 1);
  receiver.hear(pieces);
  EXPECT_TRUE(receiver.whole.empty());
  const Bytes next = message_of(2 * kPieceBytes, 2);
  receiver.hear(sender.split(next));
  EXPECT_EQ(receiver.whole, std::vector<Bytes>{next});
  EXPECT_EQ(receiver.joiner.num_lost(), 1);
  EXPECT_EQ(receiver.joiner.num_unfinished(), 0);
}

TEST(Pieces, OfTwoSendersDoNotMix) {
  PieceMaker one, two;
  const Bytes a = message_of(4 * kPieceBytes, 1), b = message_of(4 * kPieceBytes, 2);
  const auto as = one.split(a), bs = two.split(b);
  Receiver receiver;
  for (std::size_t i = 0; i < as.size(); ++i) {
    receiver.hear(as[i]);
    receiver.hear(bs[i]);
  }
  EXPECT_EQ(receiver.whole, (std::vector<Bytes>{a, b}));
  EXPECT_EQ(receiver.joiner.num_lost(), 0);
}

TEST(Pieces, UnfinishedMessagesAreBounded) {
  Receiver receiver;
  for (int n = 0; n < 100; ++n) receiver.hear(PieceMaker().split(message_of(2 * kPieceBytes))[0]);
  EXPECT_EQ(receiver.joiner.num_unfinished(),
            static_cast<std::int64_t>(PieceJoiner::kMostUnfinished));
  EXPECT_EQ(receiver.joiner.num_lost(), 96);
}

TEST(Pieces, ThatMakeNoSenseAreRefused) {
  const auto pieces = PieceMaker().split(message_of(3 * kPieceBytes));
  const auto refused = [&](auto change) {
    message_piece_t piece = decoded(pieces[0]);
    change(piece);
    Receiver receiver;
    receiver.hear(encoded(piece));
    return receiver.problems.size() == 1 && receiver.joiner.num_unfinished() == 0;
  };
  EXPECT_FALSE(refused([](auto&) {}));
  for (const int num : {-1, 0, 1, kMostPieces + 1, 2'000'000'000})
    EXPECT_TRUE(refused([&](auto& m) { m.num_pieces = num; })) << num;
  for (const int index : {-1, 3}) EXPECT_TRUE(refused([&](auto& m) { m.piece_index = index; }));
  EXPECT_TRUE(refused([](auto& m) {
    m.num_bytes = 0;
    m.piece.clear();
  }));
  EXPECT_TRUE(refused([](auto& m) { m.whole_fingerprint = message_piece_t::getHash(); }));

  Receiver receiver;
  receiver.hear(Bytes(pieces[0].begin(), pieces[0].begin() + 40));
  EXPECT_EQ(receiver.problems.size(), 1U) << "cut off";
  receiver.hear(pieces[0]);
  message_piece_t other = decoded(pieces[1]);
  other.num_pieces = 4;
  receiver.hear(encoded(other));
  other = decoded(pieces[1]);
  ++other.whole_fingerprint;
  receiver.hear(encoded(other));
  EXPECT_EQ(receiver.problems.size(), 3U);
  receiver.hear(std::vector<Bytes>{pieces[1], pieces[2]});
  EXPECT_EQ(receiver.whole.size(), 1U) << "the good ones are kept";

  message_piece_t lying = decoded(PieceMaker().split(message_of(2 * kPieceBytes))[0]);
  Receiver deceived;
  lying.whole_fingerprint = 7;
  deceived.hear(encoded(lying));
  lying.piece_index = 1;
  deceived.hear(encoded(lying));
  EXPECT_TRUE(deceived.whole.empty());
  EXPECT_EQ(deceived.problems.size(), 1U);
}

TEST(Pieces, ALargeMessageGoesOverTheBusAndIntoALogAsOne) {
  const body_schema_t schema = large_schema(200);
  ASSERT_GT(schema.getEncodedSize(), static_cast<int>(2 * kLargestDatagram));
  const TemporaryFolder folder;
  {
    Bus bus("memq://", "memq://");
    std::vector<body_schema_t> heard;
    bus.subscribe(kBodySchema, [&](const body_schema_t& m) { heard.push_back(m); });
    bus.publish(kBodySchema, schema);
    bus.publish(kBodySchema, example_body_schema());
    ASSERT_TRUE(handle_until(bus, [&] { return heard.size() == 2; }));
    EXPECT_EQ(encode(kBodySchema, heard[0]), encode(kBodySchema, schema));
    EXPECT_EQ(bus.counters().at("received BODY_SCHEMA"), 2);
    Bus log("", "file://" + (folder / "log").string() + "?mode=w");
    log.publish(kBodySchema, schema);
  }
  LogReader reader(folder / "log", OnDamage::kThrow, 0, Pieces::kAsRecorded);
  ASSERT_TRUE(reader.next());
  EXPECT_FALSE(is_piece(reader.event().data));
  EXPECT_FALSE(reader.next());
}

TEST(Pieces, ALogInWhichTheyWereRecordedIsReadAsIfWhole) {
  const TemporaryFolder folder;
  const body_schema_t schema = large_schema(200);
  {
    PieceMaker sender;
    LogAppender log(folder / "log");
    auto lost = sender.split(encode(kBodySchema, schema));
    lost.pop_back();
    for (const Bytes& piece : lost) log.append_bytes("BODY_SCHEMA", piece, 1);
    for (const Bytes& piece : sender.split(encode(kBodySchema, schema))) {
      log.append_bytes("BODY_SCHEMA", piece, 2);
      log.append(kSample, example_sample());
    }
  }
  LogReport report;
  const auto schemas = read_log(folder / "log", kBodySchema, &report);
  ASSERT_EQ(schemas.size(), 1U);
  EXPECT_EQ(encode(kBodySchema, schemas[0]), encode(kBodySchema, schema));
  EXPECT_EQ(report.incomplete, 1);
  EXPECT_FALSE(summarize_log(folder / "log").is_sound());

  Bus replay("file://" + (folder / "log").string() + "?speed=0", "");
  int num_schemas = 0, num_samples = 0;
  replay.subscribe(kBodySchema, [&](const body_schema_t&) { ++num_schemas; });
  replay.subscribe(kSample, [&](const sample_t&) { ++num_samples; });
  while (replay.handle(std::chrono::milliseconds(0))) {
  }
  EXPECT_EQ(num_schemas, 1);
  EXPECT_GT(num_samples, 2);
  EXPECT_EQ(replay.counters().at("incomplete messages of log"), 1);
  EXPECT_EQ(replay.counters().at("malformed BODY_SCHEMA"), 0);
}

}  // namespace
}  // namespace bodyschema::test
