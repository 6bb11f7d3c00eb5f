#include "kernels/program_cache.h"

#include <fcntl.h>
#include <openssl/sha.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <charconv>
#include <chrono>
#include <cstdlib>
#include <string>
#include <utility>

namespace brdfit::kernels {
namespace {

namespace fs = std::filesystem;

using Digest = std::array<unsigned char, SHA256_DIGEST_LENGTH>;

/// What a file begins with; the bytes follow. Names its format: a new one gets a new number.
struct Header {
    std::array<char, 16> magic{'b', 'r', 'd', 'f', 'i', 't', ' ', 'c', 'a', 'c', 'h', 'e', ' ', '1', '\n', '\0'};
    Digest key{};
    Digest checksum{};
    std::uint64_t size = 0;

    bool operator==(const Header&) const = default;
};
static_assert(sizeof(Header) == 88, "written as it stands");

constexpr std::string_view kSuffix = ".bin";
constexpr std::string_view kUnfinished = ".tmp";
/// A writer that has not come to its end by then has died.
constexpr std::chrono::hours kAbandoned{1};

Header header_of(const CacheKey& key, std::span<const unsigned char> bytes) {
    Header header;
    header.key = key.digest;
    SHA256(bytes.data(), bytes.size(), header.checksum.data());
    header.size = bytes.size();
    return header;
}

class File {
public:
    File(const fs::path& path, int flags) : descriptor_(::open(path.c_str(), flags | O_CLOEXEC, S_IRUSR | S_IWUSR)) {}
    ~File() { (void)close(); }
    File(const File&) = delete;
    File& operator=(const File&) = delete;

    [[nodiscard]] bool is_open() const { return descriptor_ >= 0; }
    [[nodiscard]] int descriptor() const { return descriptor_; }
    /// False if there was less.
    bool read(void* to, std::size_t bytes) const {
        auto* at = static_cast<char*>(to);
        while (bytes > 0) {
            const ssize_t got = ::read(descriptor_, at, bytes);
            if (got <= 0) return false;
            at += got;
            bytes -= static_cast<std::size_t>(got);
        }
        return true;
    }
    bool write(const void* from, std::size_t bytes) const {
        const auto* at = static_cast<const char*>(from);
        while (bytes > 0) {
            const ssize_t put = ::write(descriptor_, at, bytes);
            if (put <= 0) return false;
            at += put;
            bytes -= static_cast<std::size_t>(put);
        }
        return true;
    }
    bool close() { return descriptor_ < 0 || ::close(std::exchange(descriptor_, -1)) == 0; }

private:
    int descriptor_;
};

}  // namespace

CacheKey CacheKey::of(std::initializer_list<std::string_view> parts) {
    std::string all;
    for (const std::string_view part : parts) all += std::to_string(part.size()) + ":" + std::string(part);
    CacheKey key;
    SHA256(reinterpret_cast<const unsigned char*>(all.data()), all.size(), key.digest.data());
    return key;
}

std::string CacheKey::text() const {
    constexpr std::string_view kDigits = "0123456789abcdef";
    std::string text;
    for (const unsigned char byte : digest) {
        text += kDigits[byte >> 4U];
        text += kDigits[byte & 15U];
    }
    return text;
}

std::optional<CacheKey> CacheKey::parse(std::string_view text) {
    CacheKey key;
    if (text.size() != 2 * key.digest.size()) return std::nullopt;
    for (std::size_t i = 0; i < key.digest.size(); ++i) {
        const char* begin = text.data() + 2 * i;
        const auto [end, error] = std::from_chars(begin, begin + 2, key.digest[i], 16);
        if (error != std::errc{} || end != begin + 2) return std::nullopt;
    }
    return key;
}

ProgramCache::ProgramCache(fs::path folder, std::uintmax_t limit) : folder_(std::move(folder)), limit_(limit) {}

fs::path ProgramCache::file(const CacheKey& key) const { return folder_ / (key.text() + std::string(kSuffix)); }

std::optional<std::vector<unsigned char>> ProgramCache::load(const CacheKey& key) const {
    if (folder_.empty()) return std::nullopt;
    const File file(this->file(key), O_RDONLY | O_NONBLOCK | O_NOFOLLOW);
    struct stat status {};
    if (!file.is_open() || ::fstat(file.descriptor(), &status) != 0 || !S_ISREG(status.st_mode)) return std::nullopt;
    // What is kept here is run: nobody else may have put it there.
    const bool ours =
        (status.st_uid == ::geteuid() || status.st_uid == 0) && (status.st_mode & (S_IWGRP | S_IWOTH)) == 0;
    Header header;
    if (!ours || static_cast<std::uintmax_t>(status.st_size) > sizeof header + limit_ ||
        !file.read(&header, sizeof header) || header.size != static_cast<std::uint64_t>(status.st_size) - sizeof header)
        return std::nullopt;
    std::vector<unsigned char> bytes(header.size);
    if (!file.read(bytes.data(), bytes.size()) || header != header_of(key, bytes)) return std::nullopt;
    (void)::futimens(file.descriptor(), nullptr);  // the time of its last use
    return bytes;
}

bool ProgramCache::store(const CacheKey& key, std::span<const unsigned char> bytes) const {
    static std::atomic<unsigned> count = 0;
    std::error_code error;
    if (folder_.empty() || bytes.size() > limit_) return false;
    if (fs::create_directories(folder_, error)) fs::permissions(folder_, fs::perms::owner_all, error);
    const fs::path unfinished = folder_ / (key.text() + "." + std::to_string(::getpid()) + "." +
                                           std::to_string(count++) + std::string(kUnfinished));
    File file(unfinished, O_WRONLY | O_CREAT | O_EXCL);
    if (!file.is_open()) return false;
    const Header header = header_of(key, bytes);
    const bool written = file.write(&header, sizeof header) && file.write(bytes.data(), bytes.size());
    if (!file.close() || !written || ::rename(unfinished.c_str(), this->file(key).c_str()) != 0) {
        (void)::unlink(unfinished.c_str());
        return false;
    }
    prune();
    return true;
}

void ProgramCache::prune() const {
    struct Entry {
        fs::file_time_type used;
        std::uintmax_t size = 0;
        fs::path path;
    };
    std::vector<Entry> entries;
    std::uintmax_t total = 0;
    std::error_code error;
    const auto now = fs::file_time_type::clock::now();
    for (fs::directory_iterator it(folder_, error), end; !error && it != end; it.increment(error)) {
        std::error_code gone;  // another process prunes as well
        const std::string extension = it->path().extension();
        if ((extension != kSuffix && extension != kUnfinished) || !it->is_regular_file(gone)) continue;
        const Entry entry{it->last_write_time(gone), it->file_size(gone), it->path()};
        if (gone) continue;
        if (extension == kUnfinished) {
            if (now - entry.used > kAbandoned) fs::remove(entry.path, gone);
            continue;
        }
        total += entry.size;
        entries.push_back(entry);
    }
    std::sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) { return a.used < b.used; });
    for (auto it = entries.begin(); it != entries.end() && total > limit_; ++it) {
        total -= it->size;
        fs::remove(it->path, error);
    }
}

fs::path default_cache_folder() {
    const auto absolute = [](const char* name) {
        const char* value = std::getenv(name);
        const fs::path path = value == nullptr ? "" : value;
        return path.is_absolute() ? path : fs::path();  // the standard has relative ones ignored
    };
    if (const fs::path cache = absolute("XDG_CACHE_HOME"); !cache.empty()) return cache / "brdfit";
    const fs::path home = absolute("HOME");
    return home.empty() ? home : home / ".cache" / "brdfit";
}

}  // namespace brdfit::kernels
