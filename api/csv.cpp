#include "api/csv.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
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
        if (errors_.size() < kMostErrors) errors_.push_back({"", std::move(code), std::move(detail), line, field});
    }
    [[nodiscard]] bool empty() const { return errors_.empty(); }
    void throw_if_any() const {
        if (!errors_.empty())
            throw Refusal({problem_type("invalid-request"),
                           "line " + std::to_string(errors_.front().line.value_or(1)) + ": " + errors_.front().detail,
                           errors_});
    }

private:
    std::vector<FieldError> errors_;
};

std::string trimmed(std::string_view text) {
    const auto first = text.find_first_not_of(" \t");
    if (first == std::string_view::npos) return "";
    return std::string(text.substr(first, text.find_last_not_of(" \t") - first + 1));
}

/// The fields of a line, as RFC 4180 writes them: a quoted one may hold commas, and quotes that are doubled; blanks
/// count within quotes only. Empty after an error.
std::vector<std::string> fields_of(std::string_view line, std::size_t number, Errors& errors) {
    constexpr std::string_view kBlanks = " \t";
    std::vector<std::string> fields;
    for (std::size_t at = 0;; ++at) {  // at the first byte of a field
        const auto refuse = [&](const char* reason) {
            errors.add(number, fields.size() + 1, "syntax", reason);
            return std::vector<std::string>{};
        };
        const auto first = line.find_first_not_of(kBlanks, at);
        if (first == std::string_view::npos || line[first] != '"') {
            const std::string_view field = line.substr(at, line.find(',', at) - at);
            if (field.find('"') != std::string_view::npos) return refuse("a quote within a field that is not quoted");
            fields.push_back(trimmed(field));
            at += field.size();
        } else {
            std::string field;
            for (at = first + 1;; ++at) {
                const auto quote = line.find('"', at);
                if (quote == std::string_view::npos) return refuse("a quoted field that does not end");
                field += line.substr(at, quote - at);
                at = quote + 1;
                if (at == line.size() || line[at] != '"') break;
                field += '"';
            }
            at = std::min(line.find_first_not_of(kBlanks, at), line.size());
            if (at < line.size() && line[at] != ',') return refuse("text behind a quoted field");
            fields.push_back(std::move(field));
        }
        if (at == line.size()) return fields;
    }
}

/// A finite number that fills the field, independent of the locale.
std::optional<double> number_of(const std::string& field) {
    const std::string text = trimmed(field);
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
    std::string channel;
};

/// Position of each column in the file, or npos.
using Header = std::array<std::size_t, kColumns>;
constexpr std::size_t kAbsent = static_cast<std::size_t>(-1);

Header read_header(const std::vector<std::string>& names, std::size_t line, Errors& errors) {
    Header header;
    header.fill(kAbsent);
    std::string valid;
    for (const ColumnRule& rule : kRules) valid += (valid.empty() ? "" : ", ") + std::string(rule.name);
    for (std::size_t i = 0; i < names.size(); ++i) {
        const auto rule =
            std::find_if(kRules.begin(), kRules.end(), [&](const auto& r) { return r.name == trimmed(names[i]); });
        if (rule == kRules.end()) {
            errors.add(line, i + 1, "unknown_key",
                       "unknown column \"" + names[i].substr(0, 40) + "\"; valid are: " + valid);
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

Row read_row(const std::vector<std::string>& fields, const Header& header, std::size_t line, Errors& errors) {
    Row row;
    row.line = line;
    for (std::size_t c = 0; c < kColumns; ++c) {
        if (header[c] == kAbsent) continue;
        const std::string& text = fields[header[c]];
        if (c == channel) {
            if (text.size() > kLongestName)
                errors.add(line, header[c] + 1, "too_long", "at most " + std::to_string(kLongestName) + " bytes");
            if (!is_utf8(text)) errors.add(line, header[c] + 1, "not_utf8", "the channel's name is not UTF-8");
            row.channel = text;
            continue;
        }
        const auto value = number_of(text);
        if (!value) {
            errors.add(line, header[c] + 1, "not_a_number",
                       std::string(kRules[c].name) + " must be a finite number, not \"" + text.substr(0, 40) + "\"");
            continue;
        }
        if (const auto reason = (*kRules[c].bad)(*value)) errors.add(line, header[c] + 1, "out_of_range", *reason);
        row.value[c] = *value;
    }
    return row;
}

std::vector<Row> read_rows(std::string_view text, Header& header) {
    Errors errors;
    std::vector<Row> rows;
    bool has_header = false;
    std::size_t columns = 0;
    std::size_t number = 0;
    while (!text.empty()) {
        const auto end = text.find('\n');
        std::string_view line = text.substr(0, end);
        text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
        if (++number == 1 && line.starts_with("\xEF\xBB\xBF")) line.remove_prefix(3);
        if (line.ends_with('\r')) line.remove_suffix(1);
        if (line.starts_with('#') || trimmed(line).empty()) continue;
        const std::vector<std::string> fields = fields_of(line, number, errors);
        if (fields.empty()) {  // refused
            if (!has_header) errors.throw_if_any();
            continue;
        }
        if (!has_header) {
            header = read_header(fields, number, errors);
            columns = fields.size();
            has_header = true;
            errors.throw_if_any();  // rows mean nothing without it
            continue;
        }
        if (fields.size() != columns) {
            errors.add(
                number, 1, "ragged",
                "has " + std::to_string(fields.size()) + " fields where the header has " + std::to_string(columns));
            continue;
        }
        if (rows.size() == kMostSamples) {
            errors.add(number, 1, "too_many", "at most " + std::to_string(kMostSamples) + " rows");
            break;
        }
        rows.push_back(read_row(fields, header, number, errors));
    }
    if (rows.empty() && errors.empty())
        errors.add(std::max<std::size_t>(number, 1), 1, "missing", "there are no rows of data");
    errors.throw_if_any();
    return rows;
}

}  // namespace

optim::Dataset read_csv(std::string_view text) {
    Header header;
    const std::vector<Row> rows = read_rows(text, header);
    const bool has_phi = header[phi_i] != kAbsent;
    const bool has_sign =
        !has_phi || std::any_of(rows.begin(), rows.end(), [](const Row& row) { return row.value[theta_r] < 0; });

    Errors errors;
    optim::Dataset dataset;
    std::map<std::string, std::size_t> index;
    for (const Row& row : rows) {
        const bool has_wavelength = header[wavelength] != kAbsent;
        std::string name = row.channel;
        if (name.empty()) name = has_wavelength ? wavelength_name(row.value[wavelength]) : "1";
        const auto [at, is_new] = index.try_emplace(name, dataset.channels.size());
        if (is_new) {
            if (dataset.channels.size() == kMostChannels) {
                errors.add(row.line, 1, "too_many", "at most " + std::to_string(kMostChannels) + " channels");
                break;
            }
            dataset.channels.push_back({name, {}, {}});
            if (has_wavelength) dataset.channels.back().wavelength_nm = row.value[wavelength];
        }
        optim::Channel& to = dataset.channels[at->second];
        if (has_wavelength && to.wavelength_nm != row.value[wavelength])
            errors.add(row.line, header[wavelength] + 1, "contradiction",
                       "the channel " + name + " has another wavelength in an earlier row");
        optim::Sample sample;
        sample.brdf = row.value[brdf];
        if (header[sigma] != kAbsent) sample.sigma = row.value[sigma];
        sample.direction = {row.value[theta_i], row.value[theta_r], 0};
        if (has_phi) {
            const auto direction = direction_of(row.value[theta_i], row.value[theta_r], row.value[phi_i],
                                                row.value[phi_r], has_sign ? Signs::meaningful : Signs::absent);
            if (direction) sample.direction = *direction;
            else
                errors.add(row.line, header[theta_r] + 1, "contradiction",
                           "the sign of theta_r_deg (positive = specular side) contradicts phi_r_deg - phi_i_deg "
                           "(180 = specular side)");
        }
        to.samples.push_back(sample);
    }
    errors.throw_if_any();
    return dataset;
}

}  // namespace brdfit::api
