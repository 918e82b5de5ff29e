#pragma once

#include <algorithm>
#include <string>
#include <type_traits>
#include <vector>

namespace bodyschema {

/// The fewest bytes that one element of a message's array takes on the wire: its own size for a
/// number, its length and terminating zero for a string, that of an empty message (all counts 0)
/// for a message. The hardened decoders (harden.sed) compare a count with what is left of the
/// buffer before they allocate, so decoding never allocates more than a small multiple of what was
/// received.
template <class Element>
int least_wire_size(const std::vector<Element>&) {
  if constexpr (std::is_arithmetic_v<Element>) {
    return sizeof(Element);
  } else if constexpr (std::is_same_v<Element, std::string>) {
    return 5;
  } else {
    static const int size = std::max(1, Element()._getEncodedSizeNoHash());
    return size;
  }
}

}  // namespace bodyschema
