/// Strict JSON: what is read, what is refused, and where the mistake is said to be.
#include "api/json.h"

#include <string>

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "tests/unit/refused.h"

namespace brdfit::api {
namespace {

using nlohmann::json;

struct Mistake {
    std::string text;
    int status;
    std::string error;  ///< "pointer code"
    std::string place;  ///< "line:column code", or empty: not told
};

void expect_refused(const Mistake& mistake) {
    SCOPED_TRACE(mistake.text.substr(0, 80));
    const Problem problem = refusal_of([&] { (void)parse_json(mistake.text); });
    EXPECT_EQ(problem.type.status, mistake.status);
    EXPECT_EQ(errors_of(problem), std::vector{mistake.error});
    if (!mistake.place.empty()) {
        EXPECT_EQ(places_of(problem), std::vector{mistake.place});
    }
}

TEST(Json, ReadsWhatIsJson) {
    EXPECT_EQ(parse_json(R"( {"a": [1, -2.5e3, true, null, "\u00fc\n"], "b": {}, "": []} )"),
              (json{{"a", {1, -2500.0, true, nullptr, "ü\n"}}, {"b", json::object()}, {"", json::array()}}));
    for (const char* scalar : {"0", "-0.0", "1e308", "1e-400", "\"\"", "true", "null"})
        EXPECT_EQ(parse_json(scalar), json::parse(scalar));
}

TEST(Json, TellsIntegersFromOtherNumbers) {
    EXPECT_TRUE(parse_json("9007199254740991").is_number_integer());
    EXPECT_EQ(parse_json("9007199254740991").get<std::uint64_t>(), 9007199254740991U);
    EXPECT_TRUE(parse_json("1.0").is_number_float());
    EXPECT_TRUE(parse_json("18446744073709551616").is_number_float());
}

TEST(Json, RefusesWhatIsNotJsonAndSaysWhere) {
    for (const Mistake& mistake : std::vector<Mistake>{
             {"", 400, " syntax", "1:1 syntax"},
             {"?", 400, " syntax", "1:1 syntax"},
             {"{\"a\":1}x", 400, " syntax", "1:8 syntax"},
             {"{\"a\":\n[1,\n 2,]}", 400, "/a/2 syntax", "3:4 syntax"},
             {"{\"a\": {\"b\": [0, {\"c\": nan}]}}", 400, "/a/b/1/c syntax", "1:24 syntax"},
             {"[NaN]", 400, "/0 syntax", "1:2 syntax"},
             {"[1 2]", 400, "/1 syntax", "1:4 syntax"},
             {"{\"a/b~c\": ?}", 400, "/a~1b~0c syntax", "1:11 syntax"},
             {"[\"\x01\"]", 400, "/0 syntax", "1:3 syntax"},
             {"[\"\xff\"]", 400, "/0 syntax", "1:3 syntax"},
             {"[\"\\ud800\"]", 400, "/0 syntax", ""},
             {"[\"a", 400, "/0 syntax", ""},
             {"[[], [], [1", 400, "/2/1 syntax", ""},
         })
        expect_refused(mistake);
}

TEST(Json, RefusesANumberTooLargeForADouble) {
    expect_refused({"{\"a\": [0, 1e999]}", 422, "/a/1 not_finite", ""});
    expect_refused({"-1e999", 422, " not_finite", ""});
}

TEST(Json, RefusesAKeyTwice) {
    expect_refused({R"({"a": {"b": 1, "c": 2, "b": 3}})", 400, "/a/b duplicate_key", "1:24 duplicate_key"});
    expect_refused({"{\"a\": 1,\n \"\\u0061\": 2}", 400, "/a duplicate_key", "2:2 duplicate_key"});
    expect_refused({R"({"\\": 1, "\"a\\": 1, "\"a\\": 2})", 400, R"(/"a\ duplicate_key)", "1:23 duplicate_key"});
    EXPECT_NO_THROW((void)parse_json(R"([{"a": 1}, {"a": {"a": 2}}])"));
}

TEST(Json, RefusesDeepNesting) {
    EXPECT_NO_THROW((void)parse_json(std::string(16, '[') + std::string(16, ']')));
    std::string pointer;
    for (int i = 0; i < 16; ++i) pointer += "/0";
    expect_refused({std::string(17, '['), 400, pointer + " too_deep", "1:17 too_deep"});
    expect_refused({"\n" + std::string(1'000'000, '['), 400, pointer + " too_deep", "2:17 too_deep"});
}

TEST(Json, PassesOverBlanks) {
    const std::string blanks = " \t\r\n  " + std::string(100, ' ');
    EXPECT_EQ(parse_json(blanks + "{" + blanks + "\"a  \\\"  b\"" + blanks + ":" + blanks + "[" + blanks + "1" +
                         blanks + "," + blanks + "\"  \\\\\"" + blanks + "]" + blanks + "}" + blanks),
              (json{{"a  \"  b", {1, "  \\"}}}));
    for (const Mistake& mistake : std::vector<Mistake>{
             {"", 400, " syntax", "1:1 syntax"},
             {"   ", 400, " syntax", "1:4 syntax"},
             {"{}  \n  x ", 400, " syntax", "2:3 syntax"},
             {"[1  \n  2]", 400, "/1 syntax", "2:3 syntax"},
             {"[1   \n }", 400, "/1 syntax", "2:2 syntax"},
             {"[  1x  ]", 400, "/1 syntax", "1:5 syntax"},
             {"[  1.   ]", 400, "/0 syntax", ""},
             {"{   \"a\"   :  1 ,   \"a\"   : 2}", 400, "/a duplicate_key", "1:20 duplicate_key"},
             {"{\"a\": 1,   b}", 400, " syntax", "1:12 syntax"},
         })
        expect_refused(mistake);
}

TEST(Json, RefusesStringsAndNumbersBeyondUse) {
    const std::string most(std::size_t{1} << 20U, '1');
    expect_refused({"{\"a\": [0, \"" + most + "\"]}", 422, "/a/1 too_long", "1:11 too_long"});
    expect_refused({"{\"a\": " + most + "1}", 422, "/a too_long", "1:7 too_long"});
    expect_refused({"{\"a\": {\"" + most + "\": 0}}", 422, "/a too_long", "1:8 too_long"});
    const std::string good = "\"" + most.substr(10) + "\"";
    EXPECT_NO_THROW((void)parse_json("[" + good + ", " + good + "]"));
    expect_refused({"[" + good + "," + good + "," + good + "," + good + "," + good + "]", 422, "/4 too_long", ""});
}

/// Numbers in plenty, of which the document takes more than a critic lets pass unseen.
std::string plenty(std::size_t count) {
    std::string text = "[0";
    for (std::size_t i = 1; i < count; ++i) text += ",0";
    return text + "]";
}

TEST(Json, ShowsALargeDocumentToItsCritic) {
    int looks = 0;
    const auto critic = [&](std::vector<FieldError> errors) {
        return [&looks, errors](const json&) {
            ++looks;
            return errors;
        };
    };
    const std::string text = "{\"a\": " + plenty(900'000) + ", \"b\": {\"c\": 1}, \"a\": 1}";  // and a mistake
    const auto refused = [&](const std::vector<FieldError>& errors) {
        return errors_of(refusal_of([&] { (void)parse_json(text, critic(errors)); }));
    };
    (void)parse_json("[1, 2]", critic({{"/0", "unknown_key", "", {}, {}}}));
    EXPECT_EQ(looks, 0);  // a small one is read to its end
    const std::vector<std::string> mistake{"/a duplicate_key"};
    EXPECT_EQ(refused({}), mistake);
    EXPECT_EQ(looks, 2);  // at 4 and at 8 MiB
    // What is wrong for good, and what may come yet.
    EXPECT_EQ(refused({{"/a", "unknown_key", "", {}, {}}}), std::vector<std::string>{"/a unknown_key"});
    EXPECT_EQ(refused({{"/a", "wrong_type", "", {}, {}}}), std::vector<std::string>{"/a wrong_type"});
    EXPECT_EQ(refused({{"/b", "missing", "", {}, {}}, {"/a/3", "out_of_range", "", {}, {}}}), mistake);
    EXPECT_EQ(refused({{"/b", "missing", "", {}, {}}, {"/a/3/c", "missing", "", {}, {}}}),
              std::vector<std::string>{"/a/3/c missing"});
}

TEST(Json, RefusesANulByte) { expect_refused({std::string("{}\n\0{}", 6), 400, " nul_byte", "2:1 nul_byte"}); }

}  // namespace
}  // namespace brdfit::api
