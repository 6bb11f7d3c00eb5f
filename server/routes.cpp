#include "server/routes.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <locale>
#include <vector>

#include <spdlog/spdlog.h>
#include <boost/algorithm/string/predicate.hpp>
#include <boost/algorithm/string/split.hpp>

#include "api/evaluate.h"
#include "api/plot.h"
#include "api/problem.h"
#include "api/response.h"

namespace brdfit::server {
namespace {

using api::Problem;
using api::Refusal;

constexpr std::string_view kJson = "application/json";
constexpr std::string_view kCsv = "text/csv";

std::string media_type(const std::string& content_type) {
    std::string type = content_type.substr(0, content_type.find(';'));
    while (!type.empty() && type.back() == ' ') type.pop_back();
    std::transform(type.begin(), type.end(), type.begin(), [](unsigned char c) { return std::tolower(c); });
    return type;
}

std::vector<std::string> split(const std::string& text, char separator) {
    std::vector<std::string> parts;
    boost::algorithm::split(parts, text, [=](char c) { return c == separator; });
    return parts;
}

Refusal invalid_query(const std::string& key, const std::string& code, const std::string& detail) {
    return Refusal({422, "invalid-request", "/" + key + ": " + detail, {{"/" + key, code, detail, {}, {}}}});
}

double query_number(const std::string& key, const std::string& text) {
    double number = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
    if (error != std::errc{} || end != text.data() + text.size())
        throw invalid_query(key, "wrong_type", "must be a number");
    return number;
}

api::PlotOptions plot_options(const api::Query& query) {
    api::PlotOptions options;
    for (const auto& [key, value] : query) {
        if (key == "models") options.models = split(value, ',');
        else if (key == "theta_i")
            for (const std::string& angle : split(value, ',')) options.theta_i_deg.push_back(query_number(key, angle));
        else if (key == "width") options.width = query_number(key, value);
        else if (key == "channel") options.channel = value;
        else
            throw invalid_query(key, "unknown_key",
                                "unknown query parameter; valid are: models, theta_i, width, channel");
    }
    return options;
}

}  // namespace

bool HeaderOrder::operator()(std::string_view a, std::string_view b) const {
    return boost::algorithm::ilexicographical_compare(a, b, std::locale::classic());
}

std::string_view Request::header(std::string_view name) const {
    const auto found = headers.find(name);
    return found == headers.end() ? std::string_view() : found->second;
}

std::string accepted_types(const std::string& path) {
    if (path == "/v1/fits") return std::string(kJson) + ", " + std::string(kCsv);
    return path == "/v1/evaluate" ? std::string(kJson) : "";
}

Response problem_response(const Problem& problem, const Request& request) {
    Response response{problem.status, "application/problem+json", api::to_json(problem, request.path, request.id), {}};
    if (problem.status == 415) response.headers["Accept-Post"] = accepted_types(request.path);
    return response;
}

Response Routes::handle(const Request& request) const {
    std::string route;
    Response response = answer(request, route);
    response.route = std::move(route);
    return response;
}

Response Routes::answer(const Request& request, std::string& route) const {
    try {
        return dispatch(request, route);
    } catch (const Refusal& refusal) {
        Response response = problem_response(refusal.problem(), request);
        if (refusal.problem().status == 405)
            response.headers["Allow"] = accepted_types(request.path).empty() ? "GET, HEAD" : "POST";
        return response;
    } catch (const std::exception& error) {
        spdlog::error("{} {} request {}: {}", request.method, request.path, request.id, error.what());
        return problem_response({500, "internal", "an error of the service; it has been logged", {}}, request);
    }
}

Response Routes::dispatch(const Request& request, std::string& route) const {
    const std::vector<std::string> parts =
        split(request.path.substr(std::min<std::size_t>(1, request.path.size())), '/');
    const bool reading = request.method == "GET" || request.method == "HEAD";
    const auto only = [&](bool allowed) {
        if (!allowed) throw Refusal({405, "method-not-allowed", request.method + " is not for this resource", {}});
    };
    const auto is = [&](std::initializer_list<std::string_view> path) {
        const bool matched =
            std::equal(parts.begin(), parts.end(), path.begin(), path.end(),
                       [](const std::string& part, std::string_view name) { return name == "*" || part == name; });
        if (matched)
            for (const std::string_view part : path) route.append("/").append(part);
        return matched;
    };
    if (is({"v1", "fits"})) {
        only(request.method == "POST");
        return post_fit(request);
    }
    if (is({"v1", "evaluate"})) {
        only(request.method == "POST");
        return post_evaluate(request);
    }
    Response response;
    if (is({"health", "live"})) response = {200, "application/json", "{\"status\":\"live\"}\n", {}};
    else if (is({"health", "ready"})) response = get_ready();
    else if (is({"v1"}) || is({""}))
        response.body = api::service_json(fitter_.engine().device(), self_tests_.get(), largest_body_);
    else if (is({"v1", "models"})) response.body = api::to_json(catalogue_);
    else if (is({"v1", "models", "*"})) response = get_models(parts[2]);
    else if (is({"v1", "fits", "*"}) || is({"v1", "fits", "*", "result"})) response = get_result(parts[2]);
    else if (is({"v1", "fits", "*", "plots", "*"})) response = get_plot(parts[2], parts[4], request.query);
    else throw Refusal({404, "not-found", "there is nothing at this path", {}});
    only(reading);
    return response;
}

kernels::Precision Routes::proven(std::optional<kernels::Precision> wanted, const std::string& pointer) const {
    const kernels::Engine& engine = fitter_.engine();
    if (!engine.usable())
        throw Refusal({503, "unfit-device", "the device failed its self-test; /health/ready tells where", {}});
    const kernels::Precision best = engine.best_precision();
    const kernels::Precision precision = wanted.value_or(best);
    if (precision != best) self_tests_.wait();
    if (const auto reason = engine.refusal(precision))
        throw Refusal({422, "invalid-request", pointer + ": " + *reason, {{pointer, "unsupported", *reason, {}, {}}}});
    return precision;
}

Response Routes::post_fit(const Request& request) const {
    const std::string type = media_type(request.content_type);
    api::FitRequest fit;
    if (type == kCsv) fit = api::read_fit_request_csv(request.body, request.query, catalogue_);
    else if (type == kJson) {
        if (!request.query.empty())
            throw invalid_query(request.query.begin()->first, "unknown_key",
                                "with a JSON body there are no query parameters; options stand in the body");
        fit = api::read_fit_request(request.body, catalogue_);
    } else {
        throw Refusal({415, "unsupported-media-type", "the body must be " + accepted_types(request.path), {}});
    }
    (void)proven(fit.options.precision, "/options/precision");
    auto finished = std::make_shared<Job>();
    finished->id = make_job_id();
    finished->report = fitter_.fit(fit.dataset, fit.models, fit.options, stop_);
    if (stop_.stop_requested()) throw Refusal({503, "stopping", "the service is stopping", {}});
    for (const optim::ChannelReport& channel : finished->report.channels) {
        finished->succeeded = finished->succeeded || !channel.fits.empty();
        for (const optim::Failure& failure : channel.failures)
            spdlog::warn("fit {} channel {} model {}: {}: {}", finished->id, channel.channel.name, failure.model,
                         failure.reason, failure.detail);
    }
    finished->result = api::to_json(finished->report, finished->id);
    store_.put(finished);
    return {200, "application/json", finished->result, {{"Content-Location", "/v1/fits/" + finished->id + "/result"}}};
}

Response Routes::post_evaluate(const Request& request) const {
    if (media_type(request.content_type) != kJson)
        throw Refusal({415, "unsupported-media-type", "the body must be " + accepted_types(request.path), {}});
    const api::EvaluateRequest evaluate = api::read_evaluate_request(request.body, catalogue_);
    kernels::Engine& engine = fitter_.engine();
    const kernels::Precision precision = proven(evaluate.precision, "/precision");
    const kernels::Values values = kernels::evaluate(engine, *evaluate.model, precision, evaluate.parameters,
                                                     evaluate.directions, evaluate.gradient);
    Response response;
    response.body = api::to_json(evaluate, values, precision);
    return response;
}

Response Routes::get_ready() const {
    if (stop_.stop_requested()) throw Refusal({503, "stopping", "the service is stopping", {}});
    const std::vector<kernels::SelfTest>& self_tests = self_tests_.get();
    const bool ready = fitter_.engine().usable();
    Response response;
    response.status = ready ? 200 : 503;
    response.body = api::ready_json(self_tests, ready);
    return response;
}

Response Routes::get_models(const std::string& name) const {
    const kernels::Family* family = catalogue_.find(name);
    if (family == nullptr)
        throw Refusal({404, "unknown-model", "there is no such model; valid are: " + catalogue_.names(), {}});
    Response response;
    response.body = api::to_json(*family);
    return response;
}

std::shared_ptr<const Job> Routes::job(const std::string& id) const {
    auto found = store_.find(id);
    if (!found) throw Refusal({404, "unknown-fit", "there is no fit of that id, or no longer", {}});
    return found;
}

Response Routes::get_result(const std::string& id) const {
    Response response;
    response.body = job(id)->result;
    return response;
}

Response Routes::get_plot(const std::string& id, const std::string& file, const api::Query& query) const {
    struct Kind {
        std::string_view file;
        std::string (*draw)(const optim::Report&, const api::PlotOptions&);
    };
    static constexpr std::array<Kind, 3> kKinds{
        {{"brdf.svg", api::plot_brdf}, {"residual.svg", api::plot_residual}, {"summary.svg", api::plot_summary}}};
    const auto finished = job(id);
    const auto kind = std::find_if(kKinds.begin(), kKinds.end(), [&](const Kind& k) { return k.file == file; });
    if (kind == kKinds.end())
        throw Refusal(
            {404, "unknown-plot", "there is no such plot; valid are: brdf.svg, residual.svg, summary.svg", {}});
    const api::PlotOptions options = plot_options(query);
    try {
        return {200,
                "image/svg+xml",
                kind->draw(finished->report, options),
                {{"Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'"}}};
    } catch (const std::invalid_argument& error) {  // the plot's own words: they name the valid values
        throw Refusal({422, "invalid-request", error.what(), {}});
    }
}

}  // namespace brdfit::server
