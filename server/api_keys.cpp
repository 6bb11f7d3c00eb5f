#include "server/api_keys.h"

#include <sys/stat.h>

#include <algorithm>
#include <fstream>
#include <stdexcept>

#include <openssl/crypto.h>
#include <openssl/sha.h>
#include <spdlog/spdlog.h>
#include <boost/algorithm/hex.hpp>
#include <boost/algorithm/string/predicate.hpp>

namespace brdfit::server {
namespace {

constexpr std::string_view kScheme = "Bearer ";
constexpr std::size_t kLongestKey = 512;

bool is_name(std::string_view name) {
    const auto ok = [](unsigned char c) { return std::isalnum(c) != 0 || c == '.' || c == '_' || c == '-'; };
    return !name.empty() && name.size() <= 64 && std::all_of(name.begin(), name.end(), ok);
}

}  // namespace

ApiKeys::ApiKeys(const std::filesystem::path& file) {
    struct stat status {};
    std::ifstream in(file);
    if (!in || ::stat(file.c_str(), &status) != 0 || !S_ISREG(status.st_mode))
        throw std::runtime_error("--api-keys: " + file.string() + " cannot be read");
    if ((status.st_mode & (S_IWGRP | S_IWOTH)) != 0)
        throw std::runtime_error("--api-keys: others than its owner may write to " + file.string());
    if ((status.st_mode & S_IROTH) != 0) spdlog::warn("--api-keys: everyone may read {}", file.string());
    std::string line;
    for (std::size_t number = 1; std::getline(in, line); ++number) {
        if (line.empty() || line.starts_with('#')) continue;
        const std::size_t colon = line.find(':');
        Key key{line.substr(0, colon), {}};
        const std::string digits = colon == std::string::npos ? "" : line.substr(colon + 1);
        if (!is_name(key.name) || digits.size() != 2 * key.sum.size() ||
            !std::all_of(digits.begin(), digits.end(), [](unsigned char c) { return std::isxdigit(c) != 0; }))
            throw std::runtime_error("--api-keys: " + file.string() + ":" + std::to_string(number) +
                                     " is not a name of up to 64 letters, digits, '.', '_' and '-', a colon and 64 "
                                     "hexadecimal digits");
        boost::algorithm::unhex(digits, key.sum.begin());
        keys_.push_back(std::move(key));
    }
    if (keys_.empty()) throw std::runtime_error("--api-keys: " + file.string() + " holds no key");
}

std::optional<std::string> ApiKeys::name_of(std::string_view authorization) const {
    if (!boost::algorithm::istarts_with(authorization, kScheme)) return std::nullopt;
    authorization.remove_prefix(kScheme.size());
    if (authorization.size() > kLongestKey) return std::nullopt;
    std::array<unsigned char, 32> sum{};
    ::SHA256(reinterpret_cast<const unsigned char*>(authorization.data()), authorization.size(), sum.data());
    const Key* found = nullptr;
    for (const Key& key : keys_)
        if (::CRYPTO_memcmp(key.sum.data(), sum.data(), sum.size()) == 0) found = &key;
    return found == nullptr ? std::nullopt : std::optional(found->name);
}

}  // namespace brdfit::server
