#include "server/log.h"

#include <chrono>
#include <memory>
#include <string>
#include <string_view>

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <spdlog/formatter.h>
#include <spdlog/sinks/stdout_sinks.h>
#include <spdlog/spdlog.h>

namespace brdfit::server {
namespace {

/// Marks the message of a request's line, which is JSON already.
constexpr const char* kRequests = "request";

std::string escaped(std::string_view text) {
    std::string safe;
    for (const char c : text)
        if (c >= ' ' && c < 0x7f) safe += c;
        else safe += fmt::format("\\x{:02x}", static_cast<unsigned char>(c));
    return safe;
}

std::string time_of(const spdlog::log_clock::time_point& time) {
    const auto ms = std::chrono::duration_cast<std::chrono::milliseconds>(time.time_since_epoch()).count() % 1000;
    return fmt::format("{:%Y-%m-%dT%H:%M:%S}.{:03}Z", fmt::gmtime(time), ms);
}

class Formatter final : public spdlog::formatter {
public:
    explicit Formatter(LogFormat format) : format_(format) {}
    void format(const spdlog::details::log_msg& message, spdlog::memory_buf_t& to) override {
        const std::string_view text(message.payload.data(), message.payload.size());
        const auto name = spdlog::level::to_string_view(message.level);
        const std::string level(name.data(), name.size());
        std::string line;
        if (std::string_view(message.logger_name.data(), message.logger_name.size()) == kRequests) line = text;
        else if (format_ == LogFormat::json) line = api::to_json(time_of(message.time), level, std::string(text));
        else line = fmt::format("{} {} {}", time_of(message.time), level, escaped(text));
        line += '\n';
        to.append(line.data(), line.data() + line.size());
    }
    [[nodiscard]] std::unique_ptr<spdlog::formatter> clone() const override {
        return std::make_unique<Formatter>(format_);
    }

private:
    LogFormat format_;
};

struct Loggers {
    LogFormat format = LogFormat::text;
    std::shared_ptr<spdlog::logger> requests;
};

Loggers& loggers() {
    static Loggers all;
    return all;
}

}  // namespace

void set_log_format(LogFormat format) {
    const auto sink = std::make_shared<spdlog::sinks::stderr_sink_mt>();
    sink->set_formatter(std::make_unique<Formatter>(format));
    spdlog::set_default_logger(std::make_shared<spdlog::logger>("brdfit", sink));
    loggers() = {format, std::make_shared<spdlog::logger>(kRequests, sink)};
}

void log_request(const api::RequestLine& line) {
    const Loggers& to = loggers();
    if (to.requests == nullptr) return;  // no log was asked for
    const std::string time = time_of(spdlog::log_clock::now());
    if (to.format == LogFormat::json) return to.requests->info(api::to_json(time, line));
    to.requests->info(escaped(fmt::format("{} info {} {} {} request {} {} bytes {:.1f} ms {}{}{}", time, line.method,
                                          line.path, line.status, line.id, line.bytes, line.ms, line.remote,
                                          line.tenant.empty() ? "" : " tenant ", line.tenant)));
}

}  // namespace brdfit::server
