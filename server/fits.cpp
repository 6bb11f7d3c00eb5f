#include "server/fits.h"

#include <algorithm>
#include <array>
#include <charconv>

#include <spdlog/spdlog.h>

#include "api/archive.h"
#include "api/examples.h"
#include "api/listing.h"
#include "api/plot.h"
#include "api/response.h"
#include "server/headers.h"
#include "server/paging.h"

namespace brdfit::server {
namespace {

using api::problem_type;
using api::Refusal;
using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;

constexpr seconds kUsualWait{10};
/// Changes of other processes may go untold: look again after so long.
constexpr milliseconds kLookAgain{1000};
constexpr seconds kPing{15};

struct PlotKind {
    std::string_view file;
    std::string (*draw)(const optim::Report&, const api::PlotOptions&);
};
constexpr std::array<PlotKind, 3> kPlots{
    {{"brdf.svg", api::plot_brdf}, {"residual.svg", api::plot_residual}, {"summary.svg", api::plot_summary}}};

// ---- the table's texts ----

using In = api::Parameter::In;

const api::Parameter kId{In::path, "id", "of the fit", api::schema::text(), {}};
const api::Parameter kPreferWait{In::header,
                                 "Prefer",
                                 "wait=N: wait up to N seconds, at most 60; respond-async: do not wait",
                                 api::schema::text(),
                                 {}};
const api::Parameter kIfNoneMatch{
    In::header, "If-None-Match", "304 if the entity tag is still that", api::schema::text(), {}};
const api::Parameter kIfMatch{
    In::header, "If-Match", "412 if the entity tag is another by now", api::schema::text(), {}};

api::Operation operation(std::string_view method, std::string_view path, std::string_view id,
                         std::string_view summary) {
    return {method, path, id, "Fits", summary};
}

std::string query_text(const api::Query& query) {
    std::string text;
    for (const auto& [key, value] : query)
        text += std::to_string(key.size()) + key + std::to_string(value.size()) + value;
    return text;
}

std::optional<IdempotencyKey> idempotency_key(const Request& request) {
    const auto found = request.headers.find("Idempotency-Key");
    if (found == request.headers.end()) return std::nullopt;
    const std::string& key = found->second;
    const auto is_visible = [](char c) { return c > 0x20 && c < 0x7f; };
    if (key.empty() || key.size() > 255 || !std::all_of(key.begin(), key.end(), is_visible))
        throw Refusal(
            {problem_type("invalid-header"), "Idempotency-Key must be 1 to 255 visible ASCII characters", {}});
    return IdempotencyKey{
        key, result_key({request.path, query_text(request.query), media_type(request.content_type), request.body})};
}

StoreTime last_change(const Job& job) { return job.ended.value_or(job.started.value_or(job.created)); }

std::string self_of(const std::string& id) { return "/v1/fits/" + id; }

std::string event_text(const Event& event) {
    const std::string kind(name_of(event.kind));
    return "id: " + std::to_string(event.number) + "\nevent: " + kind +
           "\ndata: " + api::event_json(kind, event.body, rfc3339(event.at)) + "\n\n";
}

/// A job's events from `after` on, until it is done, gone, or nobody listens.
void stream_events(JobStore& store, const std::string& id, std::uint64_t after, Stream& out) {
    Changes::Watch watch(store.changes(), id);
    Clock::time_point spoke = Clock::now();
    if (!out.write("retry: 1000\n\n")) return;
    while (out.open() && !out.stopping()) {
        const std::vector<Event> events = store.events(id, after);
        for (const Event& event : events) {
            if (!out.write(event_text(event)) || event.kind == EventKind::done) return;
            after = event.number;
            spoke = Clock::now();
        }
        if (events.empty()) {
            const auto job = store.find(id);
            if (!job || (has_ended(job->state) && job->last_event <= after)) return;
        }
        if (Clock::now() - spoke >= kPing) {
            if (!out.write(": ping\n\n")) return;
            spoke = Clock::now();
        }
        watch.wait(kLookAgain);
    }
}

}  // namespace

Fits::Fits(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, std::stop_token stop)
    : catalogue_(catalogue), store_(store), compute_(compute), stop_(std::move(stop)) {
    std::vector<std::string_view> texts;
    for (const kernels::Family& family : catalogue.families()) texts.push_back(family.variants.back().text);
    models_ = result_key(texts);
}

std::vector<Route> Fits::routes() {
    using namespace api;
    namespace s = api::schema;
    const auto call = [this](Response (Fits::*member)(const Call&)) {
        return [this, member](const Call& c) { return (this->*member)(c); };
    };
    std::vector<Route> routes;
    {
        Operation op = operation("POST", "/v1/fits", "postFit",
                                 "Fit models to measurements. Waits for the result, and answers 202 where that takes "
                                 "longer than Prefer allows");
        op.parameters = in_query(fit_query());
        op.parameters.push_back({In::header, "Prefer",
                                 "wait=N: wait up to N seconds (10 if absent, at most 60); respond-async: do not wait, "
                                 "and let fits go first that somebody waits for",
                                 s::text(), "wait=30"});
        op.parameters.push_back({In::header,
                                 "Idempotency-Key",
                                 "the same key with the same request is one fit, however often it is sent; kept for a "
                                 "day",
                                 s::text(),
                                 {}});
        op.parameters.push_back({In::header,
                                 "Cache-Control",
                                 "no-cache: compute anew even if the result of the same request is kept",
                                 s::text(),
                                 {}});
        op.bodies = {{kJson, s::named("FitRequest"), examples::fit_request()}, {kCsv, s::text(), examples::kCsv}};
        op.answers = {{200,
                       "the ranked fits; those of a stored result where Cache-Status says hit",
                       {{kJson, s::named("FitResult")}},
                       {{"Content-Location", "where the same bytes stay"},
                        {"Cache-Status", "hit: a stored result of the same request; fwd=miss or fwd=request: computed"},
                        {"Preference-Applied", "what of Prefer was heeded"},
                        {"Idempotency-Replayed", "true where the key was used before"}}},
                      {202,
                       "taken; it goes on",
                       {{kJson, s::named("FitStatus")}},
                       {{"Location", "of the fit"}, {"Retry-After", "seconds"}}}};
        op.problems = {"invalid-json", "invalid-header",         "in-flight",       "no-result",  "gone",
                       "too-large",    "unsupported-media-type", "invalid-request", "key-reused", "too-many-requests",
                       "unavailable",  "unfit-device",           "stopping",        "poison-job"};
        routes.push_back({std::move(op), call(&Fits::post)});
    }
    {
        Operation op = operation("GET", "/v1/fits", "listFits", "Fits that are kept, newest first");
        op.parameters = in_query(fit_list_query());
        op.answers = {{200, "a page", {{kJson, s::named("FitPage")}}, {{"Link", "rel=next: the next page"}}}};
        op.problems = {"invalid-cursor", "invalid-request"};
        routes.push_back({std::move(op), call(&Fits::list)});
    }
    {
        Operation op = operation("GET", "/v1/fits/{id}", "getFit",
                                 "What became of a fit. With Prefer: wait=N the answer waits until it has ended; with "
                                 "If-None-Match as well, until anything has changed");
        op.parameters = {kId, kPreferWait, kIfNoneMatch};
        op.answers = {{200, "its state", {{kJson, s::named("FitStatus")}}, {{"ETag", "of this state"}}},
                      {304, "it is as If-None-Match says"}};
        op.problems = {"invalid-header", "unknown-fit", "gone"};
        routes.push_back({std::move(op), call(&Fits::get)});
    }
    {
        Operation op = operation("POST", "/v1/fits/{id}/cancel", "cancelFit", "Stop a fit. May be sent again");
        op.parameters = {kId, kIfMatch};
        op.answers = {{202, "it is being stopped", {{kJson, s::named("FitStatus")}}},
                      {200, "it has ended", {{kJson, s::named("FitStatus")}}}};
        op.problems = {"unknown-fit", "gone", "precondition-failed"};
        routes.push_back({std::move(op), call(&Fits::cancel)});
    }
    {
        Operation op = operation("DELETE", "/v1/fits/{id}", "deleteFit",
                                 "Remove a fit with its result; one that runs is cancelled");
        op.parameters = {kId, kIfMatch};
        op.answers = {{204, "removed"}};
        op.problems = {"unknown-fit", "gone", "precondition-failed"};
        routes.push_back({std::move(op), call(&Fits::remove)});
    }
    {
        Operation op = operation("GET", "/v1/fits/{id}/events", "getFitEvents",
                                 "Server-sent events: state, progress, model_done and, at the end, done");
        op.parameters = {kId, {In::header, "Last-Event-ID", "go on after this one", s::count(), {}}};
        op.answers = {{200, "events, each with an id; a comment at least every 15 s", {{kEventStream, s::text()}}},
                      {204, "it has ended, and there are no events after Last-Event-ID"}};
        op.problems = {"invalid-header", "unknown-fit", "not-acceptable", "gone"};
        routes.push_back({std::move(op), call(&Fits::events)});
    }
    {
        Operation op = operation("GET", "/v1/fits/{id}/result", "getResult",
                                 "The ranked fits: the same bytes for as long as the fit is kept");
        op.parameters = {kId, kIfNoneMatch};
        op.answers = {{200,
                       "JSON, or by Accept CSV with a row for each parameter of each fit",
                       {{kJson, s::named("FitResult")}, {kCsv, s::text()}},
                       {{"ETag", "strong"}}},
                      {304, "it is as If-None-Match says"}};
        op.problems = {"unknown-fit", "not-acceptable", "not-finished", "no-result", "gone"};
        routes.push_back({std::move(op), call(&Fits::result)});
    }
    {
        Operation op = operation("GET", "/v1/fits/{id}/plots/{kind}", "getPlot",
                                 "An error plot: measurements with the models' curves (brdf), residuals, or a summary");
        std::vector<std::string_view> kinds;
        for (const PlotKind& kind : kPlots) kinds.push_back(kind.file);
        op.parameters = {kId, {In::path, "kind", "which plot", s::one_of(kinds), kPlots.front().file}};
        for (Parameter& parameter : in_query(plot_query())) op.parameters.push_back(std::move(parameter));
        op.parameters.push_back(kIfNoneMatch);
        op.answers = {{200, "a picture", {{kSvg, s::text()}}, {{"ETag", "strong"}}},
                      {304, "it is as If-None-Match says"}};
        op.problems = {"unknown-fit", "unknown-plot", "not-finished", "no-result", "gone", "invalid-request"};
        routes.push_back({std::move(op), call(&Fits::plot)});
    }
    return routes;
}

api::PostedFit Fits::read(const Request& request) {
    if (body_type(request, {kJson, kCsv}) == kCsv)
        return api::read_posted_fit_csv(request.body, request.query, catalogue_);
    if (!request.query.empty())
        throw invalid("/" + api::pointer_part(request.query.begin()->first), "unknown_key",
                      "with a JSON body there are no query parameters; options stand in the body");
    return api::read_posted_fit(request.body, catalogue_, [this](const std::string& id) -> std::optional<std::string> {
        auto found = store_.find_dataset(id);
        if (!found) return std::nullopt;
        return std::move(found->body);
    });
}

void Fits::require_proven(std::optional<kernels::Precision> precision) const {
    if (!compute_.usable())
        throw Refusal({problem_type("unfit-device"), "the device failed its self-test; /health/ready tells where", {}});
    if (!precision) return;
    if (const auto reason = compute_.refusal(*precision)) throw invalid("/options/precision", "unsupported", *reason);
}

std::string Fits::result_key_of(const api::PostedFit& posted, const Request& request) const {
    const kernels::DeviceInfo device = compute_.device();
    return result_key({request.tenant, posted.text, posted.dataset.value_or(""), api::version(), models_, device.name,
                       device.platform, device.version});
}

Job Fits::find(const Request& request, const std::string& id) {
    auto job = store_.find(id);
    if (job && job->tenant == request.tenant) return std::move(*job);
    if (!job && store_.presence(id) == Presence::removed)
        throw Refusal({problem_type("gone"), "the fit of that id was removed", {}});
    throw Refusal({problem_type("unknown-fit"), "there is no fit of that id", {}});
}

api::FitStatus Fits::status(const Job& job, bool with_position) {
    api::FitStatus status{job.id, name_of(job.state), has_ended(job.state)};
    status.dataset = job.dataset;
    if (with_position && job.state == JobState::queued) status.queue_position = store_.queue_position(job.id);
    status.attempt = job.attempt;
    status.progress = job.progress;
    if (has_ended(job.state)) status.error = job.error;
    status.created = rfc3339(job.created);
    if (job.started) status.started = rfc3339(*job.started);
    if (job.ended) status.ended = rfc3339(*job.ended);
    return status;
}

Job Fits::wait(const Request& request, const std::string& id, seconds time, bool for_change) {
    const Clock::time_point until = Clock::now() + time;
    Changes::Watch watch(store_.changes(), id);
    while (true) {
        Job job = find(request, id);
        const auto left = std::chrono::duration_cast<milliseconds>(until - Clock::now());
        if (has_ended(job.state) || left <= milliseconds(0) || stop_.stop_requested()) return job;
        if (for_change && !is_known(request, entity_tag(api::to_json(status(job, true))))) return job;
        watch.wait(std::min(left, kLookAgain));
    }
}

Response Fits::outcome(const Request& request, const Job& job) {
    auto result = store_.result(job.id);
    if (!result) {
        if (job.state != JobState::failed) throw Refusal({problem_type("no-result"), "the fit was cancelled", {}});
        api::FailedFit failed = api::failed_fit(job.error, request.path, request.id);
        return {failed.status, "application/problem+json", std::move(failed.body), {{"Location", self_of(job.id)}}};
    }
    Response response;
    response.body = std::move(*result);
    response.headers["Content-Location"] = self_of(job.id) + "/result";
    return response;
}

Response Fits::post(const Call& call) {
    const Request& request = call.request;
    api::PostedFit posted = read(request);
    require_proven(posted.precision);
    const Preferences wanted = preferences(request);
    const seconds time = wanted.wait.value_or(wanted.respond_async ? seconds(0) : kUsualWait);

    NewJob job;
    job.id = make_job_id();
    job.tenant = request.tenant;
    job.priority = time > seconds(0) ? Priority::interactive : Priority::batch;
    job.dataset = posted.dataset;
    job.result_key = result_key_of(posted, request);
    job.request = std::move(posted.text);
    job.reuse = !lists(request.header("Cache-Control"), "no-cache");
    job.idempotency = idempotency_key(request);
    using Outcome = Submitted::Outcome;
    const auto submit = [&]() -> Submitted {
        if (job.reuse && !job.idempotency)  // by reading alone, as this is asked often
            if (auto kept = store_.find_result(job.result_key)) return {Outcome::reused, std::move(*kept)};
        return store_.submit(job);
    };
    const Submitted submitted = submit();
    job.request = std::string();  // not while it waits
    switch (submitted.outcome) {
        case Outcome::in_flight: throw Refusal({problem_type("in-flight"), "it is " + self_of(submitted.id), {}});
        case Outcome::other_body:
            throw Refusal({problem_type("key-reused"), "this Idempotency-Key came with another request before", {}});
        case Outcome::unknown_dataset:  // removed since it was read
            throw invalid("/dataset", "unknown_dataset", "there is no stored dataset of that id");
        case Outcome::created:
        case Outcome::reused:
        case Outcome::replayed: break;
    }
    // While it is computed; what only reads needs none.
    if (submitted.outcome == Outcome::created || job.idempotency) store_.sync();
    const Job ended = wait(request, submitted.id, time, false);
    Response response;
    if (has_ended(ended.state)) {
        response = outcome(request, ended);
        if (wanted.wait) response.headers["Preference-Applied"] = "wait=" + std::to_string(wanted.wait->count());
    } else {
        response.status = 202;
        response.body = api::to_json(status(ended, true));
        response.headers["Location"] = self_of(submitted.id);
        response.headers["Retry-After"] = "1";
        if (wanted.respond_async) response.headers["Preference-Applied"] = "respond-async";
        else if (wanted.wait) response.headers["Preference-Applied"] = "wait=" + std::to_string(wanted.wait->count());
    }
    response.headers["Cache-Status"] = submitted.outcome == Outcome::created
                                           ? (job.reuse ? "brdfit; fwd=miss; stored" : "brdfit; fwd=request; stored")
                                           : "brdfit; hit";
    if (submitted.outcome == Outcome::replayed) response.headers["Idempotency-Replayed"] = "true";
    return response;
}

Response Fits::list(const Call& call) {
    const Request& request = call.request;
    const api::ListQuery query = api::read_fit_list(request.query);
    JobFilter filter{request.tenant, {}, query.dataset};
    if (query.state) filter.state = job_state(*query.state);
    const Page<Job> page = list_page([&] { return store_.list(filter, page_of(query)); });
    std::vector<api::FitStatus> items;
    for (const Job& job : page.items) items.push_back(status(job, false));
    Response response;
    response.body = api::page_json(items, page.next);
    if (page.next) response.headers["Link"] = api::next_link(request.path, request.query, *page.next);
    return response;
}

Response Fits::get(const Call& call) {
    const Request& request = call.request;
    refuse_query(request);
    const Preferences wanted = preferences(request);
    const bool for_change = !request.header("If-None-Match").empty();
    const Job job = wait(request, call.path[0], wanted.wait.value_or(seconds(0)), for_change);
    Response response;
    response.body = api::to_json(status(job, true));
    response.headers["ETag"] = entity_tag(response.body);
    response.headers["Last-Modified"] = http_date(last_change(job));
    response.headers["Cache-Control"] = "private, no-cache";
    if (wanted.wait) response.headers["Preference-Applied"] = "wait=" + std::to_string(wanted.wait->count());
    if (!has_ended(job.state)) response.headers["Retry-After"] = "1";
    return response;
}

Response Fits::cancel(const Call& call) {
    const Request& request = call.request;
    refuse_query(request);
    const Job job = find(request, call.path[0]);
    require_match(request, entity_tag(api::to_json(status(job, true))), last_change(job));
    store_.request_cancel(job.id);
    store_.sync();
    const Job now = find(request, job.id);
    Response response;
    response.status = has_ended(now.state) ? 200 : 202;
    response.body = api::to_json(status(now, true));
    response.headers["Content-Location"] = self_of(job.id);
    if (!has_ended(now.state)) response.headers["Retry-After"] = "1";
    return response;
}

Response Fits::remove(const Call& call) {
    const Request& request = call.request;
    refuse_query(request);
    const Job job = find(request, call.path[0]);
    require_match(request, entity_tag(api::to_json(status(job, true))), last_change(job));
    if (!has_ended(job.state)) store_.request_cancel(job.id);
    store_.remove(job.id);
    store_.sync();
    Response response;
    response.status = 204;
    return response;
}

Response Fits::events(const Call& call) {
    const Request& request = call.request;
    refuse_query(request);
    const Job job = find(request, call.path[0]);
    (void)accepted(request, {kEventStream});
    const std::string_view last = request.header("Last-Event-ID");
    std::uint64_t after = 0;
    const auto [end, error] = std::from_chars(last.data(), last.data() + last.size(), after);
    if (!last.empty() && (error != std::errc{} || end != last.data() + last.size()))
        throw Refusal({problem_type("invalid-header"), "Last-Event-ID must be the id of an event", {}});
    Response response;
    if (has_ended(job.state) && job.last_event <= after) {
        response.status = 204;  // tells a browser not to come back
        return response;
    }
    response.content_type = kEventStream;
    response.headers["Cache-Control"] = "no-store";
    response.headers["X-Accel-Buffering"] = "no";  // a proxy passes events on at once
    response.stream = [this, id = job.id, after](Stream& out) {
        try {
            stream_events(store_, id, after, out);
        } catch (const StoreError& trouble) {  // the client comes again, with Last-Event-ID
            spdlog::error("events of fit {}: {}", id, trouble.what());
        }
    };
    return response;
}

Response Fits::result(const Call& call) {
    const Request& request = call.request;
    refuse_query(request);
    const Job job = find(request, call.path[0]);
    const std::string_view type = accepted(request, {kJson, kCsv});
    auto result = store_.result(job.id);
    if (!result && !has_ended(job.state))
        throw Refusal({problem_type("not-finished"), "the fit is " + std::string(name_of(job.state)), {}});
    if (!result) throw Refusal({problem_type("no-result"), "the fit " + std::string(name_of(job.state)), {}});
    Response response;
    response.body = type == kCsv ? api::result_csv(*result) : std::move(*result);
    if (type == kCsv) {
        response.content_type = "text/csv; charset=utf-8; header=present";
        response.headers["Content-Disposition"] = "attachment; filename=\"" + job.id + ".csv\"";
    }
    response.headers["ETag"] = entity_tag(response.body);
    response.headers["Vary"] = "Accept";
    response.headers["Cache-Control"] = "private, max-age=31536000, immutable";
    if (job.ended) response.headers["Last-Modified"] = http_date(*job.ended);
    return response;
}

Response Fits::plot(const Call& call) {
    const Request& request = call.request;
    const Job job = find(request, call.path[0]);
    const auto kind =
        std::find_if(kPlots.begin(), kPlots.end(), [&](const PlotKind& k) { return k.file == call.path[1]; });
    if (kind == kPlots.end())
        throw Refusal({problem_type("unknown-plot"),
                       "there is no such plot; valid are: brdf.svg, residual.svg, summary.svg",
                       {}});
    const api::PlotOptions options = api::read_plot_options(request.query);
    const auto figures = store_.figures(job.id);
    if (!figures && !has_ended(job.state))
        throw Refusal({problem_type("not-finished"), "the fit is " + std::string(name_of(job.state)), {}});
    if (!figures) throw Refusal({problem_type("no-result"), "the fit " + std::string(name_of(job.state)), {}});
    Response response;
    try {
        response.body = kind->draw(api::read_archive(*figures), options);
    } catch (const api::InvalidPlot& error) {  // the plot's own words: they name the valid values
        throw invalid("/" + error.option, "unknown_value", error.what());
    }
    response.content_type = kSvg;
    response.headers["Content-Security-Policy"] = "default-src 'none'; style-src 'unsafe-inline'";
    response.headers["ETag"] = entity_tag(response.body);
    response.headers["Cache-Control"] = "private, max-age=31536000, immutable";
    return response;
}

}  // namespace brdfit::server
