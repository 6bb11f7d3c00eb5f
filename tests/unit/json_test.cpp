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

TEST(Json, RefusesANulByte) { expect_refused({std::string("{}\n\0{}", 6), 400, " nul_byte", "2:1 nul_byte"}); }

}  // namespace
}  // namespace brdfit::api
