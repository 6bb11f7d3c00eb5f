/// What holds of every request that is read.
#pragma once

#include <cmath>
#include <set>
#include <string>

#include "api/request.h"
#include "api/samples.h"
#include "tests/fuzz/fuzz.h"

namespace brdfit::fuzz {

inline void check_dataset(const optim::Dataset& dataset) {
    require(!dataset.channels.empty() && dataset.channels.size() <= api::kMostChannels, "1 to 1000 channels");
    std::set<std::string> names;
    std::size_t samples = 0;
    for (const optim::Channel& channel : dataset.channels) {
        require(!channel.name.empty() && names.insert(channel.name).second, "channels have names of their own");
        require(!channel.samples.empty(), "channels have samples");
        samples += channel.samples.size();
        if (channel.wavelength_nm) require(!api::bad_wavelength(*channel.wavelength_nm), "a wavelength");
        for (const optim::Sample& sample : channel.samples) {
            const kernels::Direction& d = sample.direction;
            require(d.theta_i_deg >= 0 && d.theta_i_deg < 90, "theta_i");
            require(d.theta_r_deg > -90 && d.theta_r_deg < 90, "theta_r");
            require(std::abs(d.phi_deg) <= 360, "phi");
            require(std::abs(sample.brdf) <= 1e30, "brdf");
            if (sample.sigma) require(*sample.sigma > 0 && *sample.sigma <= 1e30, "sigma");
            for (const kernels::GeometryColumn& column : kernels::geometry_columns())
                require(std::isfinite(
                            column.read(kernels::Angles(kernels::canonical(d)), kernels::Precision::double_precision)),
                        std::string(column.name));
        }
    }
    require(samples <= api::kMostSamples, "at most a million samples");
}

inline void check_request(const api::FitRequest& request) {
    check_dataset(request.dataset);
    require(!request.models.empty() && request.models.size() <= 50, "1 to 50 models");
    require(request.options.time_limit.count() > 0 && request.options.time_limit.count() <= 3600, "time limit");
    for (const optim::ModelRequest& model : request.models) {
        require(model.family != nullptr, "a model");
        const kernels::Model& variant = model.variant(model.most_lobes());
        for (const auto& [name, value] : model.fixed)
            require(variant.find(name) && std::isfinite(value) && model.bounds.count(name) == 0, "fixed " + name);
        for (const auto& [name, bounds] : model.bounds)
            require(variant.find(name) && bounds.min < bounds.max && std::isfinite(bounds.max - bounds.min),
                    "bounds of " + name);
        for (const optim::Channel& channel : request.dataset.channels) {
            const auto bounds = optim::parameter_bounds(variant, model, channel);
            for (std::size_t i = 0; i < bounds.size(); ++i)
                require(std::isfinite(bounds[i].min) && std::isfinite(bounds[i].max) && bounds[i].min <= bounds[i].max,
                        "bounds of " + variant.parameters[i].name);
            (void)optim::samples_needed(model, channel);
        }
    }
}

}  // namespace brdfit::fuzz
