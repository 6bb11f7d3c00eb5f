#include "optim/request.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

namespace brdfit::optim {

using kernels::Model;

std::size_t ModelRequest::most_lobes() const {
    if (!family->repeat) return 1;
    return lobes.value_or(family->repeat->auto_max);
}

double to_model_unit(const kernels::Parameter& parameter, const Channel& channel) {
    return parameter.unit == "wavelength" && channel.wavelength_nm ? 1000 / *channel.wavelength_nm : 1.0;
}

std::string wire_unit(const kernels::Parameter& parameter, const Channel& channel) {
    if (parameter.unit != "wavelength") return parameter.unit;
    return channel.wavelength_nm ? "um" : "lambda";
}

std::string domain_rule(const kernels::Parameter& parameter, const Channel& channel) {
    const double unit = to_model_unit(parameter, channel);
    const std::string name = wire_unit(parameter, channel);
    return fmt::format("the model is defined from {:g} to {:g}{}", parameter.domain_min / unit,
                       parameter.domain_max / unit, name == "1" ? "" : " " + name);
}

std::vector<Interval> parameter_bounds(const Model& model, const ModelRequest& request, const Channel& channel) {
    std::vector<Interval> bounds;
    for (const kernels::Parameter& parameter : model.parameters) {
        const double unit = to_model_unit(parameter, channel);
        Interval interval{parameter.min, parameter.max};
        if (const auto it = request.bounds.find(parameter.name); it != request.bounds.end())
            interval = {it->second.min * unit, it->second.max * unit};
        if (const auto it = request.fixed.find(parameter.name); it != request.fixed.end())
            interval = {it->second * unit, it->second * unit};
        if (request.submodel != nullptr)
            if (const auto it = request.submodel->fixed.find(parameter.name); it != request.submodel->fixed.end())
                interval = {it->second, it->second};
        if (!(interval.min <= interval.max)) throw InvalidBounds(parameter.name, "the lower bound is above the upper");
        // In the model's unit a bound may have become too large for a double.
        if (interval.min < parameter.domain_min || interval.max > parameter.domain_max ||
            !std::isfinite(interval.max - interval.min))
            throw InvalidBounds(parameter.name, domain_rule(parameter, channel));
        bounds.push_back(interval);
    }
    return bounds;
}

std::size_t samples_needed(const ModelRequest& request, const Channel& channel) {
    const kernels::Family& family = *request.family;
    const std::size_t lobes = request.lobes.value_or(family.repeat ? family.repeat->min : 1);
    return free_parameters(parameter_bounds(request.variant(lobes), request, channel));
}

std::size_t free_parameters(const std::vector<Interval>& bounds) {
    return static_cast<std::size_t>(
        std::count_if(bounds.begin(), bounds.end(), [](const Interval& b) { return !b.fixed(); }));
}

}  // namespace brdfit::optim
