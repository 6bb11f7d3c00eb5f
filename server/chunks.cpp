#include "server/chunks.h"

#include <algorithm>
#include <charconv>

namespace brdfit::server {
namespace {

constexpr std::size_t kLongestLine = 1024;
constexpr std::size_t kLongestTrailer = 8192;
/// From here on memory is reserved for the largest body: what is not written to takes none.
constexpr std::size_t kLargeBody = std::size_t{1} << 20;

}  // namespace

bool ChunkReader::take_line(std::string_view& input) {
    const std::size_t end = input.find('\n');
    const std::size_t taken = end == std::string_view::npos ? input.size() : end + 1;
    if (line_.size() + taken > kLongestLine) state_ = State::malformed;
    else line_ += input.substr(0, taken);
    input.remove_prefix(taken);
    if (state_ == State::malformed || end == std::string_view::npos) return false;
    if (!line_.ends_with("\r\n")) state_ = State::malformed;
    else line_.resize(line_.size() - 2);
    return state_ == State::more;
}

ChunkReader::State ChunkReader::read(std::string_view& input, std::string& body, std::size_t largest) {
    while (state_ == State::more && !input.empty()) {
        if (part_ == Part::data) {
            const std::size_t taken = std::min(left_, input.size());
            if (body.size() + taken > kLargeBody) body.reserve(largest);  // twice as large each time would be copied
            body += input.substr(0, taken);
            input.remove_prefix(taken);
            left_ -= taken;
            if (left_ == 0) part_ = Part::end_of_data;
            continue;
        }
        if (!take_line(input)) break;
        if (part_ == Part::size) {
            const std::string_view digits = std::string_view(line_).substr(0, line_.find_first_of("; \t"));
            const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), left_, 16);
            const bool is_size = error != std::errc::invalid_argument && end == digits.data() + digits.size();
            if (!is_size) state_ = State::malformed;
            else if (error != std::errc{} || left_ > largest - body.size()) state_ = State::too_large;
            part_ = left_ == 0 ? Part::trailer : Part::data;
        } else if (part_ == Part::end_of_data) {
            if (!line_.empty()) state_ = State::malformed;
            part_ = Part::size;
        } else {
            trailer_bytes_ += line_.size();
            if (trailer_bytes_ > kLongestTrailer) state_ = State::malformed;
            else if (line_.empty()) state_ = State::whole;
        }
        line_.clear();
    }
    return state_;
}

}  // namespace brdfit::server
