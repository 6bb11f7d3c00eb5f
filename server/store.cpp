#include "server/store.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <memory>
#include <new>
#include <random>
#include <span>

#include <openssl/evp.h>

#include "api/names.h"

namespace brdfit::server {
namespace {

constexpr auto& kStates = api::kFitStates;
constexpr std::array<std::string_view, 4> kEvents{"state", "progress", "model_done", "done"};

/// SHA-256.
class Digest {
public:
    Digest() : context_(EVP_MD_CTX_new()) {
        if (!context_ || EVP_DigestInit_ex(context_.get(), EVP_sha256(), nullptr) != 1) throw std::bad_alloc();
    }
    Digest& add(std::string_view bytes) {
        if (EVP_DigestUpdate(context_.get(), bytes.data(), bytes.size()) != 1) throw std::bad_alloc();
        return *this;
    }
    /// 64 hexadecimal digits, once.
    std::string text() {
        std::array<unsigned char, EVP_MAX_MD_SIZE> digest{};
        unsigned size = 0;
        if (EVP_DigestFinal_ex(context_.get(), digest.data(), &size) != 1) throw std::bad_alloc();
        std::string text;
        for (const unsigned char byte : std::span(digest).first(size)) {
            constexpr std::string_view digits = "0123456789abcdef";
            text += digits[byte >> 4];
            text += digits[byte & 15];
        }
        return text;
    }

private:
    struct Free {
        void operator()(EVP_MD_CTX* context) const { EVP_MD_CTX_free(context); }
    };
    std::unique_ptr<EVP_MD_CTX, Free> context_;
};

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

std::string sha256(std::string_view bytes) { return Digest().add(bytes).text(); }

std::string result_key(const std::vector<std::string_view>& parts) {
    Digest digest;
    for (const std::string_view part : parts) digest.add(std::to_string(part.size()) + ':').add(part);
    return digest.text();
}

}  // namespace brdfit::server
