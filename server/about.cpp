#include "server/about.h"

#include <algorithm>

#include "api/evaluate.h"
#include "api/examples.h"
#include "api/response.h"
#include "server/headers.h"

namespace brdfit::server {
namespace {

using api::problem_type;
using api::Refusal;

/// For pages of ours: styles that stand in them, and nothing else.
constexpr const char* kPagePolicy =
    "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

Response page(std::string body) {
    Response response;
    response.body = std::move(body);
    response.content_type = "text/html; charset=utf-8";
    response.headers["Content-Security-Policy"] = kPagePolicy;
    response.headers["Referrer-Policy"] = "no-referrer";
    return response;
}

Response json(std::string body) {
    Response response;
    response.body = std::move(body);
    return response;
}

/// A document that changes with the version only.
Response document(Response response) {
    response.headers["ETag"] = entity_tag(response.body);
    response.headers["Cache-Control"] = "no-cache";
    return response;
}

Response problem_kind(const Call& call) {
    refuse_query(call.request);
    for (const api::ProblemType& type : api::kProblemTypes)
        if (type.name == call.path[0]) return json(api::to_json(type));
    throw Refusal({problem_type("not-found"), "there is no such kind of problem; /docs lists them", {}});
}

/// Where a client says that it reached us, as far as that is a host's name.
std::string url_of(const Request& request) {
    const std::string_view host = request.header("Host");
    const auto is_ok = [](unsigned char c) {
        return std::isalnum(c) != 0 || std::string_view(".-:[]").find(static_cast<char>(c)) != std::string_view::npos;
    };
    if (host.empty() || host.size() > 255 || !std::all_of(host.begin(), host.end(), is_ok))
        return "http://127.0.0.1:8080";
    return "http://" + std::string(host);
}

}  // namespace

std::vector<Route> About::routes() {
    using namespace api;
    using In = Parameter::In;
    namespace s = api::schema;
    const auto call = [this](Response (About::*member)(const Call&)) {
        return [this, member](const Call& c) { return (this->*member)(c); };
    };
    // A resource without parameters.
    const auto plain = [](Operation op, const std::function<Response()>& answer) {
        return Route{std::move(op), [answer](const Call& c) {
                         refuse_query(c.request);
                         return answer();
                     }};
    };
    std::vector<Route> routes;
    {
        Operation op{"POST", "/v1/evaluate", "evaluate", "Models",
                     "Values of a model, and its slopes, at given parameters and directions"};
        op.bodies = {{kJson, s::named("EvaluateRequest"), examples::evaluate_request()}};
        op.answers = {{200, "17 significant digits, 9 in single precision", {{kJson, s::named("Values")}}}};
        op.problems = {"invalid-json",    "too-large",   "unsupported-media-type",
                       "invalid-request", "unavailable", "unfit-device"};
        routes.push_back({std::move(op), call(&About::evaluate)});
    }
    {
        Operation op{"GET", "/v1/models", "listModels", "Models", "All models: parameters, bounds, formula, source"};
        op.answers = {{200, "the models", {{kJson, s::named("Models")}}}};
        routes.push_back(plain(std::move(op), [this] { return json(api::to_json(catalogue_)); }));
    }
    {
        Operation op{"GET", "/v1/models/{name}", "getModel", "Models", "One model"};
        op.parameters = {{In::path, "name", "of the model", s::named("ModelName"), "ward"}};
        op.answers = {{200, "the model", {{kJson, s::named("Model")}}}};
        op.problems = {"unknown-model"};
        routes.push_back({std::move(op), call(&About::model)});
    }
    {
        Operation op{"GET", "/v1", "getService", "Service", "Version, device, what its self-tests found, limits"};
        op.answers = {{200, "the service", {{kJson, s::named("Service")}}}};
        op.problems = {"unavailable"};
        routes.push_back(plain(std::move(op), [this] {
            return json(service_json(compute_.device(), compute_.self_tests(), largest_body_));
        }));
    }
    {
        Operation op{"GET", "/health/live", "getLive", "Service", "Whether the process answers"};
        op.answers = {{200, "it does", {{kJson, s::named("Live")}}}};
        routes.push_back(plain(std::move(op), [] { return json("{\"status\":\"live\"}\n"); }));
    }
    {
        Operation op{"GET", "/health/ready", "getReady", "Service", "Whether fits are possible"};
        op.answers = {
            {200, "they are", {{kJson, s::named("Ready")}}},
            {503, "they are not", {{kJson, s::named("Ready")}, {"application/problem+json", s::named("Problem")}}}};
        routes.push_back({std::move(op), call(&About::ready)});
    }
    {
        Operation op{"GET", "/", "getIndex", "Service", "Where to go: a page, or a map of links, by Accept"};
        op.answers = {{200, "links", {{kJson, s::named("Links")}, {kHtml, s::text()}}}};
        op.problems = {"not-acceptable"};
        routes.push_back({std::move(op), call(&About::index)});
    }
    {
        Operation op{"GET", "/openapi.json", "getOpenApi", "Service", "This document"};
        op.answers = {{200, "OpenAPI 3.1", {{kJson, s::map_of(s::anything())}}}};
        routes.push_back(plain(std::move(op), [this] { return document(json(openapi_)); }));
    }
    {
        Operation op{"GET", "/docs", "getDocs", "Service", "This document, as a page"};
        op.answers = {{200, "a page", {{kHtml, s::text()}}}};
        routes.push_back(plain(std::move(op), [this] { return document(page(docs_)); }));
    }
    {
        Operation op{"GET", "/problems/{type}", "getProblemType", "Service", "What a problem's type means"};
        op.parameters = {{In::path, "type", "the last part of a problem's type", s::text(), "invalid-request"}};
        op.answers = {{200, "its meaning", {{kJson, s::named("ProblemType")}}}};
        op.problems = {"not-found"};
        routes.push_back({std::move(op), problem_kind});
    }
    return routes;
}

std::vector<api::Operation> About::elsewhere() {
    api::Operation metrics{"GET", "/metrics", "getMetrics", "Service", "Counters and histograms for Prometheus"};
    metrics.answers = {{200, "Prometheus' text", {{"text/plain", api::schema::text()}}}};
    return {metrics};
}

void About::publish(std::span<const api::Operation* const> operations) {
    openapi_ = api::openapi_json(operations, catalogue_);
    docs_ = api::docs_html(operations, catalogue_);
}

Response About::index(const Call& call) {
    refuse_query(call.request);
    Response response = accepted(call.request, {kJson, kHtml}) == kHtml ? page(api::index_html(url_of(call.request)))
                                                                        : json(api::links_json());
    response.headers["Vary"] = "Accept";
    return response;
}

Response About::model(const Call& call) {
    refuse_query(call.request);
    const kernels::Family* family = catalogue_.find(call.path[0]);
    if (family == nullptr)
        throw Refusal({problem_type("unknown-model"), "there is no such model; valid are: " + catalogue_.names(), {}});
    return json(api::to_json(*family, compute_.costs(*family)));
}

Response About::evaluate(const Call& call) {
    refuse_query(call.request);
    (void)body_type(call.request, {kJson});
    const api::EvaluateRequest request = api::read_evaluate_request(call.request.body, catalogue_);
    if (!compute_.usable())
        throw Refusal({problem_type("unfit-device"), "the device failed its self-test; /health/ready tells where", {}});
    if (request.precision)
        if (const auto reason = compute_.refusal(*request.precision))
            throw invalid("/precision", "unsupported", *reason);
    return json(compute_.evaluate(call.request.body));
}

Response About::ready(const Call& call) {
    refuse_query(call.request);
    if (stop_.stop_requested()) throw Refusal({problem_type("stopping"), "the service is stopping", {}});
    store_.probe();
    const std::vector<kernels::SelfTest> tests = compute_.self_tests();
    const bool is_ready = compute_.usable();
    Response response = json(api::ready_json(tests, is_ready));
    response.status = is_ready ? 200 : 503;
    return response;
}

}  // namespace brdfit::server
