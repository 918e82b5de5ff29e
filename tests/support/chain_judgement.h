#pragma once

#include <string>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema::test {

enum class Rightness { kRight, kIncomplete, kWrong };

/// A chain of joints between two parts, put together from one of them to the other: an edge that
/// is the truth.
class TrueChain {
 public:
  TrueChain(int from, int to) {
    edge_.from = from;
    edge_.to = to;
  }
  void move(const Pose& X);
  /// A joint along and about z, by slide and turn per command unit from the command `zero` on.
  void add(int signal, double slide, double turn, double zero);
  const Edge& edge() const { return edge_; }

 private:
  Edge edge_;
};

struct ChainVerdict {
  Rightness rightness = Rightness::kRight;
  std::string reason = {};  ///< "" if right
};

/// A long edge (three joints or more in the truth) beside the true edge between its two parts.
/// Right: a joint for each true one, on its signal; in an order that gives the same motion, that
/// is, joints may change places if they commute (their twists' Lie bracket is zero); and travels of
/// joints over the ranges of their signals within 5 %. Incomplete: the order of joints that do not
/// commute is left open. Wrong: the rest. An edge without gains (turn and slide 0 everywhere) is
/// judged without them, as are joints with bent commands.
ChainVerdict judge_chain(const Edge& edge, const Edge& truth, const std::vector<Signal>& signals);

}  // namespace bodyschema::test
