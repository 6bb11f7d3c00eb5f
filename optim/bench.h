/// Times of whole fits, on measurements that are made up for them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "kernels/model.h"
#include "optim/fit.h"

namespace brdfit::optim {

/// One size of request. Figures are medians over repetitions, each with a seed and a surface of its own.
struct FitTiming {
    std::string growth;  ///< what grows beside the neighbours: "models", "channels", "samples", "effort",
                         ///< "requests" or "judge"
    std::vector<std::string> models;
    std::size_t channels = 1;
    std::size_t samples = 500;  ///< of a channel
    Effort effort = Effort::standard;
    std::size_t requests = 1;  ///< at once
    bool judge = false;        ///< FitOptions::judge

    std::size_t repetitions = 0;
    double wall_s = 0;    ///< until all requests are answered
    double cpu_s = 0;     ///< processor time of all threads, of all requests
    double peak_MiB = 0;  ///< largest resident memory of the process meanwhile
};

/// Many small datasets, one after the other in each thread.
struct BatchTiming {
    std::size_t datasets = 0;
    std::size_t samples = 30;  ///< of a dataset
    double first_per_s = 0;    ///< datasets per second, over the first tenth
    double last_per_s = 0;     ///< ... and over the last
    double first_MiB = 0;      ///< resident memory after the first tenth
    double last_MiB = 0;       ///< ... and after the last
};

struct FitBench {
    unsigned threads = 0;  ///< of the fitter
    std::vector<FitTiming> timings;
    std::vector<BatchTiming> batches;
};

/// Processor time of all threads so far [s].
double cpu_seconds();
/// Of at least one value; the upper one of two middles.
double median(std::vector<double> values);

/// How much bench_fits repeats: brief: once, 20 datasets to a batch, 3000 samples at most; standard: 4 to 8 times, 1000
/// datasets; full: 4 to 24 times, 10000 datasets.
enum class BenchLength { brief, standard, full };

/// A goniometer's scan (kernels/throughput.h) of a made-up surface, with 2 % relative noise. Surfaces with seeds 0, 1,
/// 2 and 3 modulo 4 are of phong, ward, lafortune and he_torrance.
Dataset made_up(kernels::Engine& engine, const kernels::Catalogue& catalogue, std::size_t channels, std::size_t samples,
                std::uint64_t seed);

/// Times one growth, or "batch", or all ("") with phong, ward, lafortune with two lobes and he_torrance. Throws
/// std::invalid_argument for an unknown growth, std::runtime_error if a fit fails.
FitBench bench_fits(kernels::Engine& engine, const kernels::Catalogue& catalogue, unsigned threads,
                    const std::string& growth, BenchLength length);

}  // namespace brdfit::optim
