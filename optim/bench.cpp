#include "optim/bench.h"

#include <malloc.h>
#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <ctime>
#include <fstream>
#include <future>
#include <random>

#include "kernels/evaluator.h"
#include "kernels/throughput.h"

namespace brdfit::optim {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kNoise = 0.02;
constexpr double kWavelength_nm = 550;

/// Surfaces as they are measured: each parameter between two values, in the order of its model.
struct Surface {
    const char* model;
    std::size_t lobes;
    std::vector<Interval> parameters;
};

const std::vector<Surface>& surfaces() {
    static const std::vector<Surface> all{
        {"phong", 1, {{0.05, 0.5}, {0.05, 0.5}, {5, 300}}},
        {"ward", 1, {{0.05, 0.5}, {0.05, 0.5}, {0.05, 0.5}}},
        {"lafortune", 2, {{0.05, 0.5}, {-1.02, -0.95}, {0.9, 1}, {20, 100}, {-0.8, -0.6}, {0.3, 0.6}, {2, 8}}},
        {"he_torrance", 1, {{0.1, 0.6}, {1, 6}, {1.3, 2.5}, {0, 4}, {0.05, 0.4}}},
    };
    return all;
}

std::vector<ModelRequest> requests_for(const kernels::Catalogue& catalogue, const std::vector<std::string>& models) {
    std::vector<ModelRequest> requests;
    for (const std::string& name : models) {
        ModelRequest& request = requests.emplace_back();
        request.family = catalogue.find(name);
        if (request.family->repeat) request.lobes = 2;
    }
    return requests;
}

/// A line of /proc/self/status [MiB]; 0 where there is none.
double memory_MiB(const std::string& name) {
    std::ifstream status("/proc/self/status");
    for (std::string word; status >> word;)
        if (word == name + ":") {
            double KiB = 0;
            status >> KiB;
            return KiB / 1024;
        }
    return 0;
}

/// Gives back what earlier requests have freed; Linux then counts the peak (VmHWM) from here.
void forget_peak() {
    ::malloc_trim(0);
    std::ofstream("/proc/self/clear_refs") << "5";
}

class Bench {
public:
    Bench(kernels::Engine& engine, const kernels::Catalogue& catalogue, unsigned threads, BenchLength length)
        : engine_(engine), catalogue_(catalogue), threads_(threads), length_(length), fitter_(engine, threads) {
        for (const Surface& surface : surfaces()) {
            models_.emplace_back(surface.model);
            fitter_.warm_up(*catalogue.find(surface.model));
        }
    }

    void time(FitTiming& timing) {
        if (timing.models.empty()) timing.models = models_;
        const auto models = requests_for(catalogue_, timing.models);
        std::vector<double> wall, cpu, peak;
        const std::size_t most = length_ == BenchLength::brief ? 1 : length_ == BenchLength::standard ? 8 : 24;
        const std::size_t least = std::min<std::size_t>(most, 4);  // each surface once
        double spent = 0;
        while (wall.size() < least || (wall.size() < most && spent < 20)) {
            const std::uint64_t seed = wall.size();
            std::vector<Dataset> datasets;
            for (std::size_t i = 0; i < timing.requests; ++i)
                datasets.push_back(made_up(engine_, catalogue_, timing.channels, timing.samples, seed + i));
            forget_peak();
            const double cpu_start = cpu_seconds();
            const auto start = Clock::now();
            std::vector<std::future<void>> answers;
            for (const Dataset& dataset : datasets)
                answers.push_back(std::async(std::launch::async,
                                             [&, seed] { fit(dataset, models, timing.effort, timing.judge, seed); }));
            for (auto& answer : answers) answer.get();
            wall.push_back(std::chrono::duration<double>(Clock::now() - start).count());
            cpu.push_back(cpu_seconds() - cpu_start);
            peak.push_back(memory_MiB("VmHWM"));
            spent += wall.back();
        }
        timing.repetitions = wall.size();
        timing.wall_s = median(wall);
        timing.cpu_s = median(cpu);
        timing.peak_MiB = median(peak);
    }

    void time(BatchTiming& batch) {
        forget_peak();
        batch.datasets = length_ == BenchLength::brief ? 20 : length_ == BenchLength::standard ? 1000 : 10000;
        const auto models = requests_for(catalogue_, {"phong", "ward"});
        const std::size_t tenth = batch.datasets / 10;
        std::atomic<std::size_t> next = 0;
        const auto answer = [&](std::size_t end) {
            const auto start = Clock::now();
            const std::size_t begin = next;
            std::vector<std::future<void>> clients;
            for (unsigned client = 0; client < threads_; ++client)
                clients.push_back(std::async(std::launch::async, [&] {
                    for (std::size_t i = next++; i < end; i = next++)
                        fit(made_up(engine_, catalogue_, 1, batch.samples, i), models, Effort::standard, false, i);
                }));
            for (auto& client : clients) client.get();
            next = end;
            return static_cast<double>(end - begin) / std::chrono::duration<double>(Clock::now() - start).count();
        };
        batch.first_per_s = answer(tenth);
        batch.first_MiB = memory_MiB("VmRSS");
        (void)answer(batch.datasets - tenth);
        batch.last_per_s = answer(batch.datasets);
        batch.last_MiB = memory_MiB("VmRSS");
    }

    [[nodiscard]] const std::vector<std::string>& models() const { return models_; }

private:
    void fit(const Dataset& dataset, const std::vector<ModelRequest>& models, Effort effort, bool judge,
             std::uint64_t seed) {
        FitOptions options;
        options.judge = judge;
        options.effort = effort;
        options.seed = seed;
        options.time_limit = std::chrono::hours(1);
        for (const ChannelReport& channel : fitter_.fit(dataset, models, options).channels)
            if (!channel.failures.empty())
                throw std::runtime_error(channel.failures[0].model + ": " + channel.failures[0].detail);
    }

    kernels::Engine& engine_;
    const kernels::Catalogue& catalogue_;
    unsigned threads_;
    BenchLength length_;
    Fitter fitter_;
    std::vector<std::string> models_;
};

}  // namespace

double cpu_seconds() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

double median(std::vector<double> values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

Dataset made_up(kernels::Engine& engine, const kernels::Catalogue& catalogue, std::size_t channels, std::size_t samples,
                std::uint64_t seed) {
    const Surface& surface = surfaces()[seed % surfaces().size()];
    const kernels::Model& model = catalogue.find(surface.model)->variant(surface.lobes);
    std::mt19937_64 generator(seed);
    Dataset dataset{"made up", Unit::per_steradian, {}};
    const std::vector<kernels::Direction> directions = kernels::goniometer_scan(samples);
    for (std::size_t c = 0; c < channels; ++c) {
        std::vector<double> parameters;
        for (const Interval& range : surface.parameters)
            parameters.push_back(std::uniform_real_distribution<double>(range.min, range.max)(generator));
        const std::vector<double> f =
            kernels::evaluate(engine, model, engine.best_precision(), parameters, directions, false).f;
        std::normal_distribution<double> noise(1, kNoise);
        Channel channel{"channel " + std::to_string(c + 1), kWavelength_nm, {}};
        for (std::size_t j = 0; j < f.size(); ++j)
            channel.samples.push_back({directions[j], f[j] * noise(generator), {}});
        dataset.channels.push_back(std::move(channel));
    }
    return dataset;
}

FitBench bench_fits(kernels::Engine& engine, const kernels::Catalogue& catalogue, unsigned threads,
                    const std::string& growth, BenchLength length) {
    Bench bench(engine, catalogue, threads, length);
    FitBench result{threads, {}, {}};
    const auto add = [&](const char* what, auto member, const auto& values) {
        if (!growth.empty() && growth != what) return;
        for (const auto& value : values) {
            FitTiming timing;
            timing.growth = what;
            timing.*member = value;
            result.timings.push_back(std::move(timing));
        }
    };
    std::vector<std::vector<std::string>> sets;  // each model alone, then one more at a time
    for (const std::string& model : bench.models()) sets.push_back({model});
    for (std::size_t i = 2; i <= bench.models().size(); ++i)
        sets.emplace_back(bench.models().begin(), bench.models().begin() + static_cast<std::ptrdiff_t>(i));
    using Counts = std::vector<std::size_t>;
    add("models", &FitTiming::models, sets);
    add("channels", &FitTiming::channels, Counts{1, 2, 4, 8, 16, 31});
    add("effort", &FitTiming::effort, std::vector{Effort::draft, Effort::standard, Effort::thorough});
    add("judge", &FitTiming::judge, std::array{false, true});
    add("requests", &FitTiming::requests, Counts{1, 2, 4, 8});
    add("samples", &FitTiming::samples,
        length == BenchLength::brief ? Counts{30, 100, 300, 1000, 3000}
                                     : Counts{30, 100, 300, 1000, 3000, 10000, 30000, 100000});
    for (FitTiming& timing : result.timings) bench.time(timing);
    if (growth.empty() || growth == "batch") bench.time(result.batches.emplace_back());
    if (result.timings.empty() && result.batches.empty())
        throw std::invalid_argument("no growth \"" + growth +
                                    "\"; there are models, channels, samples, effort, judge, requests, batch");
    return result;
}

}  // namespace brdfit::optim
