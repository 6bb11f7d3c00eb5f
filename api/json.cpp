#include "api/json.h"

#include <algorithm>
#include <iterator>
#include <optional>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "api/samples.h"
#include "kernels/text_place.h"

namespace brdfit::api {
namespace {

using nlohmann::json;

constexpr std::size_t kDeepest = 16;
constexpr std::size_t kMostKeys = 1000;                        ///< of an object
constexpr std::size_t kMostElements = kMostSamples;            ///< of an array
constexpr std::size_t kMostValues = 7 * kMostSamples;          ///< of all kinds: a sample has six numbers at most
constexpr std::size_t kMostContainers = 4 * kMostSamples / 5;  ///< objects and arrays: scans of five samples

constexpr std::size_t kLongestToken = std::size_t{1} << 20;  ///< [bytes] of a string or a number
constexpr std::size_t kMostText = std::size_t{4} << 20;      ///< [bytes] of all strings together
/// What a document may take before its critic sees it; then twice as much, and so on. [bytes]
constexpr std::size_t kFirstLook = std::size_t{4} << 20;

// About what parts of a document take. [bytes]
constexpr std::size_t kOfArray = 32;
constexpr std::size_t kOfObject = 64;
constexpr std::size_t kOfString = 48;
constexpr std::size_t kOfMember = 96;

bool is_blank(char c) { return c == ' ' || c == '\t' || c == '\n' || c == '\r'; }

/// How far a text has been read: offsets of the last two characters that the parser got, and how many it got.
struct Reading {
    std::size_t before = 0;
    std::size_t last = 0;
    std::size_t count = 0;
};

/// The text as the parser gets it. The parser keeps blanks and tokens in buffers of its own: so of blanks in a row it
/// gets the last alone, and tokens of no use end the reading.
class Characters {
public:
    using iterator_category = std::input_iterator_tag;
    using value_type = char;
    using difference_type = std::ptrdiff_t;
    using pointer = const char*;
    using reference = const char&;

    /// too_long is called with the offset where a token has become too long, and throws.
    Characters(std::string_view text, std::size_t at, Reading& reading,
               const std::function<void(std::size_t)>& too_long)
        : text_(text), at_(at), reading_(&reading), too_long_(&too_long) {
        pass_blanks();
    }
    reference operator*() const {
        *reading_ = {reading_->last, at_, reading_->count + 1};
        return text_[at_];
    }
    Characters& operator++() {
        const char passed = text_[at_++];
        if (in_string_ && !escaped_ && passed == '\\') escaped_ = true;
        else if (in_string_ && escaped_) escaped_ = false;
        else if (passed == '"') in_string_ = !in_string_;
        const bool is_between =
            !in_string_ && (is_blank(passed) || std::string_view(",:[]{}").find(passed) != std::string_view::npos);
        length_ = is_between ? 0 : length_ + 1;
        if (length_ > kLongestToken) (*too_long_)(at_ - length_);
        if (!in_string_) pass_blanks();
        return *this;
    }
    Characters operator++(int) {
        const Characters before = *this;
        ++*this;
        return before;
    }
    bool operator==(const Characters& other) const { return at_ == other.at_; }

private:
    void pass_blanks() {
        while (at_ + 1 < text_.size() && is_blank(text_[at_]) && is_blank(text_[at_ + 1])) ++at_;
    }

    std::string_view text_;
    std::size_t at_;
    Reading* reading_;
    const std::function<void(std::size_t)>* too_long_;
    std::size_t length_ = 0;  ///< of the token so far
    bool in_string_ = false;
    bool escaped_ = false;
};

/// Builds the document and knows at every moment where it is.
class Builder : public nlohmann::json_sax<json> {
public:
    Builder(std::string_view text, const Critic& critic) : text_(text), critic_(critic) {}

    bool null() override { return add(nullptr); }
    bool boolean(bool value) override { return add(value); }
    bool number_integer(number_integer_t value) override { return add(value); }
    bool number_unsigned(number_unsigned_t value) override { return add(value); }
    bool number_float(number_float_t value, const string_t&) override { return add(value); }
    bool string(string_t& value) override {
        text_held_ += value.size();
        if (text_held_ > kMostText) refuse_size({place(), "too_long", "strings have at most 4 MiB together", {}, {}});
        held_ += kOfString + value.size();
        return add(std::move(value));
    }
    bool binary(binary_t&) override { return false; }
    bool start_object(std::size_t) override { return open(json::object(), kOfObject); }
    bool start_array(std::size_t) override { return open(json::array(), kOfArray); }
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
        held_ += kOfMember + name.size();
        key_ = name;
        return true;
    }
    bool parse_error(std::size_t position, const std::string&, const json::exception& error) override {
        // It counts characters that it got, and may have put the last one back.
        const std::size_t at = position > reading.count    ? text_.size()
                               : position == reading.count ? reading.last
                                                           : reading.before;
        constexpr int kNumberOverflow = 406;  // nlohmann's out_of_range for a number that is no double
        if (error.id == kNumberOverflow)
            refuse("a number is not finite", {place(), "not_finite", "the number is too large for a double", {}, {}},
                   at, problem_type("invalid-request"));
        refuse("the body is not JSON", {place(), "syntax", "not JSON from here on", {}, {}}, at);
    }

    /// A string or a number is longer than any that means something.
    [[noreturn]] void refuse_token(std::size_t offset) const {
        refuse_field({place(), "too_long", "a string or a number has at most 1 MiB", {}, {}}, offset);
    }

    json document;
    Reading reading;

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
        std::size_t at = reading.last;
        for (std::size_t backslashes = 1; backslashes % 2 != 0;) {
            at = text_.rfind('"', at - 1);
            for (backslashes = 0; backslashes < at && text_[at - 1 - backslashes] == '\\';) ++backslashes;
        }
        return at;
    }
    /// Where the value that comes next will stand.
    [[nodiscard]] std::string place() const {
        if (open_.empty()) return "";
        if (open_.back()->is_array()) return pointer() + "/" + std::to_string(open_.back()->size());
        return key_ ? pointer() + "/" + pointer_part(*key_) : pointer();
    }
    [[nodiscard]] std::string pointer() const {
        std::string path;
        for (const std::string& part : path_) path += "/" + part;
        return path;
    }
    [[noreturn]] void refuse_field(FieldError error, std::size_t offset) const {
        const kernels::TextPlace at = kernels::place_of(text_, offset);
        error.line = at.line;
        error.column = at.column;
        throw invalid_fields({std::move(error)});
    }
    [[noreturn]] void refuse_size(FieldError error) const { refuse_field(std::move(error), reading.last); }
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
        held_ += sizeof(json);
        if (parent.is_array()) return &parent.emplace_back(std::move(value));
        json& member = parent[*key_] = std::move(value);
        key_.reset();
        return &member;
    }
    bool add(json value) {
        put(std::move(value));
        look();
        return true;
    }
    bool open(json value, std::size_t bytes) {
        if (open_.size() == kDeepest)
            refuse("the document is nested too deeply", {place(), "too_deep", "at most 16 levels", {}, {}},
                   reading.last);
        if (++containers_ > kMostContainers)
            refuse_size({place(),
                         "too_many",
                         "a request has at most " + std::to_string(kMostContainers) + " objects and arrays",
                         {},
                         {}});
        if (!open_.empty())
            path_.push_back(open_.back()->is_array() ? std::to_string(open_.back()->size()) : pointer_part(*key_));
        held_ += bytes;
        open_.push_back(put(std::move(value)));
        return true;
    }
    bool close() {
        open_.pop_back();
        if (!path_.empty()) path_.pop_back();
        look();
        return true;
    }
    /// Shows a document that has become large to its critic. Each container that is open has an element by now.
    void look() {
        if (!critic_ || held_ < next_look_) return;
        next_look_ = 2 * held_;
        std::vector<FieldError> errors = critic_(document);
        errors.erase(std::remove_if(errors.begin(), errors.end(), [&](const FieldError& e) { return may_mend(e); }),
                     errors.end());
        if (!errors.empty()) throw invalid_fields(std::move(errors));
    }
    /// Whether what follows may mend it: it is about a container that is open, or what may be missing in one.
    [[nodiscard]] bool may_mend(const FieldError& error) const {
        for (const std::string_view code : {"unknown_key", "wrong_type", "too_long", "too_many"})
            if (error.code == code) return false;
        const std::string parent = error.pointer.substr(0, error.pointer.rfind('/'));
        std::string open;
        for (std::size_t i = 0;; open += "/" + path_[i++]) {
            if (!open_.empty() && (error.pointer == open || parent == open)) return true;
            if (i == path_.size()) return false;
        }
    }

    std::string_view text_;
    const Critic& critic_;
    std::size_t held_ = 0;       ///< bytes of the document, about
    std::size_t text_held_ = 0;  ///< ... of its strings
    std::size_t next_look_ = kFirstLook;
    std::size_t values_ = 0;
    std::size_t containers_ = 0;
    std::vector<json*> open_;
    std::vector<std::string> path_;
    std::optional<std::string> key_;  ///< of the value that comes next, in an object
};

}  // namespace

json parse_json(std::string_view text, const Critic& critic) {
    if (const auto nul = text.find('\0'); nul != std::string_view::npos) {
        const kernels::TextPlace at = kernels::place_of(text, nul);
        throw Refusal({problem_type("invalid-json"),
                       "the body holds a NUL byte",
                       {{"", "nul_byte", "a NUL byte is not JSON", at.line, at.column}}});
    }
    Builder builder(text, critic);
    const std::function<void(std::size_t)> too_long = [&](std::size_t offset) { builder.refuse_token(offset); };
    Reading unused;  // of the end, which does not move
    const Characters begin(text, 0, builder.reading, too_long);
    const Characters end(text, text.size(), unused, too_long);
    if (!json::sax_parse(begin, end, &builder))
        throw Refusal({problem_type("invalid-json"), "the body is not JSON", {}});
    return std::move(builder.document);
}

std::string text_of(const nlohmann::ordered_json& value) {
    return value.dump(-1, ' ', false, json::error_handler_t::replace);
}

std::string line_of(const nlohmann::ordered_json& value) { return text_of(value) + '\n'; }

}  // namespace brdfit::api
