#include "optim/fit.h"

#include <malloc.h>
#include <algorithm>
#include <cmath>
#include <future>
#include <iterator>
#include <list>
#include <map>
#include <mutex>
#include <set>
#include <tuple>

#include <boost/asio/post.hpp>  // a kept thread pool
#include <boost/asio/thread_pool.hpp>

#include "kernels/evaluator.h"
#include "kernels/hemisphere.h"
#include "optim/broker.h"
#include "optim/findings.h"
#include "optim/ledger.h"
#include "optim/physics.h"
#include "optim/variant.h"

namespace brdfit::optim {
namespace {

using Clock = std::chrono::steady_clock;
using kernels::Model;

/// A further lobe is reported only if the BIC falls by this much: "very strong" evidence (Kass and Raftery 1995).
constexpr double kEvidence = 10;

/// Why a search is over.
StopReason stop_of(const SearchControl& control) {
    return control.stop.stop_requested() ? StopReason::cancelled : StopReason::time_limit;
}

std::size_t least_lobes(const kernels::Family& family) { return family.repeat ? family.repeat->min : 1; }

/// What robust fits of one (channel, model) begin with.
struct Beginning {
    std::vector<Groundwork> variants;  ///< from the fewest lobes up
    double scale = HUGE_VAL;           ///< the least of theirs, in the loss's unit
    double time_s = 0;
};

Beginning begin_robustly(const Work& work) {
    const auto start = Clock::now();
    Beginning beginning;
    const Model* smaller = nullptr;
    for (std::size_t lobes = least_lobes(*work.request.family); lobes <= work.request.most_lobes(); ++lobes) {
        const Variant variant(work, work.request.variant(lobes));
        if (!beginning.variants.empty() && !variant.possible()) break;
        variant.require_possible();
        const Point* before = smaller != nullptr ? &beginning.variants.back().starts.front() : nullptr;
        beginning.variants.push_back(lay_groundwork(variant.task, variant.prepared.bounds, before, smaller));
        smaller = &variant.task.model;
        beginning.scale = std::min(beginning.scale, scale_in_loss(variant.prepared.channel, work.options.loss,
                                                                  beginning.variants.back().scale) *
                                                        variant.prepared.residual_unit);
    }
    beginning.time_s = std::chrono::duration<double>(Clock::now() - start).count();
    return beginning;
}

/// Fits the request's variants from the fewest lobes up, each from the one before, and returns the last; with "auto",
/// the last for which there is strong evidence. With a robust loss, from its beginning and under the channel's scale.
Fit fit_model(const Work& work, const Beginning* beginning, double robust_scale) {
    const auto start = Clock::now();
    const bool automatic = work.request.family->repeat && !work.request.lobes;
    std::unique_ptr<Variant> chosen, smaller;
    std::size_t evaluations = 0;
    const std::size_t least = least_lobes(*work.request.family);
    for (std::size_t lobes = least; lobes <= work.request.most_lobes(); ++lobes) {
        auto variant = std::make_unique<Variant>(work, work.request.variant(lobes));
        if (automatic && chosen && !variant->possible()) break;
        variant->require_possible();
        const Variant* const before = chosen ? chosen.get() : smaller.get();
        const Optimum* const start_from = before != nullptr ? &before->optimum : nullptr;
        const Prepared& prepared = variant->prepared;
        if (beginning != nullptr)
            variant->weighted = weigh(prepared.channel, work.options.loss, robust_scale / prepared.residual_unit);
        const Weighted loss = variant->weighted;
        variant->optimum = beginning != nullptr ? find_robust_optimum(variant->task, prepared.bounds, start_from,
                                                                      beginning->variants.at(lobes - least))
                                                : find_optimum(variant->task, prepared.bounds, start_from);
        add_before(variant->optimum.record, evaluations);
        evaluations = variant->optimum.record.evaluations;
        order_lobes(work, variant->task.model, variant->optimum);
        const bool last = lobes == work.request.most_lobes();
        if (!automatic && !last) {
            smaller = std::move(variant);
            continue;
        }
        describe(work, before, robust_scale, *variant);
        if (!work.options.require.empty()) {
            keep_to_requirements(work, before, robust_scale, loss, *variant);
            evaluations = variant->optimum.record.evaluations;
        }
        if (chosen && !(variant->fit.bic < chosen->fit.bic - kEvidence)) break;
        chosen = std::move(variant);
        if (automatic && !last && work.control.over()) {
            chosen->fit.search.stop_reason = stop_of(work.control);
            break;
        }
    }
    explain(work, robust_scale, *chosen);
    chosen->fit.search.evaluations = evaluations;
    chosen->fit.search.time_s = std::chrono::duration<double>(Clock::now() - start).count();
    if (beginning != nullptr) chosen->fit.search.time_s += beginning->time_s;
    return std::move(chosen->fit);
}

/// Searches at once: enough that the device always has launches, no more than that, for each takes memory and all of
/// them are as late as the last.
Broker::Limits broker_limits(const kernels::DeviceInfo& device) {
    constexpr std::size_t kTasksOfUnit = 8;
    return {std::clamp<std::size_t>(kTasksOfUnit * device.compute_units, 16, 256)};
}

/// What a task has made, or why there is nothing.
template <class Result>
struct Outcome {
    std::optional<Result> result;
    Failure failure;
    bool dropped = false;  ///< another says the same
};

template <class Job>
auto attempt(const Work& work, const Job& job) -> Outcome<decltype(job())> {
    const auto failed = [&](std::string reason, const std::exception& error) -> Outcome<decltype(job())> {
        const kernels::Submodel* submodel = work.request.submodel;
        return {
            std::nullopt,
            {work.request.family->name, std::move(reason), error.what(), submodel != nullptr ? submodel->name : ""}};
    };
    try {
        return {job(), {}};
    } catch (const SearchError& error) {
        return failed(error.what(), error);
    } catch (const kernels::BuildError& error) {
        return failed("the model does not build for this device", error);
    } catch (const kernels::DeviceError& error) {
        return failed("the OpenCL device failed", error);
    } catch (const std::exception& error) {
        return failed("internal error", error);
    }
}

void add_costs(kernels::CostBook& costs, const std::vector<ModelRequest>& models, Report& report) {
    std::map<std::string, const kernels::Family*> families;
    for (const ModelRequest& model : models) families[model.family->name] = model.family;
    std::vector<Fit*> fits;
    std::vector<const Model*> variants;
    for (ChannelReport& channel : report.channels)
        for (Fit& fit : channel.fits) {
            const kernels::Family& family = *families.at(fit.model);
            fits.push_back(&fit);
            variants.push_back(&family.variant(std::max<std::size_t>(1, fit.lobes), family.submodel(fit.submodel)));
        }
    const std::vector<kernels::Cost> found = costs.costs(variants);
    for (std::size_t i = 0; i < fits.size(); ++i) fits[i]->cost = found[i];
}

std::vector<std::string> channel_warnings(const Channel& channel) {
    const auto dark = std::count_if(channel.samples.begin(), channel.samples.end(),
                                    [](const Sample& sample) { return sample.brdf <= 0; });
    if (dark == 0) return {};
    return {std::to_string(dark) + " of " + std::to_string(channel.samples.size()) +
            " BRDF values are not positive: taken as noise below the floor, kept, but left out where logarithms or "
            "relative errors are taken"};
}

/// What a fit is ranked by; infinite where it has none.
double measure(const Fit& fit, RankBy by) {
    switch (by) {
        case RankBy::loss: return fit.loss;
        case RankBy::aicc: return fit.aicc.value_or(HUGE_VAL);
        case RankBy::bic: return fit.bic;
        case RankBy::held_out: return fit.held_out ? fit.held_out->loss : HUGE_VAL;
        case RankBy::log10_rmse: return fit.log10_rmse.value_or(HUGE_VAL);
    }
    return HUGE_VAL;
}

/// A model to fit, and which of the request's it is a form of.
struct Form {
    ModelRequest model;
    std::size_t of = 0;
};

/// The models, and their simpler forms: those with fewer lobes, and submodels that hold nothing the request speaks of.
std::vector<Form> with_simpler_forms(const std::vector<ModelRequest>& models) {
    std::vector<Form> forms;
    for (std::size_t i = 0; i < models.size(); ++i) {
        std::vector<ModelRequest> wholes{models[i]};
        if (const auto& repeat = models[i].family->repeat)
            for (std::size_t lobes = models[i].most_lobes() - 1; lobes >= repeat->min; --lobes) {
                wholes.push_back(models[i]);
                wholes.back().lobes = lobes;
            }
        for (const ModelRequest& whole : wholes) {
            forms.push_back({whole, i});
            if (whole.submodel != nullptr) continue;
            for (const kernels::Submodel& submodel : whole.family->submodels) {
                const auto is_named = [&](const auto& held) {
                    return whole.fixed.count(held.first) > 0 || whole.bounds.count(held.first) > 0;
                };
                if (std::any_of(submodel.fixed.begin(), submodel.fixed.end(), is_named)) continue;
                forms.push_back({whole, i});
                forms.back().model.submodel = &submodel;
            }
        }
    }
    return forms;
}

std::string name_of(const ModelRequest& model) {
    return kernels::variant_name(model.family->name, model.lobes.value_or(0),
                                 model.submodel != nullptr ? model.submodel->name : "");
}

/// Tells, however a task ends, that it is over.
struct TaskEnd {
    explicit TaskEnd(TaskProgress* progress) : progress_(progress) {}
    ~TaskEnd() {
        if (progress_ != nullptr) progress_->finish(relative_loss);
    }
    TaskEnd(const TaskEnd&) = delete;
    TaskEnd& operator=(const TaskEnd&) = delete;

    std::optional<double> relative_loss;

private:
    TaskProgress* progress_;
};

/// Drops fits of forms that turned out to be the same: "auto" had found that fewer lobes are enough.
std::vector<Outcome<Fit>> distinct(const std::vector<Form>& forms, std::vector<Outcome<Fit>> outcomes) {
    std::set<std::tuple<std::size_t, std::size_t, std::string>> seen;
    std::vector<Outcome<Fit>> kept;
    for (std::size_t i = 0; i < outcomes.size(); ++i) {
        const std::optional<Fit>& fit = outcomes[i].result;
        if (!fit || seen.emplace(forms[i].of, fit->lobes, fit->submodel).second) kept.push_back(std::move(outcomes[i]));
    }
    return kept;
}

ChannelReport rank(const Channel& channel, RankBy by, std::vector<Outcome<Fit>> outcomes) {
    ChannelReport report{channel, {}, {}, channel_warnings(channel)};
    for (Outcome<Fit>& outcome : outcomes) {
        if (outcome.result) report.fits.push_back(std::move(*outcome.result));
        else report.failures.push_back(std::move(outcome.failure));
    }
    std::stable_sort(report.fits.begin(), report.fits.end(), [&](const Fit& a, const Fit& b) {
        return std::pair(measure(a, by), a.loss) < std::pair(measure(b, by), b.loss);
    });
    for (std::size_t i = 0; i < report.fits.size(); ++i) report.fits[i].rank = i + 1;
    return report;
}

}  // namespace

/// One of the two.
struct Fitter::Workers {
    Workers(const kernels::Engine& engine, unsigned threads) {
        if (engine.overlaps()) broker.emplace(broker_limits(engine.device()));
        else pool = std::make_unique<boost::asio::thread_pool>(std::max(threads, 1U));
    }

    void post(std::packaged_task<void()> task, std::size_t samples) {
        if (broker) broker->post(std::move(task), samples);
        else boost::asio::post(*pool, std::move(task));
    }

    /// Outcomes of job(i) for each work, in their order; waits for all of them.
    template <class Job>
    auto run(const std::vector<Work>& works, const Job& job) {
        using Result = Outcome<decltype(job(std::size_t{}))>;
        std::vector<std::packaged_task<Result()>> tasks;
        std::vector<std::future<Result>> futures;
        for (std::size_t i = 0; i < works.size(); ++i) {
            tasks.emplace_back([&works, &job, i] { return attempt(works[i], [&job, i] { return job(i); }); });
            futures.push_back(tasks.back().get_future());
        }
        // The longest first, so that no thread is left with one at the end.
        for (const bool longest : {true, false})
            for (std::size_t i = 0; i < tasks.size(); ++i)
                if (works[i].request.family->variants.front().sums_series() == longest)
                    post(std::packaged_task<void()>(std::move(tasks[i])), works[i].channel.samples.size());
        for (auto& future : futures) future.wait();  // tasks refer to this call's arguments
        std::vector<Result> outcomes;
        for (auto& future : futures) outcomes.push_back(future.get());
        return outcomes;
    }

    std::unique_ptr<boost::asio::thread_pool> pool;
    std::optional<Broker> broker;
    std::mutex mutex;            ///< of what follows
    std::set<std::string> warm;  ///< submodels with a text of their own that have been built
};

Fitter::Fitter(kernels::Engine& engine, unsigned threads)
    : engine_(engine), costs_(engine), workers_(std::make_unique<Workers>(engine, threads)) {
    // Fits take the same memory again and again: giving it back and faulting it in costs a small one a tenth of its
    // time.
    constexpr int kKept = 32 << 20;  // bytes
    constexpr int kLargeBlock = 8 << 20;
    ::mallopt(M_TRIM_THRESHOLD, kKept);
    ::mallopt(M_MMAP_THRESHOLD, kLargeBlock);
}

Fitter::~Fitter() {
    if (workers_->pool) workers_->pool->join();
}

void Fitter::warm_up(const kernels::Family& family) {
    for (const Model& model : family.variants) warm_up(model);
}

void Fitter::warm_up(const kernels::Submodel& submodel) {
    for (const Model& model : submodel.variants) {
        const std::lock_guard lock(workers_->mutex);
        if (!workers_->warm.insert(model.name + ' ' + std::to_string(model.repeats)).second) continue;
        try {
            warm_up(model);
        } catch (const kernels::BuildError&) {  // the fit will tell
        }
    }
}

void Fitter::warm_up(const Model& model) {
    const std::vector<kernels::Direction> directions(1);
    const std::vector<double> one(1, 1.0);
    const auto run = [&](kernels::Precision precision, kernels::Accuracy accuracy) {
        kernels::Evaluator evaluator(engine_, model, precision, directions, one, one, accuracy);
        std::vector<double> parameters;
        for (const kernels::Parameter& p : model.parameters) parameters.push_back(p.typical_min);
        const std::vector<double> c(model.terms.size(), 1.0);
        kernels::Batch batch;
        evaluator.project(parameters, c, c, true, batch);
        evaluator.project(parameters, c, c, false, batch);
        evaluator.loss(parameters, c, false, batch);
        (void)evaluator.terms(parameters);
    };
    run(engine_.best_precision(), kernels::Accuracy::full);
    std::vector<double> parameters;
    for (const kernels::Parameter& p : model.parameters) parameters.push_back(p.typical_max);
    constexpr double kIncidence_deg[] = {45};
    (void)kernels::Hemisphere(engine_, model, albedo_precision(engine_, model)).albedo(parameters, kIncidence_deg, 0.1);
    if (model.begins_quickly()) run(engine_.quickest_precision(), model.first_accuracy());
}

Report Fitter::fit(const Dataset& dataset, const std::vector<ModelRequest>& models, const FitOptions& options,
                   std::stop_token stop, Progress* progress) {
    Report report{dataset.name,
                  dataset.unit,
                  options.seed,
                  engine_.device(),
                  options.precision.value_or(engine_.best_precision()),
                  {},
                  options.loss,
                  options.scene};
    if (const auto reason = engine_.refusal(report.precision)) throw kernels::PrecisionError(*reason);
    const SearchControl control{options.seed,
                                Clock::now() + std::chrono::duration_cast<Clock::duration>(options.time_limit),
                                std::move(stop), nullptr, options.ledger};
    std::vector<Channel> seen;
    std::vector<Form> forms;
    if (options.scene) {
        for (const Channel& channel : dataset.channels) seen.push_back(seen_by(*options.scene, channel));
        forms = with_simpler_forms(models);
    } else
        for (std::size_t i = 0; i < models.size(); ++i) forms.push_back({models[i], i});
    const std::vector<Channel>& channels = options.scene ? seen : dataset.channels;
    // Before anything runs: requests that cannot be met throw here, in the caller's thread.
    for (const Channel& channel : channels) {
        (void)weigh(channel, options.loss);
        for (const ModelRequest& model : models) (void)samples_needed(model, channel);
    }
    for (const Form& form : forms)
        if (form.model.submodel != nullptr) warm_up(*form.model.submodel);  // whole models are warm

    std::list<Directions> directions;
    std::list<NoiseOf> noises;  // one a channel
    std::vector<Work> works;    // channels x forms
    for (const Channel& channel : channels) {
        if (directions.empty() || !directions.back().are_of(channel)) directions.emplace_back(channel);
        noises.emplace_back(channel);
        for (const Form& form : forms) {
            works.push_back(
                {engine_, channel, directions.back(), noises.back(), dataset.unit, form.model, options, control});
            if (progress != nullptr) works.back().control.progress = &progress->add(channel.name, name_of(form.model));
        }
    }
    const bool robust = options.loss.robust != Robust::none;
    std::vector<Outcome<Beginning>> beginnings;
    std::vector<double> scales(channels.size(), HUGE_VAL);  // each common to the channel's models
    if (robust) {
        beginnings = workers_->run(works, [&](std::size_t i) { return begin_robustly(works[i]); });
        for (std::size_t i = 0; i < works.size(); ++i)
            if (beginnings[i].result)
                scales[i / forms.size()] = std::min(scales[i / forms.size()], beginnings[i].result->scale);
    }
    std::vector<Outcome<Fit>> outcomes = workers_->run(works, [&](std::size_t i) {
        TaskEnd end(works[i].control.progress);
        if (robust && !beginnings[i].result) throw SearchError(beginnings[i].failure.reason);
        Fit fit = robust ? fit_model(works[i], &*beginnings[i].result, scales[i / forms.size()])
                         : fit_model(works[i], nullptr, 0);
        end.relative_loss = fit.relative_loss;
        return fit;
    });
    for (std::size_t i = 0; i < beginnings.size(); ++i)
        if (!beginnings[i].result) outcomes[i].failure = beginnings[i].failure;
    for (std::size_t i = 0; i < outcomes.size(); ++i)
        if (outcomes[i].result) outcomes[i].result->form = i % forms.size();
    auto next = outcomes.begin();
    for (std::size_t c = 0; c < channels.size(); ++c) {
        const auto end = next + static_cast<std::ptrdiff_t>(forms.size());
        report.channels.push_back(rank(channels[c], options.rank_by,
                                       distinct(forms, {std::make_move_iterator(next), std::make_move_iterator(end)})));
        report.channels.back().noise = works[c * forms.size()].noise.get().record;
        if (std::isfinite(scales[c])) report.channels.back().robust_scale = scales[c];
        next = end;
    }
    if (options.judge) {
        add_costs(costs_, models, report);
        const Scene scene = options.scene.value_or(Scene{});
        for (ChannelReport& channel : report.channels) {
            judge_scene(scene, channel);
            // A fit may be far off in decades because nobody has asked it to be near.
            if (options.loss.kind != Loss::log && !channel.pareto.empty() &&
                channel.pareto.back().log10_rmse > scene.tolerance_log10)
                channel.recommended->reason += "; fits under the loss log, which counts decades, may be nearer";
        }
    }
    if (options.ledger) add_ledger(*this, dataset, models, options, control, report);
    return report;
}

}  // namespace brdfit::optim
