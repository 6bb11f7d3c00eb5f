#include "server/headers.h"

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <ctime>
#include <locale>
#include <vector>

#include <boost/algorithm/string/predicate.hpp>

#include "api/problem.h"

namespace brdfit::server {
namespace {

using api::problem_type;
using api::Refusal;

std::string_view trimmed(std::string_view text) {
    const auto first = text.find_first_not_of(" \t");
    if (first == std::string_view::npos) return {};
    return text.substr(first, text.find_last_not_of(" \t") - first + 1);
}

/// Parts of a list, without the blanks about them. Separators within quotes do not count.
std::vector<std::string_view> parts_of(std::string_view text, char separator) {
    std::vector<std::string_view> parts;
    bool quoted = false;
    std::size_t begin = 0;
    for (std::size_t i = 0; i <= text.size(); ++i) {
        if (i < text.size() && text[i] == '"') quoted = !quoted;
        if (i < text.size() && (quoted || text[i] != separator)) continue;
        if (const std::string_view part = trimmed(text.substr(begin, i - begin)); !part.empty()) parts.push_back(part);
        begin = i + 1;
    }
    return parts;
}

bool same(std::string_view a, std::string_view b) { return boost::algorithm::iequals(a, b, std::locale::classic()); }

/// "name=value" or "name", the value without its quotes.
struct Directive {
    std::string_view name;
    std::string_view value;
};
Directive directive(std::string_view text) {
    const auto equals = text.find('=');
    if (equals == std::string_view::npos) return {trimmed(text), {}};
    std::string_view value = trimmed(text.substr(equals + 1));
    if (value.size() >= 2 && value.front() == '"' && value.back() == '"') value = value.substr(1, value.size() - 2);
    return {trimmed(text.substr(0, equals)), value};
}

double quality(const std::vector<std::string_view>& parameters) {
    for (std::size_t i = 1; i < parameters.size(); ++i) {
        const Directive q = directive(parameters[i]);
        double value = 0;
        if (same(q.name, "q") &&
            std::from_chars(q.value.data(), q.value.data() + q.value.size(), value).ec == std::errc{})
            return value;
    }
    return 1;
}

bool any_tag(std::string_view header, std::string_view tag, bool weak) {
    for (std::string_view part : parts_of(header, ',')) {
        if (part == "*") return true;
        if (weak && part.starts_with("W/")) part.remove_prefix(2);
        if (part == tag) return true;
    }
    return false;
}

std::tm calendar(StoreTime time) {
    const std::time_t seconds = std::chrono::floor<std::chrono::seconds>(time).time_since_epoch().count();
    std::tm parts{};
    gmtime_r(&seconds, &parts);
    return parts;
}

std::string formatted(const char* format, const std::tm& parts) {
    std::string text(64, '\0');
    text.resize(std::strftime(text.data(), text.size(), format, &parts));
    return text;
}

}  // namespace

std::string media_type(std::string_view content_type) {
    std::string type(trimmed(content_type.substr(0, content_type.find(';'))));
    std::transform(type.begin(), type.end(), type.begin(), [](unsigned char c) { return std::tolower(c); });
    return type;
}

Preferences preferences(const Request& request) {
    Preferences found;
    for (const std::string_view part : parts_of(request.header("Prefer"), ',')) {
        const Directive preference = directive(part.substr(0, part.find(';')));
        if (same(preference.name, "respond-async")) found.respond_async = true;
        if (!same(preference.name, "wait") || found.wait) continue;  // the first one counts
        unsigned seconds = 0;
        const char* const last = preference.value.data() + preference.value.size();
        const auto [end, error] = std::from_chars(preference.value.data(), last, seconds);
        if (error == std::errc::invalid_argument || end != last || preference.value.empty())
            throw Refusal({problem_type("invalid-header"), "Prefer: wait must be a whole number of seconds", {}});
        found.wait = error == std::errc{} ? std::min(std::chrono::seconds(seconds), kLongestWait) : kLongestWait;
    }
    return found;
}

std::string_view accepted(const Request& request, std::initializer_list<std::string_view> offered) {
    const auto ranges = parts_of(request.header("Accept"), ',');
    if (ranges.empty()) return *offered.begin();
    std::string_view best;
    double best_quality = 0;
    for (const std::string_view type : offered) {
        int specific = -1;
        double q = 0;
        for (const std::string_view range : ranges) {
            const auto parameters = parts_of(range, ';');
            if (parameters.empty()) continue;
            const std::string_view name = parameters.front();
            const int match =
                same(name, type)                                                                                    ? 2
                : name.ends_with("/*") && same(name.substr(0, name.size() - 1), type.substr(0, type.find('/') + 1)) ? 1
                : name == "*/*"                                                                                     ? 0
                                : -1;
            if (match <= specific) continue;
            specific = match;
            q = quality(parameters);
        }
        if (q <= best_quality) continue;
        best = type;
        best_quality = q;
    }
    if (best.empty()) {
        std::string names;
        for (const std::string_view type : offered) names += (names.empty() ? "" : ", ") + std::string(type);
        throw Refusal({problem_type("not-acceptable"), "there is: " + names, {}});
    }
    return best;
}

bool lists(std::string_view header, std::string_view element) {
    const auto parts = parts_of(header, ',');
    return std::any_of(parts.begin(), parts.end(), [&](std::string_view part) { return same(part, element); });
}

std::string entity_tag(std::string_view bytes) { return '"' + sha256(bytes).substr(0, 32) + '"'; }

void require_match(const Request& request, std::string_view tag, std::optional<StoreTime> modified) {
    const auto refuse = [](const char* header) {
        throw Refusal({problem_type("precondition-failed"), std::string(header) + " does not hold", {}});
    };
    if (const std::string_view match = request.header("If-Match"); !match.empty()) {
        if (!any_tag(match, tag, false)) refuse("If-Match");
        return;  // it comes before the other one
    }
    const std::string since(request.header("If-Unmodified-Since"));
    if (since.empty() || !modified) return;
    std::tm parts{};
    const char* const end = ::strptime(since.c_str(), "%a, %d %b %Y %H:%M:%S GMT", &parts);
    if (end == nullptr || *end != '\0') return;  // as HTTP wants it: no date, no condition
    if (std::chrono::floor<std::chrono::seconds>(*modified) > std::chrono::system_clock::from_time_t(::timegm(&parts)))
        refuse("If-Unmodified-Since");
}

bool is_known(const Request& request, std::string_view tag) {
    return any_tag(request.header("If-None-Match"), tag, true);
}

std::string rfc3339(StoreTime time) {
    const auto ms = (time - std::chrono::floor<std::chrono::seconds>(time)).count();
    const std::string fraction = std::to_string(1000 + ms).substr(1);
    return formatted("%Y-%m-%dT%H:%M:%S", calendar(time)) + "." + fraction + "Z";
}

std::string http_date(StoreTime time) { return formatted("%a, %d %b %Y %H:%M:%S GMT", calendar(time)); }

}  // namespace brdfit::server
