/// Messages between a front end and one of its workers.
#pragma once

#include <cstdint>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>

namespace brdfit::server {

/// One end of a stream socket. Sending is safe from several threads, receiving is for one.
class Channel {
public:
    enum class Kind : std::uint8_t {
        // to the worker
        wake,      ///< something may be there to claim or to cancel
        ping,      ///< answered by pong, by the thread that keeps the leases
        stop,      ///< claim no more, end what is soon done, give back the rest and exit
        evaluate,  ///< number of the question (8 bytes), body of POST /v1/evaluate
        // from the worker
        facts,    ///< an archive of api::DeviceFacts; the first says that it takes jobs
        failed,   ///< it cannot start: why, for the log
        changed,  ///< id of a job that it wrote to
        pong,
        evaluated,  ///< number of the question, 1 and the answer, or 0 and for the log why there is none
    };
    struct Message {
        Kind kind{};
        std::string body;
    };

    /// Takes the descriptor.
    explicit Channel(int descriptor);
    ~Channel();
    Channel(const Channel&) = delete;
    Channel& operator=(const Channel&) = delete;

    /// False if the other end is gone, or takes nothing for seconds: then the channel is shut.
    bool send(Kind kind, std::string_view body = {});
    /// For what is as good left out: nothing is sent if the other end has much to read already.
    void hint(Kind kind);
    /// Waits for a message; none when the other end is gone, or after shut().
    std::optional<Message> receive();
    /// Both directions. receive() returns.
    void shut();
    /// receive() returns; sending goes on.
    void stop_receiving();

private:
    bool write(const char* bytes, std::size_t size);
    bool read(char* bytes, std::size_t size);

    int descriptor_;
    std::mutex sending_;
};

}  // namespace brdfit::server
