/// What a scene asks of a model, and which of the fitted models does that at the least cost.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "optim/dataset.h"
#include "optim/interval.h"

namespace brdfit::optim {

struct ChannelReport;

/// The angles a scene sees, the error it tolerates and what it can pay.
struct Scene {
    Interval theta_i_deg{0, 90};    ///< of incidence
    Interval theta_r_deg{0, 90};    ///< of exitance, in any azimuth
    double outside_weight = 0;      ///< of a sample outside, where one within has 1: in [0, 1); 0 leaves it out
    double tolerance_log10 = 0.05;  ///< the largest root mean square error in decades, > 0
    std::optional<double> max_ns_per_evaluation{};

    [[nodiscard]] bool sees(const kernels::Direction& direction) const;
    bool operator==(const Scene&) const = default;
};

/// The channel as a fit for the scene takes it: samples outside are left out, or weigh less.
Channel seen_by(const Scene& scene, Channel channel);

/// A fit that no cheaper one equals in error. `fit` is its place in ChannelReport::fits.
struct ParetoPoint {
    std::size_t fit = 0;
    double ns_per_evaluation = 0;  ///< Fit::cost in single precision, where the device has it, else in double
    double log10_rmse = 0;
};

/// The cheapest fit that is good enough.
struct Recommendation {
    std::optional<std::size_t> fit{};          ///< its place in ChannelReport::fits; none if none is good enough
    std::string reason;                        ///< one sentence or two
    std::optional<ParetoPoint> next_better{};  ///< the next on the front
};

/// Fills in the front of cost against error, cheapest first, and the recommendation. The fits are those of a channel
/// that is seen_by() the scene. Of fits that cost the same, the one with fewer free parameters counts as the cheaper.
/// A fit whose cost or error in decades is not known has no place on the front.
void judge_scene(const Scene& scene, ChannelReport& report);

}  // namespace brdfit::optim
