#include "server/channel.h"

#include <poll.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstring>

namespace brdfit::server {
namespace {

constexpr timeval kPatience{5, 0};
constexpr std::uint32_t kLargest = std::uint32_t{1} << 30;  ///< [bytes]; more is no message of ours

}  // namespace

Channel::Channel(int descriptor) : descriptor_(descriptor) {
    ::setsockopt(descriptor_, SOL_SOCKET, SO_SNDTIMEO, &kPatience, sizeof kPatience);
}

Channel::~Channel() { ::close(descriptor_); }

void Channel::shut() { ::shutdown(descriptor_, SHUT_RDWR); }
void Channel::stop_receiving() { ::shutdown(descriptor_, SHUT_RD); }

bool Channel::send(Kind kind, std::string_view body) {
    if (body.size() > kLargest) return false;
    std::array<char, 5> head{static_cast<char>(kind)};
    const auto size = static_cast<std::uint32_t>(body.size());
    std::memcpy(head.data() + 1, &size, sizeof size);  // both ends are of one machine
    const std::lock_guard lock(sending_);
    if (write(head.data(), head.size()) && write(body.data(), body.size())) return true;
    shut();  // half a message may have gone
    return false;
}

void Channel::hint(Kind kind) {
    pollfd descriptor{descriptor_, POLLOUT, 0};
    if (::poll(&descriptor, 1, 0) == 1 && (descriptor.revents & POLLOUT) != 0) send(kind);
}

std::optional<Channel::Message> Channel::receive() {
    std::array<char, 5> head{};
    if (!read(head.data(), head.size())) return std::nullopt;
    std::uint32_t size = 0;
    std::memcpy(&size, head.data() + 1, sizeof size);
    if (size > kLargest) return std::nullopt;
    Message message{static_cast<Kind>(head[0]), std::string(size, '\0')};
    if (!read(message.body.data(), size)) return std::nullopt;
    return message;
}

bool Channel::write(const char* bytes, std::size_t size) {
    while (size > 0) {
        const ssize_t sent = ::send(descriptor_, bytes, size, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR) continue;
        if (sent <= 0) return false;
        bytes += sent;
        size -= static_cast<std::size_t>(sent);
    }
    return true;
}

bool Channel::read(char* bytes, std::size_t size) {
    while (size > 0) {
        const ssize_t got = ::recv(descriptor_, bytes, size, 0);
        if (got < 0 && errno == EINTR) continue;
        if (got <= 0) return false;
        bytes += got;
        size -= static_cast<std::size_t>(got);
    }
    return true;
}

}  // namespace brdfit::server
