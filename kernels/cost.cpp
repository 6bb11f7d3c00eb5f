#include "kernels/cost.h"

#include <array>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstdint>

#include "kernels/geometry.h"
#include "kernels/stopwatch.h"
#include "kernels/throughput.h"
#include "kernels/transfers.h"

namespace brdfit::kernels {
namespace {

constexpr OperationCounts kCounts[] = {
#include "kernels/operation_counts.inc"
};

constexpr std::size_t kCandidates = 256;
constexpr std::chrono::milliseconds kEach{20};
/// Samples, and work-items, of a device that is not a CPU.
constexpr std::size_t kManySamples = 65536;

/// Columns of `value` in kernels/hemisphere.cl, padded by copies of the last sample.
std::vector<double> vector_columns(const std::vector<Direction>& directions, std::size_t padded) {
    std::vector<double> columns;
    columns.reserve(5 * padded);
    std::vector<std::array<long double, 5>> rows;
    for (const Direction& direction : directions) {
        const Angles a(canonical(direction));
        const long double sin_phi = std::sqrt((1 - a.cos_phi) * (1 + a.cos_phi));
        rows.push_back({a.sin_i, a.cos_i, a.sin_r * a.cos_phi, a.sin_r * sin_phi, a.cos_r});
    }
    for (std::size_t i = 0; i < 5; ++i)
        for (std::size_t j = 0; j < padded; ++j)
            columns.push_back(static_cast<double>(rows[std::min(j, rows.size() - 1)][i]));
    return columns;
}

}  // namespace

std::optional<OperationCounts> operation_counts(const Model& model) {
    const std::string label = model.repeats == 0 ? model.name : model.name + "_" + std::to_string(model.repeats);
    for (const OperationCounts& counts : kCounts)
        if (counts.model == label) return counts;
    return std::nullopt;
}

double measure_cost_ns(Engine& engine, const Model& model, Precision precision) try {
    Transfers transfers(engine, precision);
    const Engine::Impl& shared = engine.impl();
    const bool cpu = shared.info.type == "cpu";
    const std::size_t lanes = shared.lanes(precision);
    const std::vector<Direction> directions = goniometer_scan(cpu ? kLaunchSamples : kManySamples);
    const std::size_t padded = (directions.size() + lanes - 1) / lanes * lanes;
    const std::size_t items = cpu ? transfers.cpu_width() : padded / lanes;
    const std::vector<double> parameters = typical_candidates(model, kCandidates, 1);
    std::vector<double> rows;
    for (std::size_t i = 0; i < kCandidates; ++i) {
        const auto begin = parameters.begin() + static_cast<std::ptrdiff_t>(i * model.parameters.size());
        const std::vector<double> p(begin, begin + static_cast<std::ptrdiff_t>(model.parameters.size()));
        const std::vector<double> c = model.coefficients(p);
        rows.insert(rows.end(), c.begin(), c.end());
        rows.insert(rows.end(), p.begin(), p.end());
    }
    const cl::Program program = engine.impl().hemisphere_program(model, precision);
    cl::Kernel value(program, "value");
    cl::Buffer out;
    transfers.reserve(out, items);
    // Arguments do not keep their buffers.
    const cl::Buffer columns = constant_buffer(shared.context, precision, vector_columns(directions, padded));
    const cl::Buffer in = constant_buffer(shared.context, precision, rows);
    value.setArg(0, columns);
    value.setArg(1, static_cast<cl_int>(padded));
    value.setArg(2, static_cast<cl_int>(kCandidates));
    value.setArg(3, in);
    value.setArg(4, out);
    const double seconds = shortest_s(shared.info, kEach, [&] {
        transfers.queue.enqueueNDRangeKernel(value, cl::NullRange, cl::NDRange(items), cl::NDRange(1));
        transfers.queue.finish();
    });
    return 1e9 * seconds / static_cast<double>(padded * kCandidates);
} catch (const cl::Error& error) {
    throw device_error(error);
}

Cost CostBook::cost(const Model& model) {
    return {nanoseconds(model, Precision::single_precision), nanoseconds(model, Precision::double_precision),
            operation_counts(model)};
}

std::optional<double> CostBook::nanoseconds(const Model& model, Precision precision) {
    const std::lock_guard lock(mutex_);
    if (!engine_.supports(precision)) return std::nullopt;
    const auto [it, is_new] = known_.try_emplace({variant_name(model.name, model.repeats), precision}, 0.0);
    if (!is_new) return it->second;
    try {
        Engine::Impl& shared = engine_.impl();
        const ProgramSource source = shared.hemisphere_source(model, precision);
        const CacheKey key = shared.builder->key("cost", source.text, source.flags);
        const auto kept = shared.builder->cache().load(key);
        if (kept && kept->size() == sizeof(std::uint64_t)) {
            std::uint64_t bits = 0;
            for (const unsigned char byte : *kept) bits = bits << 8U | byte;
            it->second = std::bit_cast<double>(bits);
        }
        if (!(it->second > 0 && std::isfinite(it->second))) {
            it->second = measure_cost_ns(engine_, model, precision);
            std::array<unsigned char, sizeof(std::uint64_t)> bytes{};
            const auto bits = std::bit_cast<std::uint64_t>(it->second);
            for (std::size_t i = 0; i < bytes.size(); ++i)
                bytes[i] = static_cast<unsigned char>(bits >> (8 * (bytes.size() - 1 - i)));
            (void)shared.builder->cache().store(key, bytes);  // without a folder it holds for this process
        }
        return it->second;
    } catch (...) {
        known_.erase(it);
        throw;
    }
}

}  // namespace brdfit::kernels
