#include "server/routes.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <vector>

#include <spdlog/spdlog.h>
#include <boost/algorithm/string/split.hpp>

#include "api/archive.h"
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
    try {
        return dispatch(request);
    } catch (const Refusal& refusal) {
        Response response = problem_response(refusal.problem(), request);
        if (refusal.problem().status == 405)
            response.headers["Allow"] = accepted_types(request.path).empty() ? "GET, HEAD" : "POST";
        return response;
    } catch (const StoreError& error) {
        spdlog::error("{} {} request {}: {}", request.method, request.path, request.id, error.what());
        return problem_response({503, "store", "the service cannot keep jobs at the moment", {}}, request);
    } catch (const std::exception& error) {
        spdlog::error("{} {} request {}: {}", request.method, request.path, request.id, error.what());
        return problem_response({500, "internal", "an error of the service; it has been logged", {}}, request);
    }
}

Response Routes::dispatch(const Request& request) const {
    const std::vector<std::string> parts =
        split(request.path.substr(std::min<std::size_t>(1, request.path.size())), '/');
    const bool reading = request.method == "GET" || request.method == "HEAD";
    const auto only = [&](bool allowed) {
        if (!allowed) throw Refusal({405, "method-not-allowed", request.method + " is not for this resource", {}});
    };
    const auto is = [&](std::initializer_list<std::string_view> path) {
        return std::equal(parts.begin(), parts.end(), path.begin(), path.end(),
                          [](const std::string& part, std::string_view name) { return name == "*" || part == name; });
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
        response.body = api::service_json(compute_.device(), compute_.self_tests(), kLargestBody);
    else if (is({"v1", "models"})) response.body = api::to_json(catalogue_);
    else if (is({"v1", "models", "*"})) response = get_models(parts[2]);
    else if (is({"v1", "fits", "*"}) || is({"v1", "fits", "*", "result"})) response = get_result(parts[2]);
    else if (is({"v1", "fits", "*", "plots", "*"})) response = get_plot(parts[2], parts[4], request.query);
    else throw Refusal({404, "not-found", "there is nothing at this path", {}});
    only(reading);
    return response;
}

void Routes::require_proven(std::optional<kernels::Precision> precision) const {
    if (!compute_.usable()) {
        (void)compute_.device();  // refuses if nobody computes
        throw Refusal({503, "unfit-device", "the device failed its self-test; /health/ready tells where", {}});
    }
    if (!precision) return;
    const std::string pointer = "/options/precision";
    if (const auto reason = compute_.refusal(*precision))
        throw Refusal({422, "invalid-request", pointer + ": " + *reason, {{pointer, "unsupported", *reason, {}, {}}}});
}

Response Routes::post_fit(const Request& request) const {
    const std::string type = media_type(request.content_type);
    api::FitRequest fit;
    NewJob job;
    if (type == kCsv) {
        fit = api::read_fit_request_csv(request.body, request.query, catalogue_);
        job.request = api::job_text_csv(request.body, request.query);
    } else if (type == kJson) {
        if (!request.query.empty())
            throw invalid_query(request.query.begin()->first, "unknown_key",
                                "with a JSON body there are no query parameters; options stand in the body");
        fit = api::read_fit_request(request.body, catalogue_);
        job.request = api::job_text(request.body);
    } else {
        throw Refusal({415, "unsupported-media-type", "the body must be " + accepted_types(request.path), {}});
    }
    require_proven(fit.options.precision);
    if (stop_.stop_requested()) throw Refusal({503, "stopping", "the service is stopping", {}});
    job.id = make_job_id();
    job.priority = Priority::interactive;
    Changes::Watch watch(store_.changes(), job.id);
    store_.submit(job);
    store_.sync();  // while it is computed
    constexpr std::chrono::milliseconds kLookAgain{1000};
    std::optional<Job> found = store_.find(job.id);
    while (found && !has_ended(found->state)) {
        watch.wait(kLookAgain);
        found = store_.find(job.id);
        if (store_.changes().closed() && found && !has_ended(found->state))
            throw Refusal({503, "stopping", "the service is stopping; the fit goes on when it is started again", {}});
    }
    const auto result = store_.result(job.id);
    if (!result) throw std::runtime_error("fit " + job.id + " failed: " + (found ? found->error : "it was removed"));
    return {200, "application/json", *result, {{"Content-Location", "/v1/fits/" + job.id + "/result"}}};
}

Response Routes::post_evaluate(const Request& request) const {
    if (media_type(request.content_type) != kJson)
        throw Refusal({415, "unsupported-media-type", "the body must be " + accepted_types(request.path), {}});
    Response response;
    response.body = compute_.evaluate(request.body);
    return response;
}

Response Routes::get_ready() const {
    if (stop_.stop_requested()) throw Refusal({503, "stopping", "the service is stopping", {}});
    const std::vector<kernels::SelfTest> self_tests = compute_.self_tests();
    store_.probe();
    const bool ready = compute_.usable();
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

namespace {

Refusal unknown_fit() { return Refusal({404, "unknown-fit", "there is no fit of that id, or no longer", {}}); }

}  // namespace

Response Routes::get_result(const std::string& id) const {
    auto result = store_.result(id);
    if (!result) throw unknown_fit();
    Response response;
    response.body = std::move(*result);
    return response;
}

Response Routes::get_plot(const std::string& id, const std::string& file, const api::Query& query) const {
    struct Kind {
        std::string_view file;
        std::string (*draw)(const optim::Report&, const api::PlotOptions&);
    };
    static constexpr std::array<Kind, 3> kKinds{
        {{"brdf.svg", api::plot_brdf}, {"residual.svg", api::plot_residual}, {"summary.svg", api::plot_summary}}};
    const auto figures = store_.figures(id);
    if (!figures) throw unknown_fit();
    const auto kind = std::find_if(kKinds.begin(), kKinds.end(), [&](const Kind& k) { return k.file == file; });
    if (kind == kKinds.end())
        throw Refusal(
            {404, "unknown-plot", "there is no such plot; valid are: brdf.svg, residual.svg, summary.svg", {}});
    const api::PlotOptions options = plot_options(query);
    try {
        return {200,
                "image/svg+xml",
                kind->draw(api::read_archive(*figures), options),
                {{"Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'"}}};
    } catch (const std::invalid_argument& error) {  // the plot's own words: they name the valid values
        throw Refusal({422, "invalid-request", error.what(), {}});
    }
}

}  // namespace brdfit::server
