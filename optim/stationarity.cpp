#include "optim/stationarity.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Dense>  // eigenvalues of the small symmetric matrix of curvatures

#include "optim/index.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Farthest step, in the cube's unit, for which the quadratic model is believed.
constexpr double kTrust = 0.1;
/// Newton steps, each with a new look at the curvature.
constexpr int kRounds = 40;
constexpr int kDescentEvaluations = 400;

/// The objective about a point in its free coordinates, in units in which all curve alike.
struct Quadratic {
    std::vector<Index> free;  ///< coordinates of the cube
    VectorXd unit;            ///< of each, in the cube's
    VectorXd reach;           ///< farthest step for which the model is believed, in these units
    VectorXd gradient;
    MatrixXd curvature;
};

/// Without the gradient. From differences of gradients, which narrow where the objective bends within them.
Quadratic quadratic(const Objective& objective, std::span<const double> u, double value,
                    const std::vector<double>& gradient, std::vector<Index> free, const Resolution& resolution) {
    constexpr double kNarrowest = 1e-9;
    constexpr double kUnlike = 1e-6;  // units differ by no more
    const auto n = static_cast<Index>(free.size());
    VectorXd width = VectorXd::Ones(n);
    MatrixXd h(n, n);
    std::vector<double> point(u.begin(), u.end());
    std::vector<double> above(u.size()), below(u.size());
    const double fair = 0.1 * value + resolution.negligible(value);
    for (Index j = 0; j < n; ++j) {
        const std::size_t axis = at(free[at(j)]);
        const double centre = u[axis];
        // Whether the trapezoidal rule over the slopes gives the change of the value.
        const auto smooth = [&](double to, std::vector<double>& slopes) {
            if (to == centre) {
                slopes = gradient;
                return true;
            }
            point[axis] = to;
            const double change = objective(point, slopes) - value;
            return std::abs(change - (gradient[axis] + slopes[axis]) / 2 * (to - centre)) <= fair;
        };
        double high = 0;
        double low = 0;
        for (double& w = width(j);; w /= 10) {
            high = std::min(centre + resolution.step * w, 1.0);
            low = std::max(centre - resolution.step * w, 0.0);
            const bool smooth_above = smooth(high, above);
            const bool smooth_below = smooth(low, below);
            if ((smooth_above && smooth_below) || w <= kNarrowest) break;
        }
        point[axis] = centre;
        for (Index i = 0; i < n; ++i) h(i, j) = (above[at(free[at(i)])] - below[at(free[at(i)])]) / (high - low);
    }
    const double steepest = std::sqrt((width.array().square() * h.diagonal().array().abs()).maxCoeff());
    VectorXd unit(n);
    for (Index i = 0; i < n; ++i) {
        const double bend = width(i) * std::sqrt(std::abs(h(i, i)));
        unit(i) = steepest > 0 ? width(i) * steepest / std::max(bend, kUnlike * steepest) : width(i);
    }
    const MatrixXd scaled = unit.asDiagonal() * h * unit.asDiagonal();
    return {std::move(free), unit, kTrust * width.cwiseQuotient(unit), VectorXd(n), (scaled + scaled.transpose()) / 2};
}

/// Which directions a step takes: those that curve upward by more than a part of the most, or all, as if they did.
enum class Directions { resolved, all };

/// Minimises g's + s'Hs/2 along each eigenvector within the reach.
VectorXd newton(const MatrixXd& h, const VectorXd& g, const VectorXd& reach, double part, Directions which) {
    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(h);
    const double least = part * eigen.eigenvalues().cwiseAbs().maxCoeff();
    VectorXd step = VectorXd::Zero(g.size());
    for (Index e = 0; e < g.size(); ++e) {
        const VectorXd direction = eigen.eigenvectors().col(e);
        double curvature = eigen.eigenvalues()(e);
        if (which == Directions::all) curvature = std::max(std::abs(curvature), least);
        if (!(curvature > least || (which == Directions::all && curvature > 0))) continue;
        const double farthest = reach.cwiseQuotient(direction.cwiseAbs()).minCoeff();
        step -= std::clamp(direction.dot(g) / curvature, -farthest, farthest) * direction;
    }
    return step;
}

/// Newton's step within the cube: where it leaves, the coordinate goes to its bound and the others follow.
VectorXd bounded_step(const Quadratic& model, std::span<const double> u, double part, Directions which) {
    const Index n = model.gradient.size();
    VectorXd step = VectorXd::Zero(n);
    std::vector<Index> inside(at(n));
    for (Index i = 0; i < n; ++i) inside[at(i)] = i;
    while (!inside.empty()) {
        const VectorXd slope = model.gradient + model.curvature * step;  // where the coordinates held stand
        const VectorXd found = newton(model.curvature(inside, inside), slope(inside), model.reach(inside), part, which);
        std::vector<Index> still;
        for (Index i = 0; i < found.size(); ++i) {
            const Index coordinate = inside[at(i)];
            const double x = u[at(model.free[at(coordinate)])];
            const double to = x + found(i) * model.unit(coordinate);
            if (to < 0) step(coordinate) = -x / model.unit(coordinate);
            else if (to > 1) step(coordinate) = (1 - x) / model.unit(coordinate);
            else still.push_back(coordinate);
        }
        if (still.size() == inside.size()) {
            step(inside) = found;
            break;
        }
        inside = std::move(still);
    }
    return step;
}

/// A step in the free coordinates as one of the cube.
std::vector<double> in_cube(const Quadratic& model, std::size_t dimension, const VectorXd& step) {
    std::vector<double> result(dimension, 0.0);
    for (Index i = 0; i < step.size(); ++i) result[at(model.free[at(i)])] = step(i) * model.unit(i);
    return result;
}

/// The point a step away, within the cube.
std::vector<double> moved(std::span<const double> u, std::span<const double> step, double length) {
    std::vector<double> point(u.begin(), u.end());
    for (std::size_t i = 0; i < point.size(); ++i) point[i] = std::clamp(point[i] + length * step[i], 0.0, 1.0);
    return point;
}

}  // namespace

Resolution resolution(kernels::Precision precision) {
    if (precision == kernels::Precision::double_precision) return {};
    return {1e-2, 1e-4, 1e-11, 1e-2};
}

Stationarity examine(const Objective& objective, std::span<const double> u, const Resolution& resolution,
                     const Objective& bends) {
    const std::size_t d = u.size();
    Stationarity result;
    std::vector<double> gradient(d);
    result.value = objective(u, gradient);
    result.step.assign(d, 0.0);
    std::vector<Index> free;
    for (std::size_t i = 0; i < d; ++i)
        if (!(u[i] <= 0 && gradient[i] > 0) && !(u[i] >= 1 && gradient[i] < 0)) free.push_back(static_cast<Index>(i));
    if (free.empty()) return result;
    Quadratic model;
    if (bends) {
        std::vector<double> slopes(d);
        const double value = bends(u, slopes);
        model = quadratic(bends, u, value, slopes, std::move(free), resolution);
    } else {
        model = quadratic(objective, u, result.value, gradient, std::move(free), resolution);
    }
    for (Index i = 0; i < model.unit.size(); ++i) model.gradient(i) = gradient[at(model.free[at(i)])] * model.unit(i);
    if (!model.curvature.allFinite()) {
        result.promised = HUGE_VAL;  // nothing can be said
        return result;
    }
    const VectorXd step = bounded_step(model, u, resolution.flat, Directions::resolved);
    result.promised = std::max(0.0, -(model.gradient.dot(step) + step.dot(model.curvature * step) / 2));
    result.step = in_cube(model, d, step);

    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(model.curvature);
    const double largest = eigen.eigenvalues().cwiseAbs().maxCoeff();
    for (Index e = 0; e < step.size(); ++e) {
        const double curvature = eigen.eigenvalues()(e);
        if (curvature > resolution.flat * largest) continue;
        const VectorXd direction = eigen.eigenvectors().col(e);
        const double farthest = model.reach.cwiseQuotient(direction.cwiseAbs()).minCoeff();
        // Not worth a look where neither the slope nor a downward curvature promises anything.
        const double gain =
            std::abs(direction.dot(model.gradient)) * farthest + std::max(0.0, -curvature) * farthest * farthest / 2;
        if (gain <= resolution.negligible(result.value)) continue;
        for (const double length : {1.0, 0.1, 0.01})
            for (const double sign : {-1.0, 1.0})
                result.doubtful.push_back(in_cube(model, d, sign * length * farthest * direction));
    }
    if (!result.doubtful.empty())
        for (const double part : {1e-10, 1e-8, 1e-6, 1e-4, 1e-2})
            result.doubtful.push_back(in_cube(model, d, bounded_step(model, u, part, Directions::all)));
    return result;
}

Minimum settle(const Objective& objective, Minimum end, const Resolution& resolution, const SearchControl& control,
               const Objective& bends) {
    if (end.stop == StopReason::time_limit || end.stop == StopReason::cancelled) return end;
    const auto stopped = [&](StopReason reason) {
        end.stop = reason;
        return end;
    };
    for (int round = 0; round < kRounds; ++round) {
        if (control.stop.stop_requested()) return stopped(StopReason::cancelled);
        if (control.over()) return stopped(StopReason::time_limit);
        const Stationarity look = examine(objective, end.u, resolution, bends);
        const double negligible = resolution.negligible(look.value);
        const bool minimum_of_model = look.promised <= negligible;
        end.loss2 = look.value;
        std::vector<double> best = end.u;
        double least = look.value;
        const auto try_step = [&](const std::vector<double>& step, double length) {
            std::vector<double> point = moved(end.u, step, length);
            const double value = objective(point, {});
            if (!(value < least)) return;
            best = std::move(point);
            least = value;
        };
        for (double length = 1; length > 1e-4 && !minimum_of_model && least == look.value; length /= 4)
            try_step(look.step, length);
        for (const std::vector<double>& step : look.doubtful) try_step(step, 1);
        // A step that was only feared to lead down has then been tried.
        if (look.value - least <= negligible && minimum_of_model) return stopped(StopReason::converged);
        const bool stuck = look.value - least <= negligible / 4;
        end.u = std::move(best);
        end.loss2 = least;
        // Steps one by one are slow in a bent valley.
        if (stuck || round % 4 == 3) {
            Minimum next = descend(objective, end.u, kDescentEvaluations, 1e-13, control);
            if (next.loss2 < end.loss2) {
                end.u = std::move(next.u);
                end.loss2 = next.loss2;
            }
        }
        if (look.value - end.loss2 <= negligible / 4) return stopped(StopReason::roundoff);
    }
    return stopped(StopReason::evaluation_limit);
}

}  // namespace brdfit::optim
