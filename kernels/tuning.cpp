#include "kernels/tuning.h"

#include <algorithm>
#include <cmath>
#include <ctime>
#include <limits>

#include "kernels/engine_impl.h"
#include "kernels/evaluator.h"

namespace brdfit::kernels {
namespace {

/// What a search evaluates at a time, on a scan of five incidence angles.
constexpr std::size_t kCandidates = 16;
constexpr int kRepetitions = 40;

double thread_time_us() {
    timespec time{};
    ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);  // others may load the machine
    return 1e6 * static_cast<double>(time.tv_sec) + 1e-3 * static_cast<double>(time.tv_nsec);
}

double candidate_time_us(Engine& engine, const Model& model, Precision precision) {
    std::vector<Direction> directions;
    for (const double theta_i_deg : {5.0, 20.0, 35.0, 50.0, 65.0})
        for (int i = 0; i < 36; ++i) directions.push_back({theta_i_deg, -87.5 + 5.0 * i, 0});
    const std::vector<double> measured(directions.size(), 0.3);
    const std::vector<double> weights(directions.size(), 1.0);
    Evaluator evaluator(engine, model, precision, directions, measured, weights);
    std::vector<double> parameters;
    for (std::size_t i = 0; i < kCandidates; ++i) {
        const double at = (static_cast<double>(i) + 0.5) / kCandidates;
        for (const Parameter& p : model.parameters)
            parameters.push_back(p.scale == Scale::logarithmic
                                     ? p.typical_min * std::pow(p.typical_max / p.typical_min, at)
                                     : p.typical_min + at * (p.typical_max - p.typical_min));
    }
    const std::vector<double> lower(kCandidates * model.terms.size(), 0.0);
    const std::vector<double> upper(kCandidates * model.terms.size(), 10.0);
    Batch batch;
    double least = std::numeric_limits<double>::infinity();
    for (int i = 0; i < kRepetitions; ++i) {
        const double begin = thread_time_us();
        evaluator.project(parameters, lower, upper, true, batch);
        least = std::min(least, thread_time_us() - begin);
    }
    return least / kCandidates;
}

CacheKey key_of(const ProgramBuilder& builder, Precision precision) {
    return builder.key("lanes", precision == Precision::double_precision ? "double" : "single", "");
}

}  // namespace

unsigned choose_lanes(unsigned native, std::span<const LanesTiming> timings) {
    const auto slower = [](const LanesTiming& a, const LanesTiming& b) { return a.time_us < b.time_us; };
    const auto fastest = std::min_element(timings.begin(), timings.end(), slower);
    const auto known =
        std::find_if(timings.begin(), timings.end(), [=](const LanesTiming& t) { return t.lanes == native; });
    if (known == timings.end() || known->time_us <= kClearly * fastest->time_us) return native;
    return fastest->lanes;
}

std::optional<unsigned> kept_lanes(const ProgramBuilder& builder, Precision precision) {
    const auto kept = builder.cache().load(key_of(builder, precision));
    if (!kept || kept->size() != 1 ||
        std::find(std::begin(kLanes), std::end(kLanes), kept->front()) == std::end(kLanes))
        return std::nullopt;
    return kept->front();
}

std::vector<Tuning> tune(const EngineOptions& options, std::span<const Family> families) {
    std::vector<Tuning> tunings;
    const Engine engine(options);
    if (engine.device().type != "cpu") return tunings;
    std::vector<Precision> precisions;
    for (const Precision precision : {Precision::double_precision, Precision::single_precision})
        if (engine.supports(precision)) {
            precisions.push_back(precision);
            tunings.push_back({precision, engine.impl().native_lanes(precision), 1, {}, false});
        }
    for (const unsigned lanes : kLanes) {
        EngineOptions fixed = options;
        fixed.lanes = lanes;
        Engine candidate(fixed);
        candidate.build_ahead(families, precisions);
        for (Tuning& tuning : tunings) {
            double sum = 0;
            for (const Family& family : families)
                sum += std::log(candidate_time_us(candidate, family.variants.back(), tuning.precision));
            tuning.timings.push_back({lanes, std::exp(sum / static_cast<double>(families.size()))});
        }
    }
    for (Tuning& tuning : tunings) {
        tuning.chosen = choose_lanes(tuning.native, tuning.timings);
        const auto byte = static_cast<unsigned char>(tuning.chosen);
        const ProgramBuilder& builder = *engine.impl().builder;
        tuning.kept = builder.cache().store(key_of(builder, tuning.precision), {&byte, 1});
    }
    return tunings;
}

}  // namespace brdfit::kernels
