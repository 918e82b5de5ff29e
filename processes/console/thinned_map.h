#pragma once

#include <cstddef>
#include <cstdint>
#include <map>

namespace bodyschema {

/// Values by an integer key, at most `kMost`: where there are more, only those whose mixed key is a
/// multiple of 2, of 4, … are kept. Which ones depends on the keys and their number alone, so that
/// two maps over the same keys keep the same ones but for the strides, whatever came first.
template <class Value>
class ThinnedMap {
 public:
  static constexpr std::size_t kMost = 4096;

  /// The value of the key, made where there is none; nullptr where the key is not kept.
  Value* insert(std::int64_t key, Value value) {
    if (!is_kept(key)) return nullptr;
    Value* const inserted = &values_.try_emplace(key, std::move(value)).first->second;
    if (values_.size() <= kMost) return inserted;
    stride_ *= 2;
    std::erase_if(values_, [this](const auto& entry) { return !is_kept(entry.first); });
    return find(key);
  }
  Value* find(std::int64_t key) {
    const auto found = values_.find(key);
    return found == values_.end() ? nullptr : &found->second;
  }
  const Value* find(std::int64_t key) const { return const_cast<ThinnedMap*>(this)->find(key); }

  auto begin() const { return values_.begin(); }
  auto end() const { return values_.end(); }
  std::size_t size() const { return values_.size(); }

 private:
  /// Keys may be times at an even pace: mixed, their low bits are as good as random (the finaliser
  /// of MurmurHash3).
  static std::uint64_t mixed(std::int64_t key) {
    auto x = static_cast<std::uint64_t>(key);
    x = (x ^ (x >> 33)) * 0xff51afd7ed558ccdULL;
    x = (x ^ (x >> 33)) * 0xc4ceb9fe1a85ec53ULL;
    return x ^ (x >> 33);
  }
  bool is_kept(std::int64_t key) const { return mixed(key) % stride_ == 0; }

  std::map<std::int64_t, Value> values_;
  std::uint64_t stride_ = 1;
};

}  // namespace bodyschema
