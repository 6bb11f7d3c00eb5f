// Messages between processes arrive whole, or not at all.
#include "server/channel.h"

#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <string>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

namespace brdfit::server {
namespace {

struct Ends {
    Ends() {
        if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, both.data()) != 0) throw std::runtime_error("no pair");
    }
    std::array<int, 2> both{};
};

TEST(Channel, MessagesArriveWholeAndInOrderWhoeverSends) {
    const Ends ends;
    Channel from(ends.both[0]), to(ends.both[1]);
    constexpr int kThreads = 4, kEach = 50;
    std::vector<std::jthread> senders;
    for (int t = 0; t < kThreads; ++t)
        senders.emplace_back([&from, t] {
            for (int i = 0; i < kEach; ++i)
                EXPECT_TRUE(from.send(Channel::Kind::changed,
                                      std::string(static_cast<std::size_t>(i) * 1000, static_cast<char>('a' + t))));
        });
    std::array<int, kThreads> next{};
    for (int i = 0; i < kThreads * kEach; ++i) {
        const auto message = to.receive();
        ASSERT_TRUE(message);
        EXPECT_EQ(message->kind, Channel::Kind::changed);
        if (message->body.empty()) continue;
        const auto sender = static_cast<std::size_t>(message->body[0] - 'a');
        EXPECT_EQ(message->body, std::string(static_cast<std::size_t>(++next.at(sender)) * 1000, message->body[0]));
    }
}

TEST(Channel, AnEndThatIsGoneIsTold) {
    const Ends ends;
    Channel from(ends.both[0]);
    {
        Channel to(ends.both[1]);
        EXPECT_TRUE(from.send(Channel::Kind::ping));
    }
    EXPECT_FALSE(from.receive());
    EXPECT_FALSE(from.send(Channel::Kind::ping));
    from.hint(Channel::Kind::ping);
}

TEST(Channel, HalfAMessageIsNone) {
    const Ends ends;
    Channel to(ends.both[1]);
    ASSERT_EQ(::write(ends.both[0], "\5\xff\0\0\0abc", 8), 8);
    ::close(ends.both[0]);
    EXPECT_FALSE(to.receive());
}

TEST(Channel, HintsDoNotWaitForWhoDoesNotRead) {
    const Ends ends;
    Channel from(ends.both[0]), to(ends.both[1]);
    const auto begun = std::chrono::steady_clock::now();
    for (int i = 0; i < 20'000; ++i) from.hint(Channel::Kind::wake);
    EXPECT_LT(std::chrono::steady_clock::now() - begun, std::chrono::seconds(4));
    EXPECT_TRUE(to.receive());
}

TEST(Channel, WhoStopsReceivingStillSends) {
    const Ends ends;
    Channel from(ends.both[0]), to(ends.both[1]);
    std::jthread reader([&] { EXPECT_FALSE(from.receive()); });
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
    from.stop_receiving();
    reader.join();
    EXPECT_TRUE(from.send(Channel::Kind::failed, "why"));
    EXPECT_EQ(to.receive()->body, "why");
}

}  // namespace
}  // namespace brdfit::server
