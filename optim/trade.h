/// What effort and precision buy, measured on datasets.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/model.h"
#include "optim/dataset.h"
#include "optim/search.h"

namespace brdfit::optim {

/// The arithmetic of a fit: the choices of the option `precision`, and single_alone: all in single precision, the
/// report too, as where a device has nothing else.
enum class Arithmetic { automatic, single_search, double_search, single_alone };

/// Fits of one model to one dataset, over seeds 1, 2, ...; one thread.
struct TradeCell {
    std::string dataset;
    std::string model;  ///< "lafortune (2)" with two lobes
    Effort effort{};
    Arithmetic arithmetic{};
    std::size_t seeds = 0;
    double wall_s = 0;       ///< median, of a whole fit without judging
    double cpu_s = 0;        ///< likewise, processor time
    double evaluations = 0;  ///< median
    double distance = 0;     ///< median of loss over the best known loss, less 1
    double worst = 0;        ///< largest of those
    double success = 0;      ///< part of the seeds that are within 1e-3
};

/// By how much single precision moves the parameters: the largest shift against double_search with the same seed, at
/// standard effort, over the seeds for which both are within 1e-4 of the best known.
struct PrecisionShift {
    std::string dataset;
    std::string model;
    Arithmetic arithmetic{};           ///< single_search or single_alone
    std::size_t seeds = 0;             ///< that could be compared; with none there is no parameter
    std::string parameter;             ///< that moves most, in standard errors where it has one
    std::optional<double> std_errors;  ///< its shift in units of its standard error
    std::optional<double> relative;    ///< ... and of itself; none if that is 0
};

/// Values of he_torrance at the fitted parameters and the data's directions, with series summed less far.
struct SeriesPoint {
    std::string dataset;
    kernels::Precision precision{};
    std::string accuracy;                 ///< "full", "search", or "dial" for log_epsilon
    std::optional<double> log_epsilon{};  ///< kernels/series.h
    double error = 0;  ///< largest relative one against full double precision, of values above 1e-12 of the largest
    double ns = 0;     ///< of an evaluation, on one core of a CPU
};

struct TradeBench {
    std::size_t seeds = 0;
    std::vector<TradeCell> cells;
    std::vector<PrecisionShift> shifts;
    std::vector<SeriesPoint> series;
};

/// Measures the first channel of each dataset with lambert, phong, ward, lafortune with two lobes and he_torrance, in
/// every arithmetic that may be used, with so many seeds (at least 1), of thorough searches a quarter, two at least.
/// The best known loss of a dataset and model is the least of all these fits. Throws std::runtime_error if a fit fails,
/// and what Fitter::fit throws.
TradeBench bench_trade(const kernels::EngineOptions& options, const kernels::Catalogue& catalogue,
                       const std::vector<Dataset>& datasets, std::size_t seeds);

}  // namespace brdfit::optim
