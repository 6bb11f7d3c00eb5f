#include "server/store.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <random>

#include <openssl/sha.h>

#include "api/names.h"

namespace brdfit::server {
namespace {

constexpr auto& kStates = api::kFitStates;
constexpr std::array<std::string_view, 4> kEvents{"state", "progress", "model_done", "done"};

}  // namespace

std::string_view name_of(JobState state) { return kStates.at(static_cast<std::size_t>(state)); }

std::optional<JobState> job_state(std::string_view name) {
    const auto found = std::find(kStates.begin(), kStates.end(), name);
    if (found == kStates.end()) return std::nullopt;
    return static_cast<JobState>(found - kStates.begin());
}

std::string_view name_of(EventKind kind) { return kEvents.at(static_cast<std::size_t>(kind)); }

std::string_view poison_job_error() {
    return R"({"type":"/problems/poison-job","title":"Internal Server Error","status":500,)"
           R"("detail":"the job ended its worker three times, or held it past its lease: it is not tried again"})";
}

std::string make_job_id() {
    thread_local std::random_device random;  // the system's, not a sequence that can be guessed
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    const auto ms = static_cast<unsigned long long>(std::chrono::duration_cast<std::chrono::milliseconds>(now).count());
    std::array<char, 37> text{};
    std::snprintf(text.data(), text.size(), "%08llx-%04llx-7%03x-%04x-%04x%08x", (ms >> 16) & 0xffffffffULL,
                  ms & 0xffffULL, random() & 0xfffU, 0x8000U | (random() & 0x3fffU), random() & 0xffffU,
                  static_cast<unsigned>(random()));
    return text.data();
}

std::string sha256(std::string_view bytes) {
    std::array<unsigned char, SHA256_DIGEST_LENGTH> digest{};
    SHA256(reinterpret_cast<const unsigned char*>(bytes.data()), bytes.size(), digest.data());
    std::string text(2 * digest.size(), '0');
    for (std::size_t i = 0; i < digest.size(); ++i) {
        constexpr std::string_view digits = "0123456789abcdef";
        text[2 * i] = digits[digest[i] >> 4];
        text[2 * i + 1] = digits[digest[i] & 15];
    }
    return text;
}

std::string result_key(const std::vector<std::string_view>& parts) {
    std::string all;
    for (const std::string_view part : parts) {
        all += std::to_string(part.size()) + ':';
        all += part;
    }
    return sha256(all);
}

}  // namespace brdfit::server
