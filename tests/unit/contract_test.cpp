// What the contract promises apart from sockets: datasets keep their text, headers are read as RFCs say, results as
// CSV.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "api/answers.h"
#include "api/dataset.h"
#include "api/json.h"
#include "api/query.h"
#include "api/request.h"
#include "api/stored.h"
#include "server/headers.h"
#include "tests/unit/refused.h"

namespace brdfit {
namespace {

using api::errors_of;
using api::refusal_of;
using nlohmann::json;
using testing::HasSubstr;
using testing::Not;

const kernels::Catalogue& catalogue() {
    static const kernels::Catalogue all;
    return all;
}

// ---- datasets ----

TEST(CanonicalText, IsTheSameForTheSameMeasurements) {
    const std::string of_csv = api::canonical_text(api::read_dataset_csv(
        "brdf_per_sr,theta_r_deg,theta_i_deg\n0.1,-30,15\n0.2,30,15\n0.3,30,45\n", {{"name", "x"}}));
    const std::string of_json = api::canonical_text(api::read_dataset(R"({"channels": [{"name": "1", "scans": [
        {"theta_i_deg": 15, "theta_r_deg": [-30], "brdf": [0.1]}, {"theta_i_deg": 15, "theta_r_deg": [30], "brdf": [0.2]},
        {"theta_i_deg": 45, "theta_r_deg": [30], "brdf": [0.3]}]}], "unit": "1/sr", "name": "x"})"));
    EXPECT_EQ(of_csv, of_json);
}

TEST(CanonicalText, ReadsAsTheSameMeasurements) {
    const optim::Dataset dataset = api::read_dataset(R"({"name": "ä", "unit": "relative", "channels": [
        {"wavelength_nm": 550.5, "scans": [{"theta_i_deg": 15, "theta_r_deg": [-30, 0, -0.0], "brdf": [0.1, -1, 1e-300]}]},
        {"name": "b", "samples": {"theta_i_deg": [0, 10], "theta_r_deg": [0, 30], "phi_r_deg": [180, 180],
                                  "brdf": [1, 2], "sigma": [3, 4]}}]})");
    EXPECT_EQ(api::read_dataset(api::canonical_text(dataset)), dataset);
}

TEST(CanonicalText, ChangesNoMoreOnceItIsWritten) {
    for (int i = 0; i < 2000; ++i) {
        optim::Dataset dataset;
        optim::Channel channel{"c", {}, {}};
        const double phi = std::ldexp(std::fmod(i * 0.618033988749895, 1.0), -(i % 60)) * 360 - 180;
        const auto direction = api::direction_of(30, i % 90, 0, phi, api::Signs::absent);
        ASSERT_TRUE(direction);
        channel.samples.push_back({*direction, 1, {}});
        dataset.channels.push_back(channel);
        const std::string text = api::canonical_text(dataset);
        const optim::Dataset read = api::read_dataset(text);
        ASSERT_EQ(api::canonical_text(read), text) << phi;
        EXPECT_NEAR(read.channels[0].samples[0].direction.phi_deg, direction->phi_deg, 1e-13);
        EXPECT_EQ(read.channels[0].samples[0].direction.theta_r_deg, direction->theta_r_deg);
    }
}

TEST(Dataset, HasSamplesInEachChannel) {
    EXPECT_EQ(errors_of(refusal_of([] { (void)api::read_dataset(R"({"channels": [{"scans": []}]})"); })),
              std::vector<std::string>{"/channels/0 empty"});
}

// ---- jobs ----

const std::string kDataset = R"({"channels": [{"scans": [{"theta_i_deg": 1, "theta_r_deg": [2, 3, 4],
    "brdf": [3, 3, 3]}]}]})";

TEST(PostedFit, IsReadAgainFromItsText) {
    const std::string body = R"({"models": ["ward"], "options": {"seed": 3}, "dataset": )" + kDataset + "}";
    const api::PostedFit posted = api::read_posted_fit(body, catalogue(), {});
    EXPECT_EQ(api::read_job(posted.text, "", catalogue()), api::read_fit_request(body, catalogue()));
    EXPECT_FALSE(posted.dataset);
    const api::PostedFit csv = api::read_posted_fit_csv("theta_i_deg,theta_r_deg,brdf_per_sr\n1,2,3\n1,3,3\n1,4,3\n",
                                                        {{"models", "ward"}, {"seed", "3"}}, catalogue());
    EXPECT_EQ(api::read_job(csv.text, "", catalogue()), api::read_fit_request(body, catalogue()));
}

TEST(PostedFit, SaysWhichPrecisionItAsksFor) {
    const std::string body = R"({"options": {"precision": "single"}, "dataset": )" + kDataset + "}";
    EXPECT_EQ(api::read_posted_fit(body, catalogue(), {}).precision, kernels::Precision::single_precision);
    const std::string csv = "theta_i_deg,theta_r_deg,brdf_per_sr\n1,2,3\n1,3,3\n1,4,3\n";
    EXPECT_EQ(api::read_posted_fit_csv(csv, {{"precision", "double"}}, catalogue()).precision,
              kernels::Precision::double_precision);
    EXPECT_FALSE(api::read_posted_fit_csv(csv, {}, catalogue()).precision);
}

TEST(PostedFit, HasOneTextHoweverItIsSpelt) {
    const auto text = [](const std::string& body) { return api::read_posted_fit(body, catalogue(), {}).text; };
    EXPECT_EQ(text(R"({"models": ["ward"], "dataset": )" + kDataset + "}"),
              text(R"({"dataset":)" + kDataset + R"(,"models":["\u0077ard"]})"));
}

TEST(PostedFit, NamesAStoredDataset) {
    const auto stored = [](const std::string& id) -> std::optional<std::string> {
        if (id != "known") return std::nullopt;
        return kDataset;
    };
    const api::PostedFit posted =
        api::read_posted_fit(R"({"dataset": "known", "models": ["ward"]})", catalogue(), stored);
    EXPECT_EQ(posted.dataset, "known");
    EXPECT_EQ(api::read_job(posted.text, kDataset, catalogue()),
              api::read_fit_request(R"({"dataset": "known", "models": ["ward"]})", catalogue(), stored));
    EXPECT_EQ(api::read_job(posted.text, kDataset, catalogue()).dataset, api::read_dataset(kDataset));
    EXPECT_EQ(errors_of(refusal_of([&] { (void)api::read_posted_fit(R"({"dataset": "x"})", catalogue(), stored); })),
              std::vector<std::string>{"/dataset unknown_dataset"});
}

TEST(ResultCsv, HasARowForEachParameter) {
    EXPECT_EQ(
        api::result_csv(R"({"channels": [{"name": "=a,\"b\"", "wavelength_nm": 550, "fits": [
        {"rank": 1, "model": "ward", "loss": 0.5, "parameters": {
            "rho_d": {"value": 0.25, "std_error": null, "unit": "1", "at_bound": true},
            "alpha": {"value": 1e-3, "std_error": 0.5, "unit": "1", "at_bound": false}}}]}, {"name": "x", "fits": []}]})"),
        "channel,wavelength_nm,rank,model,lobes,loss,relative_loss,rmse,log10_rmse,parameter,value,std_error,unit,"
        "at_bound\r\n"
        "\"'=a,\"\"b\"\"\",550,1,ward,,0.5,,,,rho_d,0.25,,1,true\r\n"
        "\"'=a,\"\"b\"\"\",550,1,ward,,0.5,,,,alpha,0.001,0.5,1,false\r\n");
    EXPECT_THAT(api::result_csv("no JSON"), HasSubstr("at_bound\r\n"));
}

TEST(FailedFit, TellsNoMoreThanAProblem) {
    const api::FailedFit failed =
        api::failed_fit(R"({"type":"/problems/poison-job","title":"t","status":500,"detail":"d"})", "/v1/fits", "r");
    EXPECT_EQ(failed.status, 500);
    EXPECT_EQ(json::parse(failed.body), json::parse(R"({"type":"/problems/poison-job","title":"t","status":500,
        "detail":"d","instance":"/v1/fits","request_id":"r"})"));
    EXPECT_EQ(json::parse(api::failed_fit("/home/x: segfault", "/v1/fits", "r").body)["type"], "/problems/internal");
}

// ---- the reader of JSON ----

TEST(ParseJson, TakesNoMoreThanARequestHas) {
    const auto refused = [](const std::string& text) {
        return errors_of(refusal_of([&] { (void)api::parse_json(text); }));
    };
    std::string keys = "{";
    for (int i = 0; i <= 1000; ++i) keys += "\"k" + std::to_string(i) + "\":0,";
    EXPECT_EQ(refused(R"({"a": )" + keys + "\"k\":0}}"), std::vector<std::string>{"/a too_many"});
    std::string elements = "[0";
    for (int i = 0; i < 1'000'000; ++i) elements += ",0";
    EXPECT_EQ(refused("[" + elements + "]]"), std::vector<std::string>{"/0 too_many"});
    std::string containers;
    for (int i = 0; i < 800'000; ++i) containers += "[],";
    EXPECT_EQ(refused("[" + containers + "0]").size(), 1U);
}

TEST(PointerPart, OfALongKeyIsItsBeginning) {
    EXPECT_EQ(api::pointer_part("a/b~"), "a~1b~0");
    const std::string part = api::pointer_part(std::string(199, 'x') + "ää");
    EXPECT_EQ(part, std::string(199, 'x') + "…");
}

// ---- queries ----

TEST(QueryValue, IsOfTheTypeThatItsSchemaAsksFor) {
    using api::query_value;
    EXPECT_EQ(query_value("12", api::schema::number()), 12.0);
    EXPECT_EQ(query_value("12x", api::schema::number()), "12x");
    EXPECT_EQ(query_value("12", api::schema::text()), "12");
    EXPECT_EQ(query_value("1,x", api::schema::array(api::schema::number())), json::array({1.0, "x"}));
    EXPECT_EQ(query_value("true", api::schema::boolean()), true);
    EXPECT_EQ(query_value("yes", api::schema::boolean()), "yes");
}

// ---- headers ----

server::Request with(const std::string& name, const std::string& value) {
    server::Request request;
    request.headers[name] = value;
    return request;
}

TEST(Accept, IsHeededByQualityThenByOurOrder) {
    const auto chosen = [](const std::string& accept) {
        return std::string(server::accepted(with("Accept", accept), {server::kJson, server::kHtml}));
    };
    EXPECT_EQ(server::accepted(server::Request{}, {server::kJson, server::kHtml}), server::kJson);
    EXPECT_EQ(chosen("*/*"), "application/json");
    EXPECT_EQ(chosen("text/*"), "text/html");
    EXPECT_EQ(chosen("text/html, */*;q=0.8"), "text/html");
    EXPECT_EQ(chosen("text/html;q=0.5, application/json;q=0.6"), "application/json");
    EXPECT_EQ(chosen("text/html;q=0, */*"), "application/json");
    EXPECT_EQ(chosen("application/json;q=0, */*;q=0.1"), "text/html");
    EXPECT_EQ(chosen("APPLICATION/JSON"), "application/json");
    for (const char* none : {"image/png", "*/*;q=0", "text/htm"})
        EXPECT_EQ(refusal_of([&] { (void)chosen(none); }).type.status, 406) << none;
}

TEST(Prefer, IsReadAsRfc7240Says) {
    const auto read = [](const std::string& prefer) { return server::preferences(with("prefer", prefer)); };
    using std::chrono::seconds;
    EXPECT_FALSE(server::preferences({}).wait);
    EXPECT_EQ(read("wait=5").wait, seconds(5));
    EXPECT_EQ(read("WAIT=\"5\"; foo=bar").wait, seconds(5));
    EXPECT_EQ(read("handling=lenient, respond-async, wait=0").wait, seconds(0));
    EXPECT_TRUE(read("handling=lenient, Respond-Async, wait=0").respond_async);
    EXPECT_EQ(read("wait=1, wait=2").wait, seconds(1));
    EXPECT_EQ(read("wait=99999999999999999999").wait, server::kLongestWait);
}

TEST(Prefer, RefusesAWaitThatIsNone) {
    for (const char* bad : {"wait=x", "wait=", "wait", "wait=-1", "wait=1e9", "wait=1.5", "wait=\"1"})
        EXPECT_EQ(refusal_of([&] { (void)server::preferences(with("Prefer", bad)); }).type.name, "invalid-header")
            << bad;
}

TEST(Conditions, CompareTagsAndTimes) {
    const std::string tag = server::entity_tag("x");
    EXPECT_NE(tag, server::entity_tag("y"));
    EXPECT_TRUE(server::is_known(with("If-None-Match", "\"a, b\", W/" + tag), tag));
    EXPECT_TRUE(server::is_known(with("If-None-Match", "*"), tag));
    EXPECT_FALSE(server::is_known(with("If-None-Match", "\"a\""), tag));
    EXPECT_FALSE(server::is_known({}, tag));
    const auto refused = [&](const std::string& name, const std::string& value, server::StoreTime modified) {
        try {
            server::require_match(with(name, value), tag, modified);
        } catch (const api::Refusal& refusal) {
            return refusal.problem().type.status == 412;
        }
        return false;
    };
    const server::StoreTime time{std::chrono::milliseconds(1'000'000'000'123)};
    EXPECT_FALSE(refused("If-Match", tag, time));
    EXPECT_TRUE(refused("If-Match", "W/" + tag, time));
    EXPECT_EQ(server::rfc3339(time), "2001-09-09T01:46:40.123Z");
    EXPECT_EQ(server::http_date(time), "Sun, 09 Sep 2001 01:46:40 GMT");
    EXPECT_FALSE(refused("If-Unmodified-Since", "Sun, 09 Sep 2001 01:46:40 GMT", time));
    EXPECT_TRUE(refused("If-Unmodified-Since", "Sun, 09 Sep 2001 01:46:39 GMT", time));
    EXPECT_FALSE(refused("If-Unmodified-Since", "yesterday", time));
}

TEST(Schemas, ReferToWhatThereIs) {
    const api::schema::Json schemas = api::component_schemas(catalogue());
    const std::function<void(const api::schema::Json&)> look = [&](const api::schema::Json& node) {
        if (node.is_object() && node.contains("$ref")) {
            const std::string name =
                node["$ref"].get<std::string>().substr(std::string("#/components/schemas/").size());
            EXPECT_TRUE(schemas.contains(name)) << name;
        }
        if (node.is_structured())
            for (const auto& member : node) look(member);
    };
    look(schemas);
    EXPECT_EQ(schemas["ModelName"]["enum"].size(), catalogue().families().size());
    EXPECT_EQ(schemas["FitRequest"]["properties"]["options"]["properties"]["loss"]["default"], "cosine_l2");
}

}  // namespace
}  // namespace brdfit
