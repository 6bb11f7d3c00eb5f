#include "server/local.h"

#include <spdlog/spdlog.h>

#include "api/archive.h"
#include "api/evaluate.h"
#include "api/request.h"
#include "api/response.h"
#include "kernels/evaluator.h"

namespace brdfit::server {

std::optional<std::string> LocalCompute::refusal(kernels::Precision precision) const {
    if (precision != fitter_.engine().best_precision()) self_tests_.wait();
    return fitter_.engine().refusal(precision);
}

std::string LocalCompute::evaluate(std::string_view body) {
    const api::EvaluateRequest request = api::read_evaluate_request(body, catalogue_);
    const kernels::Precision precision = request.precision.value_or(fitter_.engine().best_precision());
    return api::to_json(request,
                        kernels::evaluate(fitter_.engine(), *request.model, precision, request.parameters,
                                          request.directions, request.gradient),
                        precision);
}

LocalWorkers::LocalWorkers(const kernels::Catalogue& catalogue, optim::Fitter& fitter, JobStore& store,
                           unsigned threads)
    : catalogue_(catalogue), fitter_(fitter), store_(store) {
    for (unsigned i = 0; i < threads; ++i) threads_.emplace_back([this](const std::stop_token& stop) { work(stop); });
}

void LocalWorkers::work(const std::stop_token& stop) {
    while (!stop.stop_requested()) {
        const auto claimed = store_.claim("local", {});
        if (claimed) compute(*claimed, stop);
        else std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
}

void LocalWorkers::compute(const Claimed& claimed, const std::stop_token& stop) {
    std::stop_source cancel;
    const std::jthread heart([&](const std::stop_token& done) {
        while (!done.stop_requested()) {
            const Beat beat = store_.heartbeat(claimed.lease, std::chrono::seconds(30), R"({"fraction":0.5})");
            if (!beat.mine || beat.cancel_requested || stop.stop_requested()) cancel.request_stop();
            for (int i = 0; i < 10 && !done.stop_requested(); ++i) std::this_thread::sleep_for(std::chrono::milliseconds(10));
        }
    });
    const api::FitRequest request = api::read_job(claimed.request, claimed.dataset, catalogue_);
    const optim::Report report = fitter_.fit(request.dataset, request.models, request.options, cancel.get_token());
    Ending ending;
    bool any = false;
    for (const auto& channel : report.channels) any = any || !channel.fits.empty();
    ending.state = any ? JobState::succeeded : JobState::failed;
    if (cancel.stop_requested()) ending.state = JobState::cancelled;
    else {
        ending.result = api::to_json(report, claimed.lease.job);
        ending.figures = api::archive(report);
    }
    store_.finish(claimed.lease, ending);
}

}  // namespace brdfit::server
