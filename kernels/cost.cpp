#include "kernels/cost.h"

#include <algorithm>
#include <array>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>

#include "kernels/geometry.h"
#include "kernels/load.h"
#include "kernels/stopwatch.h"
#include "kernels/throughput.h"
#include "kernels/transfers.h"

namespace brdfit::kernels {
namespace {

using Clock = std::chrono::steady_clock;

constexpr OperationCounts kCounts[] = {
#include "kernels/operation_counts.inc"
};

constexpr std::size_t kCandidates = 256;
/// Samples, and work-items, of a device that is not a CPU.
constexpr std::size_t kManySamples = 65536;
/// Launches that share the candidates of a slow model, so that each is short beside a scheduler's slices.
constexpr std::size_t kPartsOfSeries = 16;
/// Of a session: at least so many repetitions of each, over so long, ...
constexpr int kRepetitions = 8;
constexpr std::chrono::milliseconds kSession{200};
/// ... each with launches for so long.
constexpr std::chrono::milliseconds kRepetition{1};
/// A machine of which others have more than this part is loaded, ...
constexpr double kIdle = 0.1;
/// ... or one where the two halves of a session differ by more than this part.
constexpr double kSteady = 0.05;

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

/// An entry of the cache folder: a figure, and whether it was measured under load.
using Kept = std::array<unsigned char, sizeof(std::uint64_t) + 1>;

Kept packed(const MeasuredCost& cost) {
    Kept bytes{};
    const auto bits = std::bit_cast<std::uint64_t>(cost.ns);
    for (std::size_t i = 0; i < sizeof bits; ++i)
        bytes[i] = static_cast<unsigned char>(bits >> (8 * (sizeof bits - 1 - i)));
    bytes.back() = cost.under_load ? 1 : 0;
    return bytes;
}

std::optional<MeasuredCost> unpacked(const std::optional<std::vector<unsigned char>>& kept) {
    if (!kept || kept->size() != sizeof(Kept)) return std::nullopt;
    std::uint64_t bits = 0;
    for (std::size_t i = 0; i < sizeof bits; ++i) bits = bits << 8U | (*kept)[i];
    const MeasuredCost cost{std::bit_cast<double>(bits), kept->back() != 0};
    if (!(cost.ns > 0 && std::isfinite(cost.ns))) return std::nullopt;
    return cost;
}

CacheKey key_of(Engine::Impl& shared, const Model& model, Precision precision) {
    const ProgramSource source = shared.hemisphere_source(model, precision);
    return shared.builder->key("cost", source.text, source.flags);
}

}  // namespace

std::optional<OperationCounts> operation_counts(const Model& model) {
    const std::string label = model.repeats == 0 ? model.name : model.name + "_" + std::to_string(model.repeats);
    for (const OperationCounts& counts : kCounts)
        if (counts.model == label) return counts;
    return std::nullopt;
}

struct CostMeter::Impl : Transfers {
    Impl(Engine& engine, const Model& model, Precision precision_in) : Transfers(engine, precision_in) {
        const bool cpu = shared.info.type == "cpu";
        const std::size_t lanes = shared.lanes(precision);
        const std::vector<Direction> directions = goniometer_scan(cpu ? kLaunchSamples : kManySamples);
        const std::size_t padded = (directions.size() + lanes - 1) / lanes * lanes;
        items = cpu ? cpu_width() : padded / lanes;
        evaluations = static_cast<double>(padded * kCandidates);
        const std::size_t count = cpu && model.sums_series() ? kPartsOfSeries : 1;
        const std::vector<double> parameters = typical_candidates(model, kCandidates, 1);
        for (std::size_t part = 0; part < count; ++part) {
            std::vector<double> rows;
            for (std::size_t i = part * kCandidates / count; i < (part + 1) * kCandidates / count; ++i) {
                const auto begin = parameters.begin() + static_cast<std::ptrdiff_t>(i * model.parameters.size());
                const std::vector<double> p(begin, begin + static_cast<std::ptrdiff_t>(model.parameters.size()));
                const std::vector<double> c = model.coefficients(p);
                rows.insert(rows.end(), c.begin(), c.end());
                rows.insert(rows.end(), p.begin(), p.end());
            }
            parts.push_back(
                {constant_buffer(shared.context, precision, rows), std::numeric_limits<double>::infinity()});
        }
        value = cl::Kernel(shared.hemisphere_program(model, precision), "value");
        reserve(out, items);
        columns = constant_buffer(shared.context, precision, vector_columns(directions, padded));
        value.setArg(0, columns);
        value.setArg(1, static_cast<cl_int>(padded));
        value.setArg(2, static_cast<cl_int>(kCandidates / count));
        value.setArg(4, out);
    }

    struct Part {
        cl::Buffer in;
        double shortest_s;
    };
    std::vector<Part> parts;
    cl::Kernel value;
    cl::Buffer columns, out;  // arguments do not keep their buffers
    std::size_t items = 0;
    double evaluations = 0;
};

CostMeter::CostMeter(Engine& engine, const Model& model, Precision precision) try
    : impl_(std::make_unique<Impl>(engine, model, precision)) {
} catch (const cl::Error& error) {
    throw device_error(error);
}
CostMeter::~CostMeter() = default;
CostMeter::CostMeter(CostMeter&&) noexcept = default;
CostMeter& CostMeter::operator=(CostMeter&&) noexcept = default;

void CostMeter::repeat() try {
    Impl& m = *impl_;
    const auto end = Clock::now() + kRepetition;
    do
        for (Impl::Part& part : m.parts) {
            m.value.setArg(3, part.in);
            const double start = stopwatch_s(m.shared.info);
            m.queue.enqueueNDRangeKernel(m.value, cl::NullRange, cl::NDRange(m.items), cl::NDRange(1));
            m.queue.finish();
            part.shortest_s = std::min(part.shortest_s, stopwatch_s(m.shared.info) - start);
        }
    while (Clock::now() < end);
} catch (const cl::Error& error) {
    throw device_error(error);
}

double CostMeter::ns() const {
    double seconds = 0;
    for (const Impl::Part& part : impl_->parts) seconds += part.shortest_s;
    return 1e9 * seconds / impl_->evaluations;
}

std::vector<MeasuredCost> measure(Engine& engine, std::span<CostMeter> meters) {
    std::vector<double> halves(meters.size());
    for (CostMeter& meter : meters) meter.repeat();  // the first launch may compile
    const LoadWatch watch(engine.device());
    const auto start = Clock::now();
    for (int i = 0; i < kRepetitions || Clock::now() < start + kSession; ++i) {
        for (CostMeter& meter : meters) meter.repeat();
        if (i < kRepetitions / 2)
            for (std::size_t k = 0; k < meters.size(); ++k) halves[k] = meters[k].ns();
    }
    const bool loaded = watch.others() > kIdle;
    std::vector<MeasuredCost> costs;
    for (std::size_t k = 0; k < meters.size(); ++k)
        costs.push_back({meters[k].ns(), loaded || halves[k] > meters[k].ns() * (1 + kSteady)});
    return costs;
}

std::optional<CostBook::Entry> CostBook::known(const Key& key) const {
    const std::lock_guard lock(mutex_);
    const auto it = known_.find(key);
    if (it == known_.end()) return std::nullopt;
    return it->second;
}

/// From the folder, where another process may have settled it; else by a session for all. measuring_ is held.
void CostBook::measure(const std::vector<std::pair<Key, const Model*>>& wanted) {
    Engine::Impl& shared = engine_.impl();
    const auto keep = [&](const Key& key, const Model* model, const MeasuredCost& cost) {
        const std::lock_guard lock(mutex_);
        Entry& entry = known_.try_emplace(key, Entry{model, cost.ns, true}).first->second;
        entry.ns = std::min(entry.ns, cost.ns);
        entry.under_load = entry.under_load && cost.under_load;
        return MeasuredCost{entry.ns, entry.under_load};
    };
    std::vector<std::pair<Key, const Model*>> missing;
    std::vector<CostMeter> meters;
    for (const auto& [key, model] : wanted) {
        const auto kept = unpacked(shared.builder->cache().load(key_of(shared, *model, key.second)));
        if (kept && !keep(key, model, *kept).under_load) continue;
        meters.emplace_back(engine_, *model, key.second);
        missing.emplace_back(key, model);
    }
    if (missing.empty()) return;
    const std::vector<MeasuredCost> found = kernels::measure(engine_, meters);
    for (std::size_t i = 0; i < missing.size(); ++i) {
        const auto& [key, model] = missing[i];
        // Without a folder it holds for this process.
        (void)shared.builder->cache().store(key_of(shared, *model, key.second), packed(keep(key, model, found[i])));
    }
}

std::vector<Cost> CostBook::costs(std::span<const Model* const> models) {
    constexpr Precision kPrecisions[] = {Precision::single_precision, Precision::double_precision};
    const auto key_for = [](const Model& model, Precision precision) {
        return Key{variant_name(model.name, model.repeats), precision};
    };
    const auto missing = [&] {
        std::map<Key, const Model*> keys;
        for (const Model* model : models)
            for (const Precision precision : kPrecisions)
                if (const Key key = key_for(*model, precision); engine_.supports(precision) && !known(key))
                    keys.emplace(key, model);
        return std::vector<std::pair<Key, const Model*>>(keys.begin(), keys.end());
    };
    if (!missing().empty()) {
        const std::lock_guard lock(measuring_);
        if (const auto still = missing(); !still.empty()) measure(still);
    }
    std::vector<Cost> costs;
    for (const Model* model : models) {
        Cost& cost = costs.emplace_back();
        cost.operations = operation_counts(*model);
        for (const Precision precision : kPrecisions)
            if (const auto entry = known(key_for(*model, precision)); entry && engine_.supports(precision)) {
                (precision == Precision::single_precision ? cost.single_ns : cost.double_ns) = entry->ns;
                cost.under_load = cost.under_load || entry->under_load;
            }
    }
    return costs;
}

Cost CostBook::cost(const Model& model) {
    const Model* const one[] = {&model};
    return costs(one).front();
}

bool CostBook::settle() {
    const std::lock_guard lock(measuring_);
    const auto loaded = [&] {
        std::vector<std::pair<Key, const Model*>> keys;
        const std::lock_guard entries(mutex_);
        for (const auto& [key, entry] : known_)
            if (entry.under_load && engine_.supports(key.second)) keys.emplace_back(key, entry.model);
        return keys;
    };
    if (const auto keys = loaded(); !keys.empty()) measure(keys);
    return loaded().empty();
}

}  // namespace brdfit::kernels
