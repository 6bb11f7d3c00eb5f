/// Who may use the service.
#pragma once

#include <array>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace brdfit::server {

/// API keys, of which only SHA-256 sums are kept: keys are long random words, not passwords.
class ApiKeys {
public:
    /// A line a key, `name:sum` with 64 hexadecimal digits; empty lines and those that begin with # are passed over. A
    /// name may have several keys. Throws std::runtime_error where the file cannot be read, others than its owner may
    /// write to it, or a line is none, naming the line.
    explicit ApiKeys(const std::filesystem::path& file);

    /// The name of the key in an Authorization header, "Bearer KEY"; nothing if it is none of ours. Takes the same time
    /// whichever key it is, and for all wrong ones.
    [[nodiscard]] std::optional<std::string> name_of(std::string_view authorization) const;

private:
    struct Key {
        std::string name;
        std::array<unsigned char, 32> sum;
    };
    std::vector<Key> keys_;
};

}  // namespace brdfit::server
