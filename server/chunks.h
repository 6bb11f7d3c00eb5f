/// Bodies of Transfer-Encoding: chunked.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

namespace brdfit::server {

/// Takes a chunked body piece by piece. Extensions and trailers are passed over, within bounds.
class ChunkReader {
public:
    enum class State : std::uint8_t { more, whole, malformed, too_large };

    /// Appends what `input` holds of the body to it, at most up to `largest` bytes, and takes it off the input.
    State read(std::string_view& input, std::string& body, std::size_t largest);

private:
    enum class Part : std::uint8_t { size, data, end_of_data, trailer };

    /// Takes a line off the input; false while its end has not come or if it is none.
    bool take_line(std::string_view& input);
    State state_ = State::more;
    Part part_ = Part::size;
    std::string line_;
    std::size_t left_ = 0;  ///< bytes of the chunk that are still to come
    std::size_t trailer_bytes_ = 0;
};

}  // namespace brdfit::server
