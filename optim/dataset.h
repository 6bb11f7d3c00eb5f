/// Measurements of one surface.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "kernels/geometry.h"

namespace brdfit::optim {

/// One measured direction pair.
struct Sample {
    kernels::Direction direction;
    double brdf = 0;                ///< [1/sr], or relative; may be negative: noise below the floor
    std::optional<double> sigma{};  ///< standard deviation of brdf, same unit, > 0
    double weight = 1;  ///< factor of the loss's weight, in (0, 1]; below 1 it counts in no error that is reported

    bool operator==(const Sample&) const = default;
};

/// One wavelength or colour.
struct Channel {
    std::string name;
    std::optional<double> wavelength_nm{};
    std::vector<Sample> samples;

    bool operator==(const Channel&) const = default;
};

/// Unit of all BRDF values of a dataset.
enum class Unit {
    per_steradian,  ///< absolute
    relative,       ///< f times one unknown positive factor a channel
};

struct Dataset {
    std::string name;
    Unit unit = Unit::per_steradian;
    std::vector<Channel> channels;

    bool operator==(const Dataset&) const = default;
};

}  // namespace brdfit::optim
