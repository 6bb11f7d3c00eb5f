#include "optim/variant.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <set>
#include <string>

namespace brdfit::optim {
namespace {

/// Data of a smaller rms are refused: losses are told in the data's own unit.
constexpr double kSmallestData = 1e-100;

std::vector<kernels::Direction> directions_of(const Channel& channel) {
    std::vector<kernels::Direction> directions;
    for (const Sample& sample : channel.samples) directions.push_back(sample.direction);
    return directions;
}

/// A model of which every term has a free height cannot tell the scale of relative data.
bool knows_scale(const kernels::Model& model) {
    return std::any_of(model.terms.begin(), model.terms.end(),
                       [](const kernels::Term& term) { return !term.factor && !term.homogeneous; });
}

/// Root mean square of the data, [1/sr].
double data_rms(const Channel& channel) {
    double largest = 0;
    for (const Sample& sample : channel.samples) largest = std::max(largest, std::abs(sample.brdf));
    if (largest == 0) return 0;
    double sum = 0;  // of squares that neither overflow nor vanish
    for (const Sample& sample : channel.samples) sum += (sample.brdf / largest) * (sample.brdf / largest);
    return largest * std::sqrt(sum / static_cast<double>(channel.samples.size()));
}

/// A power of two near the data's rms, so that dividing by it rounds nothing.
double data_unit(const Channel& channel) {
    const double rms = data_rms(channel);
    return rms > 0 ? std::exp2(std::round(std::log2(rms))) : 1.0;
}

/// The scale of a perfectly white diffuser with the data's rms.
double white_scale(const Channel& channel) {
    const double rms = data_rms(channel);
    return rms > 0 ? std::numbers::pi * rms : 1.0;
}

Channel divided(Channel channel, double scale) {
    for (Sample& sample : channel.samples) {
        sample.brdf /= scale;
        if (sample.sigma) *sample.sigma /= scale;
    }
    return channel;
}

/// The angles of a curve: even steps over the channel's range, finer about the mirror direction.
std::vector<double> curve_angles(const Channel& channel, double theta_i_deg) {
    double low = 90;
    double high = -90;
    for (const Sample& sample : channel.samples) {
        const kernels::Direction d = canonical(sample.direction);
        if (d.phi_deg != 0) continue;
        low = std::min(low, d.theta_r_deg);
        high = std::max(high, d.theta_r_deg);
    }
    std::vector<double> angles{low, high};
    const auto add = [&](double from, double to, int steps) {
        for (int i = 0; i <= steps; ++i) {
            const double angle = from + (to - from) * i / steps;
            if (angle >= low && angle <= high) angles.push_back(angle);
        }
    };
    add(low, high, 160);
    add(theta_i_deg - 5, theta_i_deg + 5, 100);
    add(theta_i_deg - 0.5, theta_i_deg + 0.5, 50);
    std::sort(angles.begin(), angles.end());
    angles.erase(std::unique(angles.begin(), angles.end()), angles.end());
    return angles;
}

void refuse_tiny(const Channel& channel) {
    if (const double rms = data_rms(channel); rms > 0 && rms < kSmallestData)
        throw SearchError("the BRDF values are too small, below 1e-100, where squares vanish: use another unit");
}

Prepared prepare(const Work& work, const kernels::Model& model) {
    refuse_tiny(work.channel);
    const double white = white_scale(work.channel);
    const bool relative = work.unit == Unit::relative;
    const bool by_convention = relative && !knows_scale(model);
    const double unit = by_convention ? white : data_unit(work.channel);
    Prepared prepared{divided(work.channel, unit), parameter_bounds(model, work.request, work.channel), unit,
                      {1 / unit, 1 / unit},        has_unit(work.options.loss.kind) ? unit : 1.0,       by_convention};
    if (by_convention) prepared.scale = {1, 1};
    else if (relative) prepared.scale = {1e-6 * white / unit, 1e6 * white / unit};
    if (!by_convention) return prepared;
    for (std::size_t i = 0; i < prepared.bounds.size(); ++i)
        if (model.is_linear(i) && !prepared.bounds[i].fixed() &&
            work.request.bounds.count(model.parameters[i].name) == 0)
            prepared.bounds[i].max = model.parameters[i].domain_max;
    return prepared;
}

}  // namespace

Directions::Directions(const Channel& channel) : samples(directions_of(channel)), curve_points(curves_of(channel)) {}

bool Directions::are_of(const Channel& channel) const {
    return std::equal(
        channel.samples.begin(), channel.samples.end(), samples.directions().begin(), samples.directions().end(),
        [](const Sample& sample, const kernels::Direction& direction) { return sample.direction == direction; });
}

std::vector<kernels::Direction> Directions::curves_of(const Channel& channel) {
    std::set<double> incidences;
    for (const Sample& sample : channel.samples)
        if (canonical(sample.direction).phi_deg == 0) incidences.insert(sample.direction.theta_i_deg);
    std::vector<kernels::Direction> directions;
    for (const double theta_i_deg : incidences) {
        curves.push_back({theta_i_deg, curve_angles(channel, theta_i_deg), {}});
        for (const double theta_r_deg : curves.back().theta_r_deg) directions.push_back({theta_i_deg, theta_r_deg, 0});
    }
    return directions;
}

Variant::Variant(const Work& work, const kernels::Model& model)
    : prepared(prepare(work, model)),
      weighted(weigh(prepared.channel, work.options.loss)),
      free(free_parameters(prepared.bounds)),
      scale_free(work.unit == Unit::relative && knows_scale(model)),
      task{work.engine,
           model,
           prepared.channel,
           work.directions.samples,
           weighted,
           work.options.precision,
           work.options.effort,
           work.control,
           prepared.scale} {
    if (!std::isfinite(weighted.norm))
        throw SearchError("the weights of this loss overflow: a value or a sigma is too small beside the others");
    for (const double size : work.noise.get().sigma) sigma.push_back(size / prepared.unit);
}

void Variant::require_possible() const {
    if (!possible())
        throw SearchError("too few samples: " + std::to_string(weighted.used) + " usable ones for " +
                          std::to_string(free) + " free parameters");
}

void order_lobes(const Work& work, const kernels::Model& model, Point& point) {
    if (model.repeats < 2 || !work.request.bounds.empty() || !work.request.fixed.empty()) return;
    std::vector<std::vector<double>> lobes;
    auto at = point.parameters.begin() + static_cast<std::ptrdiff_t>(model.group_begin);
    for (std::size_t j = 0; j < model.repeats; ++j, at += static_cast<std::ptrdiff_t>(model.group_size))
        lobes.emplace_back(at, at + static_cast<std::ptrdiff_t>(model.group_size));
    std::stable_sort(lobes.begin(), lobes.end(),
                     [&](const auto& a, const auto& b) { return a[model.order_by] > b[model.order_by]; });
    at = point.parameters.begin() + static_cast<std::ptrdiff_t>(model.group_begin);
    for (const auto& lobe : lobes) at = std::copy(lobe.begin(), lobe.end(), at);
}

}  // namespace brdfit::optim
