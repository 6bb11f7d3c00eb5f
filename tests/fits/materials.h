/// Random materials under the sampling patterns of goniometers: what success rates are measured on.
#pragma once

#include <cmath>
#include <filesystem>
#include <numbers>
#include <vector>

#include "optim/fit.h"
#include "tests/support.h"

namespace brdfit::tests {

/// The directions of the bundled samples, of measured surfaces where they lie beside the source, and of a plain scan.
inline const std::vector<std::vector<kernels::Direction>>& sampling_patterns() {
    static const std::vector<std::vector<kernels::Direction>> instance = [] {
        const std::filesystem::path source = BRDFIT_SOURCE_DIR;
        std::vector<std::vector<kernels::Direction>> patterns{scan_directions({15, 30, 45, 60, 75}, 2)};
        std::vector<optim::Dataset> datasets{read_samples(source / "samples" / "paper.csv")};
        for (optim::Dataset& dataset : read_folder(source / ".." / "shared" / "data" / "real"))
            datasets.push_back(std::move(dataset));
        for (const optim::Dataset& dataset : datasets) {
            patterns.emplace_back();
            for (const optim::Sample& sample : dataset.channels.at(0).samples)
                patterns.back().push_back(sample.direction);
        }
        return patterns;
    }();
    return instance;
}

/// Height at which a lobe's highest value over the directions is `peak`.
inline double lobe_length(double x, double y, double n, double peak,
                          const std::vector<kernels::Direction>& directions) {
    double highest = 0;
    for (const kernels::Direction& d : directions) {
        const double i = d.theta_i_deg * std::numbers::pi / 180;
        const double r = d.theta_r_deg * std::numbers::pi / 180;
        highest = std::max(highest, -x * std::sin(i) * std::sin(r) + y * std::cos(i) * std::cos(r));
    }
    return highest > 0 ? std::min(std::pow(peak, 1 / n) / highest, 2.9) : 0.0;
}

/// Parameters drawn evenly in their logarithm over what surfaces have: albedos and weights of lobes 0.01 to 1; widths,
/// exponents and roughness over the typical ranges; dielectrics of index 1.1 to 4 and metals of n, k 0.2 to 10. A lobe
/// of Lafortune's is forward, its direction off the mirror's by up to 4 of its widths, or (three of ten) broad and
/// anywhere; its highest value at a sample is 0.02 to 20.
inline std::vector<double> random_material(const kernels::Model& model, Random& random,
                                           const std::vector<kernels::Direction>& directions) {
    const auto log_uniform = [&](double low, double high) {
        return random.on_scale(kernels::Scale::logarithmic, low, high);
    };
    std::vector<double> p;
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        const kernels::Parameter& parameter = model.parameters[i];
        p.push_back(model.is_linear(i)
                        ? log_uniform(0.01, 1)
                        : random.on_scale(parameter.scale, parameter.typical_min, parameter.typical_max));
    }
    if (const auto k = model.find("k")) {
        const bool metal = random.chance(0.5);
        p[*model.find("n")] = metal ? log_uniform(0.2, 10) : log_uniform(1.1, 4);
        p[*k] = metal ? log_uniform(0.2, 10) : 0.0;
    }
    for (const kernels::Term& term : model.terms) {
        if (!term.homogeneous) continue;
        const auto [x, y] = term.homogeneous->plane;
        const bool forward = random.chance(0.7);
        const double n = p[term.homogeneous->degree] = log_uniform(0.5, forward ? 2000 : 50);
        const double off = (random.chance(0.5) ? 1 : -1) * log_uniform(0.01, 4) / (1 + n);
        const double psi = forward ? term.homogeneous->pole + off : random.uniform(0.05, std::numbers::pi - 0.05);
        const double length = lobe_length(std::cos(psi), std::sin(psi), n, log_uniform(0.02, 20), directions);
        p[x] = length * std::cos(psi);
        p[y] = length * std::sin(psi);
    }
    return p;
}

/// A material as a lab would measure it: values with 2 % of noise.
inline optim::Channel random_measurement(const kernels::Model& model, std::size_t index,
                                         const std::vector<kernels::Direction>& directions) {
    Random random(1'000'000 + index);
    std::vector<double> y = model_values(model, random_material(model, random, directions), directions);
    for (double& value : y) value *= 1 + 0.02 * random.normal();
    optim::Channel channel = make_channel(directions, y);
    channel.name = std::to_string(index);
    return channel;
}

/// Gross outliers: that part of the values ten times too large or too small.
inline void contaminate(optim::Channel& channel, double part, std::size_t index) {
    Random random(2'000'000 + index);
    for (optim::Sample& sample : channel.samples)
        if (random.chance(part)) sample.brdf *= random.chance(0.5) ? 10 : 0.1;
}

}  // namespace brdfit::tests
