#include "api/csv.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <deque>
#include <map>
#include <vector>

#include "api/problem.h"
#include "api/samples.h"

namespace brdfit::api {
namespace {

/// The columns of the format.
enum Column { theta_i, theta_r, brdf, phi_i, phi_r, sigma, wavelength, channel, kColumns };
struct ColumnRule {
    std::string_view name;
    bool required;
    const Rule* bad;  ///< none for a name
};
constexpr std::array<ColumnRule, kColumns> kRules{{
    {"theta_i_deg", true, &bad_theta_i},
    {"theta_r_deg", true, &bad_theta_r},
    {"brdf_per_sr", true, &bad_brdf},
    {"phi_i_deg", false, &bad_phi},
    {"phi_r_deg", false, &bad_phi},
    {"sigma", false, &bad_sigma},
    {"wavelength_nm", false, &bad_wavelength},
    {"channel", false, nullptr},
}};

/// Errors with their line and field, thrown all together.
class Errors {
public:
    void add(std::size_t line, std::size_t field, std::string code, std::string detail) {
        if (!is_full()) errors_.push_back({"", std::move(code), std::move(detail), line, field});
    }
    [[nodiscard]] bool empty() const { return errors_.empty(); }
    /// Whether no further error would be kept: what is left need not be read.
    [[nodiscard]] bool is_full() const { return errors_.size() >= kMostErrors; }
    void throw_if_any() const {
        if (!errors_.empty())
            throw Refusal({problem_type("invalid-request"),
                           "line " + std::to_string(errors_.front().line.value_or(1)) + ": " + errors_.front().detail,
                           errors_});
    }

private:
    std::vector<FieldError> errors_;
};

constexpr std::string_view kBlanks = " \t";
constexpr std::size_t kMostFields = 1000;                    ///< of a line
constexpr std::size_t kLongestField = std::size_t{1} << 20;  ///< [bytes]; no name is near it

std::string_view trimmed(std::string_view text) {
    const auto first = text.find_first_not_of(kBlanks);
    if (first == std::string_view::npos) return "";
    return text.substr(first, text.find_last_not_of(kBlanks) - first + 1);
}

/// The fields of a line, as RFC 4180 writes them: a quoted one may hold commas, and quotes that are doubled; blanks
/// count within quotes only. They are views of the line.
class Fields {
public:
    /// False after an error.
    bool read(std::string_view line, std::size_t number, Errors& errors) {
        fields_.clear();
        unquoted_.clear();
        const auto refuse = [&](const char* code, std::string reason) {
            errors.add(number, fields_.size() + 1, code, std::move(reason));
            return false;
        };
        for (std::size_t at = 0;; ++at) {  // at the first byte of a field
            if (fields_.size() == kMostFields)
                return refuse("too_many", "a line has at most " + std::to_string(kMostFields) + " fields");
            const auto first = line.find_first_not_of(kBlanks, at);
            if (first == std::string_view::npos || line[first] != '"') {
                const std::string_view field = line.substr(at, line.find(',', at) - at);
                if (field.find('"') != std::string_view::npos)
                    return refuse("syntax", "a quote within a field that is not quoted");
                fields_.push_back(trimmed(field));
                at += field.size();
            } else {
                std::string& field = unquoted_.emplace_back();
                for (at = first + 1;; ++at) {
                    const auto quote = line.find('"', at);
                    if (quote == std::string_view::npos) return refuse("syntax", "a quoted field that does not end");
                    if (field.size() + (quote - at) > kLongestField)
                        return refuse("too_long", "at most " + std::to_string(kLongestField) + " bytes");
                    field += line.substr(at, quote - at);
                    at = quote + 1;
                    if (at == line.size() || line[at] != '"') break;
                    field += '"';
                }
                at = std::min(line.find_first_not_of(kBlanks, at), line.size());
                if (at < line.size() && line[at] != ',') return refuse("syntax", "text behind a quoted field");
                fields_.push_back(field);
            }
            if (at == line.size()) return true;
        }
    }
    [[nodiscard]] std::size_t size() const { return fields_.size(); }
    std::string_view operator[](std::size_t i) const { return fields_[i]; }

private:
    std::vector<std::string_view> fields_;
    std::deque<std::string> unquoted_;
};

/// A finite number that fills the field, independent of the locale.
std::optional<double> number_of(std::string_view field) {
    const std::string_view text = trimmed(field);
    if (text.starts_with("+-")) return std::nullopt;
    const char* begin = text.data() + (text.starts_with('+') ? 1 : 0);
    double value = 0;
    const auto [end, error] = std::from_chars(begin, text.data() + text.size(), value);
    if (error != std::errc{} || end != text.data() + text.size() || !std::isfinite(value)) return std::nullopt;
    return value;
}

struct Row {
    std::size_t line = 0;
    std::array<double, kColumns> value{};
    std::string_view channel{};
    bool good = true;
};

/// Position of each column in the file, or npos.
using Header = std::array<std::size_t, kColumns>;
constexpr std::size_t kAbsent = static_cast<std::size_t>(-1);

Header read_header(const Fields& names, std::size_t line, Errors& errors) {
    Header header;
    header.fill(kAbsent);
    std::string valid;
    for (const ColumnRule& rule : kRules) valid += (valid.empty() ? "" : ", ") + std::string(rule.name);
    for (std::size_t i = 0; i < names.size(); ++i) {
        const auto rule =
            std::find_if(kRules.begin(), kRules.end(), [&](const auto& r) { return r.name == trimmed(names[i]); });
        if (rule == kRules.end()) {
            errors.add(line, i + 1, "unknown_key",
                       "unknown column \"" + std::string(names[i].substr(0, 40)) + "\"; valid are: " + valid);
            continue;
        }
        std::size_t& place = header[static_cast<std::size_t>(rule - kRules.begin())];
        if (place != kAbsent) errors.add(line, i + 1, "duplicate_key", "the column stands twice");
        place = i;
    }
    for (std::size_t c = 0; c < kColumns; ++c)
        if (kRules[c].required && header[c] == kAbsent)
            errors.add(line, 1, "missing", "the column " + std::string(kRules[c].name) + " is missing");
    if ((header[phi_i] == kAbsent) != (header[phi_r] == kAbsent))
        errors.add(line, 1, "missing", "phi_i_deg and phi_r_deg come together");
    return header;
}

Row read_row(const Fields& fields, const Header& header, std::size_t line, Errors& errors) {
    Row row;
    row.line = line;
    const auto refuse = [&](std::size_t column, const char* code, std::string detail) {
        errors.add(line, header[column] + 1, code, std::move(detail));
        row.good = false;
    };
    for (std::size_t c = 0; c < kColumns; ++c) {
        if (header[c] == kAbsent) continue;
        const std::string_view text = fields[header[c]];
        if (c == channel) {
            if (text.size() > kLongestName) refuse(c, "too_long", "at most " + std::to_string(kLongestName) + " bytes");
            else if (!is_utf8(std::string(text))) refuse(c, "not_utf8", "the channel's name is not UTF-8");
            row.channel = text;
            continue;
        }
        const auto value = number_of(text);
        if (!value) {
            refuse(c, "not_a_number",
                   std::string(kRules[c].name) + " must be a finite number, not \"" + std::string(text.substr(0, 40)) +
                       "\"");
            continue;
        }
        if (const auto reason = (*kRules[c].bad)(*value)) refuse(c, "out_of_range", *reason);
        row.value[c] = *value;
    }
    return row;
}

/// Reads the file from the beginning: work(row) for each of its rows, the header before it. Ends where no further error
/// would be kept, or where work returns false.
template <class Work>
void for_each_row(std::string_view text, Header& header, Errors& errors, const Work& work) {
    std::size_t columns = 0;  // none before the header
    std::size_t number = 0;
    std::size_t rows = 0;
    Fields fields;
    while (!text.empty() && !errors.is_full()) {
        const auto end = text.find('\n');
        std::string_view line = text.substr(0, end);
        text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
        if (++number == 1 && line.starts_with("\xEF\xBB\xBF")) line.remove_prefix(3);
        if (line.ends_with('\r')) line.remove_suffix(1);
        if (line.starts_with('#') || trimmed(line).empty()) continue;
        const bool good = fields.read(line, number, errors);
        if (columns == 0) {
            if (good) header = read_header(fields, number, errors);
            columns = fields.size();
            errors.throw_if_any();  // rows mean nothing without it
        } else if (good && fields.size() != columns) {
            errors.add(
                number, 1, "ragged",
                "has " + std::to_string(fields.size()) + " fields where the header has " + std::to_string(columns));
        } else if (good) {
            ++rows;
            if (!work(read_row(fields, header, number, errors))) return;
        }
    }
    if (rows == 0 && errors.empty())
        errors.add(std::max<std::size_t>(number, 1), 1, "missing", "there are no rows of data");
}

/// What a channel will hold.
struct Tally {
    std::size_t index = 0;  ///< among the channels
    std::size_t samples = 0;
    double wavelength_nm = 0;
};

}  // namespace

optim::Dataset read_csv(std::string_view text) {
    Header header{};
    Errors errors;
    std::map<std::string, Tally, std::less<>> channels;
    const auto name_of = [&](const Row& row) -> std::string {
        if (!row.channel.empty()) return std::string(row.channel);
        return header[wavelength] == kAbsent ? "1" : wavelength_name(row.value[wavelength]);
    };

    // Once to refuse, and once to keep: what is refused takes no memory.
    std::size_t rows = 0;
    bool any_negative = false;
    for_each_row(text, header, errors, [&](const Row& row) {
        if (++rows > kMostSamples)
            return errors.add(row.line, 1, "too_many", "at most " + std::to_string(kMostSamples) + " rows"), false;
        any_negative = any_negative || row.value[theta_r] < 0;
        if (!row.good) return true;
        const auto [at, is_new] = channels.try_emplace(name_of(row), Tally{channels.size(), 0, row.value[wavelength]});
        if (channels.size() > kMostChannels)
            return errors.add(row.line, 1, "too_many", "at most " + std::to_string(kMostChannels) + " channels"), false;
        ++at->second.samples;
        if (at->second.wavelength_nm != row.value[wavelength])
            errors.add(row.line, header[wavelength] + 1, "contradiction",
                       "the channel " + at->first + " has another wavelength in an earlier row");
        return true;
    });
    errors.throw_if_any();

    optim::Dataset dataset;
    dataset.channels.resize(channels.size());
    for (const auto& [name, tally] : channels) {
        optim::Channel& channel = dataset.channels[tally.index];
        channel.name = name;
        if (header[wavelength] != kAbsent) channel.wavelength_nm = tally.wavelength_nm;
        channel.samples.reserve(tally.samples);
    }
    const bool has_phi = header[phi_i] != kAbsent;
    const Signs signs = !has_phi || any_negative ? Signs::meaningful : Signs::absent;
    for_each_row(text, header, errors, [&](const Row& row) {
        optim::Sample sample;
        sample.brdf = row.value[brdf];
        if (header[sigma] != kAbsent) sample.sigma = row.value[sigma];
        sample.direction = {row.value[theta_i], row.value[theta_r], 0};
        if (has_phi) {
            const auto direction =
                direction_of(row.value[theta_i], row.value[theta_r], row.value[phi_i], row.value[phi_r], signs);
            if (direction) sample.direction = *direction;
            else
                errors.add(row.line, header[theta_r] + 1, "contradiction",
                           "the sign of theta_r_deg (positive = specular side) contradicts phi_r_deg - phi_i_deg "
                           "(180 = specular side)");
        }
        dataset.channels[channels.find(name_of(row))->second.index].samples.push_back(sample);
        return true;
    });
    errors.throw_if_any();
    return dataset;
}

}  // namespace brdfit::api
