/// Builds kept on disk from one run to the next: files of bytes by key.
#pragma once

#include <array>
#include <cstdint>
#include <filesystem>
#include <initializer_list>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace brdfit::kernels {

/// SHA-256 of what decides an entry.
struct CacheKey {
    std::array<unsigned char, 32> digest{};

    /// The key of these parts, in their order; where one ends and the next begins counts.
    static CacheKey of(std::initializer_list<std::string_view> parts);
    /// 64 hexadecimal digits.
    [[nodiscard]] std::string text() const;
    /// What text() wrote; nothing for any other text.
    static std::optional<CacheKey> parse(std::string_view text);
    bool operator==(const CacheKey&) const = default;
};

/// A folder of entries, one file each, for any number of processes and threads at once. Nothing throws: a folder that
/// cannot be used keeps nothing, and an entry that is not exactly what was stored is as good as none.
class ProgramCache {
public:
    /// The files may take so many bytes; those read or written the longest ago go first.
    static constexpr std::uintmax_t kLimit = std::uintmax_t{256} << 20;

    /// The folder is made when something is stored. An empty path keeps nothing.
    explicit ProgramCache(std::filesystem::path folder, std::uintmax_t limit = kLimit);

    /// The entry's bytes. A file that is truncated, corrupt, of another key, or that other users could have written is
    /// passed over, and replaced by the next store().
    [[nodiscard]] std::optional<std::vector<unsigned char>> load(const CacheKey& key) const;
    /// False if it could not be stored.
    bool store(const CacheKey& key, std::span<const unsigned char> bytes) const;
    [[nodiscard]] const std::filesystem::path& folder() const { return folder_; }
    [[nodiscard]] std::filesystem::path file(const CacheKey& key) const;

private:
    void prune() const;

    std::filesystem::path folder_;
    std::uintmax_t limit_;
};

/// $XDG_CACHE_HOME/brdfit, or ~/.cache/brdfit; empty where neither is set.
std::filesystem::path default_cache_folder();

}  // namespace brdfit::kernels
