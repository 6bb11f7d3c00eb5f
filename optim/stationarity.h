/// Whether a search has ended at a minimum: the judge of `converged`, apart from the method that searched.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "optim/search.h"

namespace brdfit::optim {

/// What the arithmetic of an objective can tell. Its values are of order one or below: loss^2 over that of f = 0.
struct Resolution {
    double step = 1e-4;       ///< of the cube, for differences of gradients
    double relative = 1e-9;   ///< a decrease below relative * value + absolute counts as none
    double absolute = 1e-24;  ///< residuals of 1e-12 of the data
    double flat = 1e-7;       ///< curvatures below this part of the largest may be the differences' error

    [[nodiscard]] double negligible(double value) const { return relative * value + absolute; }
};
Resolution resolution(kernels::Precision precision);

/// The quadratic model of an objective at a point of the unit cube, minimised over the cube: Newton's decrement with
/// bounds. Coordinates that stand on a bound and are pushed against it take no part.
struct Stationarity {
    double value = 0;          ///< the objective
    double promised = 0;       ///< by how much the model falls below it, >= 0
    std::vector<double> step;  ///< to where it does
    /// Steps along directions without upward curvature to speak of (flat, or down on both sides) that may lead lower.
    std::vector<std::vector<double>> doubtful;
};
/// From the gradient at u and differences of gradients, 2 d + 1 evaluations, more where it bends sharply. `bends`,
/// unless empty, takes the objective's place in the differences: an estimate of it, of fewer samples. Throws what they
/// throw.
Stationarity examine(const Objective& objective, std::span<const double> u, const Resolution& resolution,
                     const Objective& bends = {});

/// Goes on from the end of a search until it is a minimum: Newton steps, steps along directions of negative curvature,
/// descents. The result's stop is `converged` if no decrease is promised that counts, `roundoff` if one is promised but
/// none is found, `evaluation_limit` if the rounds are spent; time_limit and cancelled as they come. `bends` as in
/// examine(). Throws what the objectives throw.
Minimum settle(const Objective& objective, Minimum end, const Resolution& resolution, const SearchControl& control,
               const Objective& bends = {});

}  // namespace brdfit::optim
