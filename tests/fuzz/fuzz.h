/// What the fuzz targets share. A target turns bytes into a call and checks what holds of every answer; libFuzzer
/// (https://llvm.org/docs/LibFuzzer.html) finds the bytes, the sanitizers see what goes wrong without a word.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <span>
#include <string>
#include <string_view>

#include "kernels/model.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

namespace brdfit::fuzz {

/// Ends the process where a property does not hold: libFuzzer keeps the input.
inline void require(bool holds, const std::string& what) {
    if (holds) return;
    std::fprintf(stderr, "PROPERTY: %s\n", what.c_str());
    std::abort();
}

inline std::string_view text_of(const std::uint8_t* data, std::size_t size) {
    return {reinterpret_cast<const char*>(data), size};
}

inline const kernels::Catalogue& catalogue() {
    static const kernels::Catalogue instance;
    return instance;
}

/// Takes an input apart; zeros follow its end.
class Bytes {
public:
    Bytes(const std::uint8_t* data, std::size_t size) : rest_(data, size) {}
    [[nodiscard]] bool empty() const { return rest_.empty(); }
    std::uint8_t byte() {
        if (rest_.empty()) return 0;
        const std::uint8_t value = rest_.front();
        rest_ = rest_.subspan(1);
        return value;
    }
    /// [0, 1] in steps of 2^-32.
    double fraction() {
        std::uint32_t bits = 0;
        for (int i = 0; i < 4; ++i) bits = bits << 8U | byte();
        return bits / 4294967295.0;
    }

private:
    std::span<const std::uint8_t> rest_;
};

}  // namespace brdfit::fuzz
