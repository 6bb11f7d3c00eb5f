#include "optim/thinned.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>

namespace brdfit::optim {

namespace {

/// A regular grid of directions must not meet regular draws. The last order is kept: the fits of a channel ask for the
/// same again and again.
const std::vector<std::uint32_t>& order_of_draws(std::size_t n, std::uint64_t seed) {
    thread_local std::uint64_t known = 0;
    thread_local std::vector<std::uint32_t> order;
    if (order.size() == n && known == seed) return order;
    order.resize(n);
    std::iota(order.begin(), order.end(), std::uint32_t{0});
    std::mt19937_64 random(seed);
    std::shuffle(order.begin(), order.end(), random);
    known = seed;
    return order;
}

}  // namespace

Thinned thinned(const Weighted& all, std::span<const kernels::Direction> directions, std::size_t to,
                std::uint64_t seed) {
    const std::size_t n = all.y.size();
    std::vector<double> share(n);
    double energy = 0;
    for (std::size_t j = 0; j < n; ++j) energy += all.weight[j] * all.y[j] * all.y[j];
    for (std::size_t j = 0; j < n; ++j)
        share[j] = 0.5 / static_cast<double>(n) +
                   (energy > 0 ? 0.5 * all.weight[j] * all.y[j] * all.y[j] / energy : 0.5 / static_cast<double>(n));
    Thinned result;
    result.data.norm = all.norm;
    result.data.logarithmic = all.logarithmic;
    double sum = 0.5;
    std::vector<double> drawn(n, 0.0);
    for (const std::size_t j : order_of_draws(n, seed)) {
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
