/// Where in a text something stands, for messages; and how far a JSON parser has read.
#pragma once

#include <algorithm>
#include <cstddef>
#include <iterator>
#include <string_view>

namespace brdfit::kernels {

/// Both from 1; the column in bytes.
struct TextPlace {
    std::size_t line = 1;
    std::size_t column = 1;
};

/// The place of the byte at this offset.
inline TextPlace place_of(std::string_view text, std::size_t offset) {
    const std::string_view before = text.substr(0, offset);
    const auto last = before.rfind('\n');
    const auto breaks = static_cast<std::size_t>(std::count(before.begin(), before.end(), '\n'));
    return {breaks + 1, before.size() - (last == std::string_view::npos ? 0 : last + 1) + 1};
}

/// Characters of a text that remember how many of them have been read.
class CountedChars {
public:
    using iterator_category = std::input_iterator_tag;
    using value_type = char;
    using difference_type = std::ptrdiff_t;
    using pointer = const char*;
    using reference = const char&;

    CountedChars(const char* at, std::size_t& read) : at_(at), read_(&read) {}
    reference operator*() const { return *at_; }
    CountedChars& operator++() {
        ++at_;
        ++*read_;
        return *this;
    }
    CountedChars operator++(int) {
        const CountedChars before = *this;
        ++*this;
        return before;
    }
    bool operator==(const CountedChars& other) const { return at_ == other.at_; }

private:
    const char* at_;
    std::size_t* read_;
};

}  // namespace brdfit::kernels
