/// Whether a fitted model keeps to physics: energy, reciprocity, no negative light.
#pragma once

#include <span>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/hemisphere.h"
#include "kernels/model.h"
#include "optim/interval.h"
#include "optim/report.h"

namespace brdfit::optim {

/// The error that is admitted in an albedo, and in units of the albedo where that is above 1.
inline constexpr double kAlbedoTolerance = 1e-4;
/// The largest albedo is sought from normal incidence to here: towards 90 degrees several models grow without limit.
inline constexpr double kSteepestIncidence_deg = 89;
/// Albedos are told at so many incidence angles of the data, evenly chosen where there are more.
inline constexpr std::size_t kMostAlbedos = 90;

/// The incidence angles over which energy is judged, and those of them at which albedos are computed first.
struct Incidence {
    /// data_deg: distinct incidence angles of the data, rising. Of all angles, what is within `seen` counts; it holds
    /// one of the data's.
    explicit Incidence(std::span<const double> data_deg, Interval seen = {0, 90});

    Interval range;                 ///< to kSteepestIncidence_deg, or to the data's steepest angle
    std::size_t of_data = 0;        ///< how many of the data's angles are within
    std::vector<double> told_deg;   ///< those of the data at which albedos are told, kMostAlbedos at most, rising
    std::vector<double> grid_deg;   ///< over the range, between which an albedo has no hidden peak; rising
    std::vector<double> whole_deg;  ///< both, rising
};

/// The verdict on one fit.
struct Judgement {
    std::vector<DirectionalAlbedo> albedo;
    Physics physics;
    std::vector<std::string> warnings;
};

/// The largest albedo over the incidence angles.
struct LargestAlbedo {
    kernels::Albedo albedo;
    double theta_i_deg = 0;
};

/// The arithmetic in which a model's albedos are computed: that suffices, and series are slow.
kernels::Precision albedo_precision(const kernels::Engine& engine, const kernels::Model& model);

/// Judges a model with these parameters, in its own unit.
/// scale_known: whether the model's scale means something; without it nothing is said of energy. Throws
/// kernels::PrecisionError, kernels::BuildError, kernels::DeviceError.
Judgement judge_physics(kernels::Engine& engine, const kernels::Model& model, std::span<const double> parameters,
                        const Incidence& incidence, bool scale_known);

/// The largest of the known albedos (at rising angles) and of those between them, by evaluating some further ones.
LargestAlbedo largest_albedo(kernels::Hemisphere& hemisphere, std::span<const double> parameters,
                             std::vector<double> theta_i_deg, std::vector<kernels::Albedo> known);

/// The same without known ones.
LargestAlbedo largest_albedo(kernels::Hemisphere& hemisphere, std::span<const double> parameters,
                             const Incidence& incidence);

/// Whether f(u, v) = f(v, u) over a set of pairs, and whether f >= 0 there.
struct PairVerdict {
    bool reciprocal = true;
    bool nonnegative = true;
};
PairVerdict judge_pairs(kernels::Engine& engine, const kernels::Model& model, std::span<const double> parameters);

}  // namespace brdfit::optim
