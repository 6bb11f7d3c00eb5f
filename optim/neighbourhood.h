/// The loss about a minimum, within bounds: how it looks from places there, and how unknowns make up for one that
/// moves.
#pragma once

#include <array>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "optim/coordinate.h"
#include "optim/interval.h"
#include "optim/optimum.h"
#include "optim/refit.h"

namespace brdfit::optim {

/// A minimum as its profiles are asked for. References must outlive it. Unknowns are those that the samples feel and
/// that are not held, at bounds or not.
struct Minimised {
    const Task& task;
    const Point& point;
    std::vector<Coordinate> unknowns;
    std::vector<Interval> bounds;  ///< of each unknown, in the model's unit
    Eigen::VectorXd spreads;       ///< of each sample: standard deviation of its residual by noise
    Eigen::MatrixXd misfit;        ///< what misfit adds to half the loss's curvature, by the unknowns' own scales
    std::vector<double> degrees;   ///< of freedom of the noise, as each unknown sees it
};

/// The loss about a point: L + 2 g'd + d'(A + S)d. Unknowns are on their own scales.
struct Place {
    Eigen::VectorXd z;
    double loss2 = 0;
    Eigen::VectorXd g;
    Eigen::MatrixXd a;  ///< Gauss and Newton's
    Eigen::MatrixXd b;  ///< covariance of g by noise
    Eigen::MatrixXd s;  ///< what misfit adds to a, as it is at the minimum or here

    [[nodiscard]] bool is_finite() const;
};

/// What the others do where one unknown moves by a step: the minimum of the loss's quadratic form within bounds.
struct Response {
    Eigen::VectorXd step;
    double loss2 = 0;       ///< there
    double slope = 0;       ///< half of the loss's, by the unknown, there
    double curvature = 0;   ///< of the profile
    double noise = 0;       ///< what the loss rises by one standard error
    Eigen::VectorXd along;  ///< d unknowns/d the one
};

/// Places and bounds are of the unknowns' own scales. The minimum and the refitter must outlive it. Members throw what
/// an evaluator throws.
class Neighbourhood {
public:
    using Index = Eigen::Index;

    Neighbourhood(const Minimised& minimised, Refitter& refitter);

    [[nodiscard]] const Minimised& minimised() const { return minimised_; }
    [[nodiscard]] const SearchControl& control() const { return minimised_.task.control; }
    [[nodiscard]] Index count() const { return static_cast<Index>(minimised_.unknowns.size()); }
    [[nodiscard]] const Coordinate& unknown(Index i) const { return minimised_.unknowns[static_cast<std::size_t>(i)]; }
    [[nodiscard]] double lower(Index i) const { return lower_(i); }
    [[nodiscard]] double upper(Index i) const { return upper_(i); }
    /// What counts as a large step of an unknown.
    [[nodiscard]] double size(Index i) const { return unknown(i).size(minimised_.task.model); }
    /// Of freedom of the noise, as an unknown sees it.
    [[nodiscard]] double degrees(Index i) const { return minimised_.degrees[static_cast<std::size_t>(i)]; }
    /// An unknown's value at a place of it, in the model's unit: a bound itself where it stands there.
    [[nodiscard]] double value(Index i, double z) const;

    /// The minimum.
    [[nodiscard]] const Place& start() const { return start_; }
    /// The loss as it is at z, which lies within the bounds; what misfit adds is the minimum's.
    [[nodiscard]] Place look(const Eigen::VectorXd& z) const;
    /// The same place with what misfit adds there, from differences of gradients: two looks an unknown, none where
    /// misfit adds nothing at the minimum.
    [[nodiscard]] Place with_own_misfit(Place place) const;
    /// The nearest point within the bounds.
    [[nodiscard]] Eigen::VectorXd bounded(Eigen::VectorXd z) const;
    /// What the others do where unknown psi moves by a step, damped after Marquardt.
    [[nodiscard]] Response respond(const Place& from, Index psi, double by, double damping) const;
    /// Where unknown i stands at its lower bound, another is held, and the rest make up for it. None if the loss has no
    /// minimum there. close: of loss^2, not worth another step.
    [[nodiscard]] std::optional<Place> at_lower_bound(const Place& from, Index i, Index held, double close) const;

private:
    /// What residuals add to the curvature, be they misfit or noise.
    [[nodiscard]] Eigen::MatrixXd bend(const Place& place) const;
    /// The material there, and the slope of each unknown by its own scale (of the scale: of its logarithm).
    [[nodiscard]] Point point_at(const Eigen::VectorXd& z, Eigen::VectorXd& slopes) const;
    /// Under a curvature h; none if that is not positive definite.
    [[nodiscard]] std::optional<Response> respond(const Place& from, const Eigen::MatrixXd& h, Index psi, double by,
                                                  double damping) const;

    const Minimised& minimised_;
    Refitter& refitter_;
    Eigen::VectorXd lower_, upper_;
    Place start_;
    double share_ = 0;  ///< of what misfit adds to the curvature, that is not noise
};

}  // namespace brdfit::optim
