/// What the tests share: devices, the built-in models, random numbers, samples on disk.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/evaluator.h"
#include "kernels/model.h"
#include "optim/dataset.h"

namespace brdfit::tests {

/// The device with its native SIMD width.
inline kernels::Engine& engine() {
    static kernels::Engine instance;
    return instance;
}

/// The same device, one sample at a time.
inline kernels::Engine& scalar_engine() {
    static kernels::Engine instance({"auto", 1U});
    return instance;
}

/// The same device with kernels for devices that have more work-items than a batch has candidates.
inline kernels::Engine& sliced_engine() {
    static kernels::Engine instance([] {
        kernels::EngineOptions options;
        options.sliced = true;
        return options;
    }());
    return instance;
}

inline const kernels::Catalogue& catalogue() {
    static const kernels::Catalogue instance;
    return instance;
}

/// "phong", or "lafortune_2" for two lobes.
inline std::string label(const kernels::Model& model) {
    return model.repeats == 0 ? model.name : model.name + "_" + std::to_string(model.repeats);
}

/// Every variant of every built-in model, and of submodels with a text of their own.
inline std::vector<const kernels::Model*> variants() {
    std::vector<const kernels::Model*> result;
    for (const kernels::Family& family : catalogue().families())
        for (const kernels::Model* model : family.texts()) result.push_back(model);
    return result;
}

inline const kernels::Model& variant(const std::string& name) {
    for (const kernels::Model* model : variants())
        if (label(*model) == name) return *model;
    throw std::invalid_argument("no model " + name);
}

/// The long form of a test: BRDFIT_LONG=1 in the environment.
inline bool long_form() {
    const char* value = std::getenv("BRDFIT_LONG");
    return value != nullptr && std::string(value) == "1";
}

/// A count that the environment may override.
inline std::size_t count_from(const char* variable, std::size_t otherwise) {
    const char* value = std::getenv(variable);
    return value != nullptr ? static_cast<std::size_t>(std::strtoull(value, nullptr, 10)) : otherwise;
}

/// Seeded random numbers.
class Random {
public:
    explicit Random(std::uint64_t seed) : generator_(seed) {}
    double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(generator_); }
    double normal() { return std::normal_distribution<double>()(generator_); }
    bool chance(double probability) { return uniform(0, 1) < probability; }
    /// Even over [low, high] on the parameter's scale.
    double on_scale(kernels::Scale scale, double low, double high) {
        if (scale == kernels::Scale::linear) return uniform(low, high);
        return std::min(std::max(low * std::pow(high / low, uniform(0, 1)), low), high);
    }
    std::vector<double> parameters(const kernels::Model& model) {
        std::vector<double> result;
        for (const kernels::Parameter& p : model.parameters) result.push_back(on_scale(p.scale, p.min, p.max));
        return result;
    }
    std::vector<double> typical_parameters(const kernels::Model& model) {
        std::vector<double> result;
        for (const kernels::Parameter& p : model.parameters)
            result.push_back(on_scale(p.scale, p.typical_min, p.typical_max));
        return result;
    }

private:
    std::mt19937_64 generator_;
};

/// Scans in the plane of incidence, as the samples hold them: finer about the mirror direction.
inline std::vector<kernels::Direction> scan_directions(const std::vector<double>& theta_i_deg, double step_deg) {
    std::vector<kernels::Direction> directions;
    for (const double theta_i : theta_i_deg)
        for (double theta_r = -80; theta_r <= 80; theta_r += std::abs(theta_r - theta_i) < 10 ? step_deg / 2 : step_deg)
            directions.push_back({theta_i, theta_r, 0});
    return directions;
}

/// The model at the directions, in double.
inline std::vector<double> model_values(const kernels::Model& model, const std::vector<double>& parameters,
                                        const std::vector<kernels::Direction>& directions) {
    return kernels::evaluate(engine(), model, engine().best_precision(), parameters, directions, false).f;
}

inline optim::Channel make_channel(const std::vector<kernels::Direction>& directions, const std::vector<double>& y) {
    optim::Channel channel{"y", {}, {}};
    for (std::size_t j = 0; j < y.size(); ++j) channel.samples.push_back({directions[j], y[j], {}});
    return channel;
}

/// Reads the comma-separated scans that lie beside the source: one header line after '#' lines, a row a sample, all in
/// the plane of incidence. Columns that are not known are passed over.
inline optim::Dataset read_samples(const std::filesystem::path& path) {
    std::ifstream in(path);
    if (!in) throw std::runtime_error("cannot read " + path.string());
    const auto cells = [](const std::string& line) {
        std::vector<std::string> result;
        std::istringstream row(line);
        for (std::string cell; std::getline(row, cell, ',');) result.push_back(cell);
        return result;
    };
    optim::Dataset dataset;
    dataset.name = path.stem().string();
    std::vector<std::string> header;
    std::map<std::string, std::size_t> channels;
    for (std::string line; std::getline(in, line);) {
        if (line.empty() || line[0] == '#') continue;
        if (header.empty()) {
            header = cells(line);
            continue;
        }
        const std::vector<std::string> row = cells(line);
        std::map<std::string, std::string> cell;
        for (std::size_t i = 0; i < row.size(); ++i) cell[header.at(i)] = row[i];
        const std::string name = cell.count("channel") ? cell["channel"] : cell["wavelength_nm"];
        if (channels.try_emplace(name, channels.size()).second) {
            optim::Channel channel{name, {}, {}};
            if (cell.count("wavelength_nm")) channel.wavelength_nm = std::stod(cell["wavelength_nm"]);
            dataset.channels.push_back(std::move(channel));
        }
        const kernels::Direction direction{std::stod(cell.at("theta_i_deg")), std::stod(cell.at("theta_r_deg")), 0};
        dataset.channels[channels[name]].samples.push_back({direction, std::stod(cell.at("brdf_per_sr")), {}});
    }
    return dataset;
}

inline std::vector<optim::Dataset> read_folder(const std::filesystem::path& folder) {
    std::vector<std::filesystem::path> files;
    if (std::filesystem::is_directory(folder))
        for (const auto& entry : std::filesystem::directory_iterator(folder))
            if (entry.path().extension() == ".csv") files.push_back(entry.path());
    std::sort(files.begin(), files.end());
    std::vector<optim::Dataset> result;
    for (const auto& file : files) result.push_back(read_samples(file));
    return result;
}

}  // namespace brdfit::tests
