#include "optim/trade.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <stdexcept>
#include <utility>

#include "kernels/evaluator.h"
#include "kernels/series.h"
#include "kernels/stopwatch.h"
#include "optim/bench.h"
#include "optim/fit.h"
#include "optim/ledger.h"
#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using kernels::Accuracy;
using kernels::Precision;

/// A loss that is further above the best known is a failure.
constexpr double kSuccess = 1e-3;
/// Within so much two fits are of the same minimum.
constexpr double kSameMinimum = 1e-4;
/// Values below this part of the largest do not count for errors of series: single precision may have none for them.
constexpr double kSeen = 1e-12;
/// Eps of series, as ln(1/eps).
constexpr double kDial[] = {6, 8, 11, 14, 17, 22, 28, 34};
constexpr std::size_t kCandidates = 64;
constexpr std::chrono::milliseconds kEach{80};

struct Named {
    const char* family;
    std::size_t lobes;
};
constexpr Named kModels[] = {{"lambert", 0}, {"phong", 0}, {"ward", 0}, {"lafortune", 2}, {"he_torrance", 0}};

struct Setting {
    Effort effort;
    Arithmetic arithmetic;
    bool operator<(const Setting& other) const {
        return std::pair(effort, arithmetic) < std::pair(other.effort, other.arithmetic);
    }
};

struct Run {
    Fit fit;
    double loss = 0;  ///< of the fit's parameters, in the best precision
    double wall_s = 0;
    double cpu_s = 0;
};

class Trade {
public:
    Trade(const kernels::EngineOptions& options, const kernels::Catalogue& catalogue, std::size_t seeds)
        : options_(options), catalogue_(catalogue), engine_(options), fitter_(engine_, 1) {
        result_.seeds = seeds;
        arithmetics_ = {Arithmetic::automatic};
        if (engine_.supports(Precision::single_precision) && engine_.supports(Precision::double_precision)) {
            arithmetics_.insert(arithmetics_.end(), {Arithmetic::single_search, Arithmetic::double_search});
            single_engine_ = std::make_unique<kernels::Engine>(options);
            single_engine_->withdraw(Precision::double_precision, "measured without");
            single_fitter_ = std::make_unique<Fitter>(*single_engine_, 1);
            arithmetics_.push_back(Arithmetic::single_alone);
        }
        for (const Named& model : kModels) {
            fitter_.warm_up(*catalogue.find(model.family));
            if (single_fitter_) single_fitter_->warm_up(*catalogue.find(model.family));
        }
    }

    void measure(const Dataset& whole) {
        Dataset dataset = whole;
        dataset.channels.resize(1);
        for (const Named& named : kModels) {
            ModelRequest model;
            model.family = catalogue_.find(named.family);
            if (named.lobes > 0) model.lobes = named.lobes;
            const Fit best = measure(dataset, model);
            if (model.variant(named.lobes).sums_series() && engine_.supports(Precision::double_precision))
                measure_series(dataset, model, parameters_of(best, model.variant(named.lobes), dataset));
        }
    }

    [[nodiscard]] TradeBench result() && { return std::move(result_); }

private:
    /// The best fit.
    Fit measure(const Dataset& dataset, const ModelRequest& model) {
        std::map<Setting, std::vector<Run>> runs;
        for (const Arithmetic arithmetic : arithmetics_)
            for (const Effort effort : {Effort::draft, Effort::standard, Effort::thorough}) {
                const bool thorough = effort == Effort::thorough;
                const std::size_t seeds = thorough ? std::max<std::size_t>(2, result_.seeds / 4) : result_.seeds;
                for (std::size_t seed = 1; seed <= seeds; ++seed)
                    runs[{effort, arithmetic}].push_back(run(dataset, model, {effort, arithmetic}, seed));
            }
        const Run* best = &runs.begin()->second.front();
        for (const auto& [setting, of_seeds] : runs)
            for (const Run& run : of_seeds)
                if (run.loss < best->loss) best = &run;
        const std::string name = kernels::variant_name(best->fit.model, best->fit.lobes);
        for (const auto& [setting, of_seeds] : runs)
            result_.cells.push_back(cell(dataset.name, name, setting, of_seeds, best->loss));
        if (arithmetics_.size() > 1)
            for (const Arithmetic arithmetic : {Arithmetic::single_search, Arithmetic::single_alone})
                result_.shifts.push_back(shift(dataset.name, name, arithmetic, runs[{Effort::standard, arithmetic}],
                                               runs[{Effort::standard, Arithmetic::double_search}], best->loss));
        return best->fit;
    }

    Run run(const Dataset& dataset, const ModelRequest& model, Setting setting, std::size_t seed) {
        FitOptions options;
        options.effort = setting.effort;
        options.seed = seed;
        options.judge = false;
        options.time_limit = std::chrono::hours(1);
        if (setting.arithmetic == Arithmetic::single_search) options.precision = Precision::single_precision;
        if (setting.arithmetic == Arithmetic::double_search) options.precision = Precision::double_precision;
        Fitter& fitter = setting.arithmetic == Arithmetic::single_alone ? *single_fitter_ : fitter_;
        Run run;
        const double cpu_start = cpu_seconds();
        const auto start = std::chrono::steady_clock::now();
        ChannelReport channel = std::move(fitter.fit(dataset, {model}, options).channels.front());
        run.wall_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
        run.cpu_s = cpu_seconds() - cpu_start;
        if (channel.fits.empty())
            throw std::runtime_error(channel.failures.front().model + ": " + channel.failures.front().detail);
        run.fit = std::move(channel.fits.front());
        const kernels::Model& variant = model.variant(run.fit.lobes);
        std::vector<double> f = kernels::evaluate(engine_, variant, engine_.best_precision(),
                                                  parameters_of(run.fit, variant, dataset), directions(dataset), false)
                                    .f;
        for (double& value : f) value *= run.fit.scale.value_or(1);
        run.loss = std::sqrt(residuals(weigh(dataset.channels.front(), options.loss), f).loss2);
        return run;
    }

    static TradeCell cell(const std::string& dataset, const std::string& model, Setting setting,
                          const std::vector<Run>& runs, double best) {
        std::vector<double> wall, cpu, evaluations, distances;
        for (const Run& run : runs) {
            wall.push_back(run.wall_s);
            cpu.push_back(run.cpu_s);
            evaluations.push_back(static_cast<double>(run.fit.search.evaluations));
            distances.push_back(distance(run, best));
        }
        const auto good = std::count_if(distances.begin(), distances.end(), [](double d) { return d <= kSuccess; });
        return {dataset,
                model,
                setting.effort,
                setting.arithmetic,
                runs.size(),
                median(wall),
                median(cpu),
                median(evaluations),
                median(distances),
                *std::max_element(distances.begin(), distances.end()),
                static_cast<double>(good) / static_cast<double>(runs.size())};
    }

    static PrecisionShift shift(const std::string& dataset, const std::string& model, Arithmetic arithmetic,
                                const std::vector<Run>& runs, const std::vector<Run>& references, double best) {
        PrecisionShift result{dataset, model, arithmetic, 0, {}, {}, {}};
        for (std::size_t i = 0; i < runs.size(); ++i) {
            if (distance(runs[i], best) > kSameMinimum || distance(references[i], best) > kSameMinimum) continue;
            ++result.seeds;
            const auto moved = largest_shift(references[i].fit, runs[i].fit);
            if (!moved || (!result.parameter.empty() && std::pair(moved->std_errors, moved->relative) <=
                                                            std::pair(result.std_errors, result.relative)))
                continue;
            result.parameter = moved->parameter;
            result.std_errors = moved->std_errors;
            result.relative = moved->relative;
        }
        return result;
    }

    void measure_series(const Dataset& dataset, const ModelRequest& model, const std::vector<double>& parameters) {
        const kernels::Model& variant = model.variant(0);
        const std::vector<double> exact =
            values(engine_, variant, Precision::double_precision, Accuracy::full, dataset, parameters);
        const double seen = kSeen * *std::max_element(exact.begin(), exact.end());
        const auto add = [&](kernels::Engine& engine, Precision precision, Accuracy accuracy, const char* name,
                             std::optional<double> log_epsilon) {
            SeriesPoint point{dataset.name, precision, name, log_epsilon, 0, 0};
            const std::vector<double> f = values(engine, variant, precision, accuracy, dataset, parameters);
            for (std::size_t j = 0; j < f.size(); ++j)
                if (exact[j] > seen) point.error = std::max(point.error, std::abs(f[j] / exact[j] - 1));
            point.ns = nanoseconds(engine, variant, precision, accuracy, dataset, parameters);
            result_.series.push_back(std::move(point));
        };
        for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
            if (!engine_.supports(precision)) continue;
            add(engine_, precision, Accuracy::full, "full", {});
            add(engine_, precision, Accuracy::search, "search", {});
        }
        for (const double log_epsilon : kDial) {
            std::unique_ptr<kernels::Engine>& engine = dialled_[log_epsilon];
            if (!engine) {
                kernels::EngineOptions options = options_;
                options.build_options += " " + kernels::series_options(log_epsilon);
                engine = std::make_unique<kernels::Engine>(options);
            }
            add(*engine, Precision::double_precision, Accuracy::full, "dial", log_epsilon);
        }
    }

    static std::vector<double> values(kernels::Engine& engine, const kernels::Model& model, Precision precision,
                                      Accuracy accuracy, const Dataset& dataset,
                                      const std::vector<double>& parameters) {
        kernels::Evaluator evaluator(engine, model, precision, directions(dataset), {}, {}, accuracy);
        const std::vector<double> rows = evaluator.terms(parameters);
        const std::vector<double> c = model.coefficients(parameters);
        std::vector<double> f(evaluator.samples());
        std::size_t row = 0;
        for (std::size_t t = 0; t < model.terms.size(); ++t) {
            for (std::size_t j = 0; j < f.size(); ++j) f[j] += c[t] * rows[row * f.size() + j];
            row += 1 + model.terms[t].of.size();
        }
        return f;
    }

    /// Of the loss without gradient, of equal candidates.
    static double nanoseconds(kernels::Engine& engine, const kernels::Model& model, Precision precision,
                              Accuracy accuracy, const Dataset& dataset, const std::vector<double>& parameters) {
        const Weighted weighted = weigh(dataset.channels.front(), Criterion{});
        kernels::Evaluator evaluator(engine, model, precision, directions(dataset), weighted.y, weighted.weight,
                                     accuracy);
        const std::vector<double> c = model.coefficients(parameters);
        std::vector<double> many, bounds;
        for (std::size_t i = 0; i < kCandidates; ++i) {
            many.insert(many.end(), parameters.begin(), parameters.end());
            bounds.insert(bounds.end(), c.begin(), c.end());
        }
        kernels::Batch batch;
        const double time_s =
            kernels::shortest_s(engine.device(), kEach, [&] { evaluator.project(many, bounds, bounds, false, batch); });
        return 1e9 * time_s / static_cast<double>(kCandidates * evaluator.samples());
    }

    static double distance(const Run& run, double best) { return best > 0 ? run.loss / best - 1 : 0; }

    /// In the model's unit.
    static std::vector<double> parameters_of(const Fit& fit, const kernels::Model& model, const Dataset& dataset) {
        std::vector<double> parameters;
        for (std::size_t i = 0; i < fit.parameters.size(); ++i)
            parameters.push_back(fit.parameters[i].value *
                                 to_model_unit(model.parameters[i], dataset.channels.front()));
        return parameters;
    }

    static std::vector<kernels::Direction> directions(const Dataset& dataset) {
        std::vector<kernels::Direction> result;
        for (const Sample& sample : dataset.channels.front().samples) result.push_back(sample.direction);
        return result;
    }

    kernels::EngineOptions options_;
    const kernels::Catalogue& catalogue_;
    kernels::Engine engine_;
    Fitter fitter_;
    std::unique_ptr<kernels::Engine> single_engine_;
    std::unique_ptr<Fitter> single_fitter_;
    std::vector<Arithmetic> arithmetics_;
    std::map<double, std::unique_ptr<kernels::Engine>> dialled_;
    TradeBench result_;
};

}  // namespace

TradeBench bench_trade(const kernels::EngineOptions& options, const kernels::Catalogue& catalogue,
                       const std::vector<Dataset>& datasets, std::size_t seeds) {
    Trade trade(options, catalogue, seeds);
    for (const Dataset& dataset : datasets) trade.measure(dataset);
    return std::move(trade).result();
}

}  // namespace brdfit::optim
