#include "api/json.h"

#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "api/problem.h"
#include "api/samples.h"
#include "kernels/text_place.h"

namespace brdfit::api {
namespace {

using kernels::CountedChars;
using nlohmann::json;

constexpr std::size_t kDeepest = 16;
constexpr std::size_t kMostKeys = 1000;                        ///< of an object
constexpr std::size_t kMostElements = kMostSamples;            ///< of an array
constexpr std::size_t kMostValues = 7 * kMostSamples;          ///< of all kinds: a sample has six numbers at most
constexpr std::size_t kMostContainers = 4 * kMostSamples / 5;  ///< objects and arrays: scans of five samples

/// Builds the document and knows at every moment where it is.
class Builder : public nlohmann::json_sax<json> {
public:
    explicit Builder(std::string_view text) : text_(text) {}

    bool null() override { return add(nullptr); }
    bool boolean(bool value) override { return add(value); }
    bool number_integer(number_integer_t value) override { return add(value); }
    bool number_unsigned(number_unsigned_t value) override { return add(value); }
    bool number_float(number_float_t value, const string_t&) override { return add(value); }
    bool string(string_t& value) override { return add(std::move(value)); }
    bool binary(binary_t&) override { return false; }
    bool start_object(std::size_t) override { return open(json::object()); }
    bool start_array(std::size_t) override { return open(json::array()); }
    bool end_object() override { return close(); }
    bool end_array() override { return close(); }
    bool key(string_t& name) override {
        if (open_.back()->contains(name)) {
            FieldError error{pointer() + "/" + pointer_part(name), "duplicate_key", "the key stands twice", {}, {}};
            refuse("a key stands twice in an object", std::move(error), begin_of_string());
        }
        if (open_.back()->size() == kMostKeys)
            refuse_size(
                {pointer(), "too_many", "an object has at most " + std::to_string(kMostKeys) + " keys", {}, {}});
        key_ = name;
        return true;
    }
    bool parse_error(std::size_t position, const std::string&, const json::exception& error) override {
        const std::size_t at = position == 0 ? 0 : position - 1;
        constexpr int kNumberOverflow = 406;  // nlohmann's out_of_range for a number that is no double
        if (error.id == kNumberOverflow)
            refuse("a number is not finite", {place(), "not_finite", "the number is too large for a double", {}, {}},
                   at, problem_type("invalid-request"));
        refuse("the body is not JSON", {place(), "syntax", "not JSON from here on", {}, {}}, at);
    }

    json document;
    std::size_t read = 0;  ///< bytes that the parser has taken

private:
    static constexpr ProblemType kNotJson = problem_type("invalid-json");

    [[noreturn]] void refuse(std::string detail, FieldError error, std::size_t offset,
                             const ProblemType& type = kNotJson) const {
        const kernels::TextPlace at = kernels::place_of(text_, offset);
        error.line = at.line;
        error.column = at.column;
        throw Refusal({type, std::move(detail), {std::move(error)}});
    }
    /// The opening quote of the string that has just been read: the last one that is not escaped.
    [[nodiscard]] std::size_t begin_of_string() const {
        std::size_t at = read - 1;
        for (std::size_t backslashes = 1; backslashes % 2 != 0;) {
            at = text_.rfind('"', at - 1);
            for (backslashes = 0; backslashes < at && text_[at - 1 - backslashes] == '\\';) ++backslashes;
        }
        return at;
    }
    /// Where the value that comes next will stand.
    [[nodiscard]] std::string place() const {
        if (open_.empty()) return "";
        return pointer() + "/" + (open_.back()->is_array() ? std::to_string(open_.back()->size()) : pointer_part(key_));
    }
    [[nodiscard]] std::string pointer() const {
        std::string path;
        for (const std::string& part : path_) path += "/" + part;
        return path;
    }
    [[noreturn]] void refuse_size(FieldError error) const {
        std::string detail = error.pointer + ": " + error.detail;
        refuse(std::move(detail), std::move(error), read - 1, problem_type("invalid-request"));
    }
    json* put(json value) {
        if (++values_ > kMostValues)
            refuse_size(
                {place(), "too_many", "a request has at most " + std::to_string(kMostValues) + " values", {}, {}});
        if (open_.empty()) {
            document = std::move(value);
            return &document;
        }
        json& parent = *open_.back();
        if (parent.size() == kMostElements)
            refuse_size(
                {pointer(), "too_many", "an array has at most " + std::to_string(kMostElements) + " elements", {}, {}});
        if (parent.is_array()) return &parent.emplace_back(std::move(value));
        return &(parent[key_] = std::move(value));
    }
    bool add(json value) {
        put(std::move(value));
        return true;
    }
    bool open(json value) {
        if (open_.size() == kDeepest)
            refuse("the document is nested too deeply", {place(), "too_deep", "at most 16 levels", {}, {}}, read - 1);
        if (++containers_ > kMostContainers)
            refuse_size({place(),
                         "too_many",
                         "a request has at most " + std::to_string(kMostContainers) + " objects and arrays",
                         {},
                         {}});
        if (!open_.empty())
            path_.push_back(open_.back()->is_array() ? std::to_string(open_.back()->size()) : pointer_part(key_));
        open_.push_back(put(std::move(value)));
        return true;
    }
    bool close() {
        open_.pop_back();
        if (!path_.empty()) path_.pop_back();
        return true;
    }

    std::string_view text_;
    std::size_t values_ = 0;
    std::size_t containers_ = 0;
    std::vector<json*> open_;
    std::vector<std::string> path_;
    std::string key_;
};

}  // namespace

json parse_json(std::string_view text) {
    if (const auto nul = text.find('\0'); nul != std::string_view::npos) {
        const kernels::TextPlace at = kernels::place_of(text, nul);
        throw Refusal({problem_type("invalid-json"),
                       "the body holds a NUL byte",
                       {{"", "nul_byte", "a NUL byte is not JSON", at.line, at.column}}});
    }
    Builder builder(text);
    std::size_t unused = 0;  // of the end, which does not move
    const CountedChars begin(text.data(), builder.read);
    const CountedChars end(text.data() + text.size(), unused);
    if (!json::sax_parse(begin, end, &builder))
        throw Refusal({problem_type("invalid-json"), "the body is not JSON", {}});
    return std::move(builder.document);
}

}  // namespace brdfit::api
