/// Whether a fitted model keeps to physics: energy, reciprocity, no negative light.
#pragma once

#include <span>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/hemisphere.h"
#include "kernels/model.h"
#include "optim/report.h"

namespace brdfit::optim {

/// The error that is admitted in an albedo, and in units of the albedo where that is above 1.
inline constexpr double kAlbedoTolerance = 1e-4;
/// The largest albedo is sought from normal incidence to here: towards 90 degrees several models grow without limit.
inline constexpr double kSteepestIncidence_deg = 89;
/// Albedos are told at so many incidence angles of the data, evenly chosen where there are more.
inline constexpr std::size_t kMostAlbedos = 90;

/// The verdict on one fit.
struct Judgement {
    std::vector<DirectionalAlbedo> albedo;
    Physics physics;
    std::vector<std::string> warnings;
};

/// The largest albedo over all incidence angles.
struct LargestAlbedo {
    kernels::Albedo albedo;
    double theta_i_deg = 0;
};

/// The arithmetic in which a model's albedos are computed: that suffices, and series are slow.
kernels::Precision albedo_precision(const kernels::Engine& engine, const kernels::Model& model);

/// Judges a model with these parameters, in its own unit. theta_i_deg: distinct incidence angles of the data, rising.
/// scale_known: whether the model's scale means something; without it nothing is said of energy. Throws
/// kernels::PrecisionError, kernels::BuildError, kernels::DeviceError.
Judgement judge_physics(kernels::Engine& engine, const kernels::Model& model, std::span<const double> parameters,
                        std::span<const double> theta_i_deg, bool scale_known);

/// The largest of the known albedos (at rising angles) and of those between them, by evaluating some further ones.
LargestAlbedo largest_albedo(kernels::Hemisphere& hemisphere, std::span<const double> parameters,
                             std::vector<double> theta_i_deg, std::vector<kernels::Albedo> known);

/// The same without known ones: over a grid of angles from 0 to kSteepestIncidence_deg and these.
LargestAlbedo largest_albedo(kernels::Hemisphere& hemisphere, std::span<const double> parameters,
                             std::span<const double> theta_i_deg);

/// Incidence angles from 0 to kSteepestIncidence_deg between which an albedo has no hidden peak.
std::span<const double> albedo_grid_deg();

/// Whether f(u, v) = f(v, u) over a set of pairs, and whether f >= 0 there.
struct PairVerdict {
    bool reciprocal = true;
    bool nonnegative = true;
};
PairVerdict judge_pairs(kernels::Engine& engine, const kernels::Model& model, std::span<const double> parameters);

}  // namespace brdfit::optim
