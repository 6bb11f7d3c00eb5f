/// One variant of a model on one channel: what its search sees, and what it has found.
#pragma once

#include <optional>
#include <vector>

#include "kernels/evaluator.h"
#include "optim/noise.h"
#include "optim/optimum.h"
#include "optim/refit.h"
#include "optim/request.h"

namespace brdfit::optim {

/// What of a channel depends on directions alone; channels with the same directions share it.
struct Directions {
    explicit Directions(const Channel& channel);
    /// Whether the channel's samples are in these directions, one by one.
    [[nodiscard]] bool are_of(const Channel& channel) const;

    kernels::DirectionSet samples;
    std::vector<Fit::Curve> curves;  ///< without values: one for each incidence angle in the plane, rising
    kernels::DirectionSet curve_points;

private:
    std::vector<kernels::Direction> curves_of(const Channel& channel);
};

/// One (channel, model) of a request. References must outlive it.
struct Work {
    kernels::Engine& engine;
    const Channel& channel;
    const Directions& directions;
    const NoiseOf& noise;
    Unit unit;
    const ModelRequest& request;
    const FitOptions& options;
    SearchControl control;
};

/// What a search of one variant sees: the data in a unit of their own size, which sets the model's scale. For relative
/// data and a model that does not know the scale, that of a white diffuser, and albedos not bounded above.
struct Prepared {
    Channel channel;
    std::vector<Interval> bounds;
    double unit = 1;           ///< the data's values over the channel's here
    ScaleRange scale;          ///< of the channel here
    double residual_unit = 1;  ///< of a loss's residuals in which data are measured here
    bool by_convention = false;
};

/// Its parts refer to each other.
struct Variant {
    /// Throws SearchError where the loss cannot weigh these data.
    Variant(const Work& work, const kernels::Model& model);
    Variant(const Variant&) = delete;
    Variant& operator=(const Variant&) = delete;
    ~Variant() = default;

    /// Whether there are as many usable samples as free parameters.
    [[nodiscard]] bool possible() const { return weighted.used >= free; }
    /// Throws SearchError where it is not.
    void require_possible() const;
    /// Free parameters, and the scale where that is fitted.
    [[nodiscard]] std::size_t degrees() const { return free + (scale_free ? 1 : 0); }

    Prepared prepared;
    Weighted weighted;          ///< under the loss; once a robust fit is found, squares of its pseudo-values
    std::size_t free;           ///< parameters
    bool scale_free;            ///< the scale is one more
    std::vector<double> sigma;  ///< of the noise; none in a robust fit, whose weights are no noise's
    Task task;
    Optimum optimum;
    std::optional<Refitter> refitter;
    Point likeliest;  ///< by the noise, not by the loss
    Fit fit;
};

/// Puts lobes in falling order of their exponent, unless the request speaks of single lobes.
void order_lobes(const Work& work, const kernels::Model& model, Point& point);

}  // namespace brdfit::optim
