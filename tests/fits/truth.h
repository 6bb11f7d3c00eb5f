/// The bundled samples before noise was put on them.
#pragma once

#include <map>
#include <stdexcept>
#include <string>

#include "tests/support.h"

namespace brdfit::tests {

inline const std::vector<std::string>& sample_names() {
    static const std::vector<std::string> names{"metallic_paint", "paper", "rough_metal", "smooth_metal",
                                                "white_plastic"};
    return names;
}

/// The sample with the values of the model that its comments name, without noise.
inline optim::Channel noise_free(const std::string& sample) {
    const std::filesystem::path path = std::filesystem::path(BRDFIT_SOURCE_DIR) / "samples" / (sample + ".csv");
    std::map<std::string, std::string> said;
    std::ifstream in(path);
    for (std::string line; std::getline(in, line) && !line.empty() && line[0] == '#';)
        if (const auto at = line.find(" = "); at != std::string::npos)
            said[line.substr(2, at - 2)] = line.substr(at + 3);
    optim::Channel channel = read_samples(path).channels.at(0);
    const double um = 1000 / channel.wavelength_nm.value();
    const kernels::Model& model = variant(said.at("model") == "He-Torrance" ? "he_torrance" : "lafortune_2");
    std::vector<double> parameters;
    for (const kernels::Parameter& p : model.parameters)
        parameters.push_back(p.unit == "wavelength" ? std::stod(said.at(p.name + "_um")) * um
                                                    : std::stod(said.at(p.name)));
    std::vector<kernels::Direction> directions;
    for (const optim::Sample& s : channel.samples) directions.push_back(s.direction);
    const std::vector<double> y = model_values(model, parameters, directions);
    for (std::size_t j = 0; j < y.size(); ++j) channel.samples[j].brdf = y[j];
    return channel;
}

/// Measured once more: Gaussian noise of sigma^2 = floor^2 + (relative y)^2.
inline optim::Channel measured(optim::Channel channel, double relative, double floor, Random& random) {
    for (optim::Sample& s : channel.samples) s.brdf += std::hypot(floor, relative * s.brdf) * random.normal();
    return channel;
}

}  // namespace brdfit::tests
