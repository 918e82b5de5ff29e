#pragma once

#include <concepts>
#include <cstdint>
#include <limits>
#include <type_traits>

namespace bodyschema {

// Kinds of message fields: which values make sense, whatever stands in other fields. describe.awk
// writes a function describe(visitor, message) for each type, in bodyschema/message_fields.h. It
// calls for each field, in the order of the .lcm file and of a message that may be const,
//   visitor(name, value, kind)               a number or text, or an array of fixed size
//   visitor(name, message)                   a message in the message, or an array of fixed size
//   visitor.array(name, count, array, kind)  an array of numbers or texts, and its count
//   visitor.array(name, count, array)        an array of messages, and its count

/// lower ≤ value ≤ upper, and finite. Of a text, which is UTF-8 without zero bytes: its length
/// [bytes].
struct Range {
  constexpr explicit Range(double low, double high = std::numeric_limits<double>::infinity())
      : lower(low), upper(high) {}
  double lower, upper;
};
/// Finite.
struct Any : Range {
  constexpr Any() : Range(-std::numeric_limits<double>::infinity()) {}
};
/// > 0 and finite.
struct Positive {};
/// ≥ 0 and finite, or −1: not measured.
struct Measured {};
/// 0 … last.
struct Constant {
  std::int8_t last;
};
/// An id ≥ 0, larger than that of the array's element before.
struct Ascending {};
/// w x y z of norm 1, up to 1e-3.
struct Quaternion {};
/// Lower triangle of a positive semidefinite matrix, up to rounding to float.
struct Covariance {};

template <class Message, class Type>
concept Is = std::same_as<std::remove_const_t<Message>, Type>;

}  // namespace bodyschema
