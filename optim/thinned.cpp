#include "optim/thinned.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>

namespace brdfit::optim {

Thinned thinned(const Weighted& all, std::span<const kernels::Direction> directions, std::size_t to,
                std::uint64_t seed) {
    const std::size_t n = all.y.size();
    std::vector<double> share(n);
    double energy = 0;
    for (std::size_t j = 0; j < n; ++j) energy += all.weight[j] * all.y[j] * all.y[j];
    for (std::size_t j = 0; j < n; ++j)
        share[j] = 0.5 / static_cast<double>(n) +
                   (energy > 0 ? 0.5 * all.weight[j] * all.y[j] * all.y[j] / energy : 0.5 / static_cast<double>(n));
    std::vector<std::size_t> order(n);
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::mt19937_64 random(seed);
    std::shuffle(order.begin(), order.end(), random);  // a regular grid of directions must not meet regular draws
    Thinned result;
    result.data.norm = all.norm;
    result.data.logarithmic = all.logarithmic;
    double sum = 0.5;
    std::vector<double> drawn(n, 0.0);
    for (const std::size_t j : order) {
        const double expected = share[j] * static_cast<double>(to);
        const double before = std::floor(sum);
        sum += expected;
        drawn[j] = (std::floor(sum) - before) / expected;
    }
    // In their own order: neighbours are alike, and alike is what a vector of samples should be.
    for (std::size_t j = 0; j < n; ++j) {
        if (!(drawn[j] > 0)) continue;
        result.directions.push_back(directions[j]);
        result.data.y.push_back(all.y[j]);
        result.data.weight.push_back(all.weight[j] * drawn[j]);
    }
    result.data.used = result.data.y.size();
    return result;
}

}  // namespace brdfit::optim
