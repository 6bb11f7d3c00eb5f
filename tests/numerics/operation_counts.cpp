#include "tests/numerics/operation_counts.h"

#include <cmath>
#include <cstdio>
#include <stdexcept>

#include "kernels/geometry.h"
#include "kernels/throughput.h"
#include "tests/numerics/counted.h"
#include "tests/support.h"

namespace brdfit::tests {

std::string operation_counts_table() {
    constexpr std::size_t kCandidates = 32;
    std::string table = "// Generated: build/tests/operation_counts_generator kernels/operation_counts.inc\n";
    const std::vector<kernels::Direction> directions = kernels::goniometer_scan(kernels::kLaunchSamples);
    for (const CountedKernel& counted : counted_kernels()) {
        const kernels::Model& model = variant(std::string(counted.label));
        const std::vector<double> all = kernels::typical_candidates(model, kCandidates, 1);
        double counts[6] = {};
        for (std::size_t i = 0; i < kCandidates; ++i) {
            const auto begin = all.begin() + static_cast<std::ptrdiff_t>(i * model.parameters.size());
            const std::vector<double> p(begin, begin + static_cast<std::ptrdiff_t>(model.parameters.size()));
            const std::vector<double> c = model.coefficients(p);
            for (const kernels::Direction& direction : directions) {
                const kernels::Angles a(canonical(direction));
                const std::vector<double> vectors{static_cast<double>(a.sin_i), static_cast<double>(a.cos_i),
                                                  static_cast<double>(a.sin_r), 0, static_cast<double>(a.cos_r)};
                if (!std::isfinite(counted.value(p, c, vectors, counts)))
                    throw std::runtime_error("no number from " + std::string(counted.label));
            }
        }
        char line[200];
        const auto mean = [&](Operation operation) {
            return counts[static_cast<std::size_t>(operation)] / static_cast<double>(kCandidates * directions.size());
        };
        std::snprintf(line, sizeof(line), "{\"%s\", %.1f, %.1f, %.1f, %.1f, %.1f},\n", counted.label.data(),
                      mean(Operation::add), mean(Operation::multiply), mean(Operation::fma), mean(Operation::divide),
                      mean(Operation::sqrt));
        table += line;
    }
    return table;
}

}  // namespace brdfit::tests
