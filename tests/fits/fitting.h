/// What the tests of whole fits share: a fitter, requests by name, a report's parts.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "optim/fit.h"
#include "tests/support.h"

namespace brdfit::tests {

inline optim::Fitter& fitter() {
    static optim::Fitter& instance = []() -> optim::Fitter& {
        static optim::Fitter built(engine(), std::max(1U, std::thread::hardware_concurrency()));
        for (const kernels::Family& family : catalogue().families()) built.warm_up(family);
        return built;
    }();
    return instance;
}

/// "phong", or "lafortune_2" for two lobes.
inline optim::ModelRequest request(const std::string& name) {
    const auto digit = name.find_last_of("0123456789");
    optim::ModelRequest result;
    if (digit == name.size() - 1) {
        result.family = catalogue().find(name.substr(0, name.size() - 2));
        result.lobes = static_cast<std::size_t>(name[digit] - '0');
    } else {
        result.family = catalogue().find(name);
    }
    return result;
}

inline std::vector<optim::ModelRequest> requests(const std::vector<std::string>& names) {
    std::vector<optim::ModelRequest> result;
    for (const std::string& name : names) result.push_back(request(name));
    return result;
}

inline std::string label(const optim::Fit& fit) {
    return fit.lobes == 0 ? fit.model : fit.model + "_" + std::to_string(fit.lobes);
}

inline const optim::Fit& only(const optim::Report& report, std::size_t channel = 0) {
    const optim::ChannelReport& c = report.channels.at(channel);
    if (c.fits.size() != 1) throw std::runtime_error(c.failures.empty() ? "no fit" : c.failures.front().detail);
    return c.fits.front();
}

inline optim::Dataset dataset_of(optim::Channel channel) {
    return {"test", optim::Unit::per_steradian, {std::move(channel)}};
}

inline std::vector<double> values_of(const optim::Fit& fit) {
    std::vector<double> values;
    for (const auto& p : fit.parameters) values.push_back(p.value);
    return values;
}

}  // namespace brdfit::tests
