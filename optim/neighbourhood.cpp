#include "optim/neighbourhood.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Dense>

#include "optim/index.h"
#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Of a parameter that the model is even in: below, it is 0, where it has no slope.
constexpr double kNought = 1e-3;

}  // namespace

bool Place::is_finite() const { return std::isfinite(loss2) && a.allFinite() && g.allFinite(); }

Neighbourhood::Neighbourhood(const Minimised& minimised, Refitter& refitter)
    : minimised_(minimised), refitter_(refitter), lower_(count()), upper_(count()) {
    for (Index i = 0; i < count(); ++i) {
        const Coordinate& c = unknown(i);
        const Interval& bounds = minimised_.bounds[at(i)];
        double low = c.own == Own::logarithm && !(bounds.min > 0) ? -HUGE_VAL : c.z(bounds.min);
        if (c.own == Own::square) low = std::max(low, kNought * kNought);
        lower_(i) = low;
        upper_(i) = std::max(low, c.z(bounds.max));
    }
    VectorXd z(count());
    for (Index i = 0; i < count(); ++i) z(i) = unknown(i).z(unknown(i).p);
    start_ = look(bounded(std::move(z)));
    if (minimised_.misfit.isZero(0)) return;
    const MatrixXd whole = bend(start_);
    const double share = whole.cwiseProduct(minimised_.misfit).sum() / whole.squaredNorm();
    if (std::isfinite(share)) share_ = std::clamp(share, 0.0, 1.0);
}

double Neighbourhood::value(Index i, double z) const {
    const Interval& bounds = minimised_.bounds[at(i)];
    if (z <= lower_(i)) return bounds.min;
    return z >= upper_(i) ? bounds.max : std::clamp(unknown(i).value(z), bounds.min, bounds.max);
}

VectorXd Neighbourhood::bounded(VectorXd z) const {
    for (Index i = 0; i < count(); ++i) z(i) = std::clamp(z(i), lower_(i), upper_(i));
    return z;
}

Point Neighbourhood::point_at(const VectorXd& z, VectorXd& slopes) const {
    Point point = minimised_.point;
    slopes.resize(count());
    for (Index i = 0; i < count(); ++i) {
        const Coordinate& c = unknown(i);
        const double value = std::clamp(c.value(z(i)), minimised_.bounds[at(i)].min, minimised_.bounds[at(i)].max);
        slopes(i) = c.parameter ? c.slope(value) : 1.0;
        (c.parameter ? point.parameters[*c.parameter] : point.scale) = value;
    }
    return point;
}

Place Neighbourhood::look(const VectorXd& z) const {
    VectorXd own;
    const Point point = point_at(z, own);
    const kernels::Values& there = refitter_.values(point, true);
    const Residuals residual = residuals(minimised_.task.weighted, there.f);
    const auto n = static_cast<Index>(there.f.size());
    VectorXd root(n), r(n);
    for (Index j = 0; j < n; ++j) {
        const double w = std::sqrt(minimised_.task.weighted.weight[at(j)]);
        root(j) = w * residual.by_f[at(j)];
        r(j) = w * residual.r[at(j)];
    }
    MatrixXd rows(n, count());
    for (Index i = 0; i < count(); ++i) {
        const Coordinate& c = unknown(i);
        const double* slopes = c.parameter ? there.by_parameter.data() + *c.parameter * at(n) : there.f.data();
        rows.col(i) = own(i) * root.cwiseProduct(Eigen::Map<const VectorXd>(slopes, n));
    }
    Place result{z, residual.loss2, rows.transpose() * r, rows.transpose() * rows, {}, minimised_.misfit};
    VectorXd noise(n);
    for (Index j = 0; j < n; ++j) noise(j) = std::sqrt(minimised_.task.weighted.weight[at(j)]) * minimised_.spreads(j);
    const MatrixXd shaken = noise.asDiagonal() * rows;
    result.b = shaken.transpose() * shaken;
    return result;
}

MatrixXd Neighbourhood::bend(const Place& place) const {
    constexpr double kShort = 0.5;  // standard errors of one unknown, the others known
    constexpr double kLong = 0.03;  // of a large step
    std::vector<VectorXd> ends;
    for (Index i = 0; i < count(); ++i) {
        const double step = std::min(kLong * size(i), kShort * std::sqrt(place.b(i, i)) / place.a(i, i));
        const VectorXd aside = step * VectorXd::Unit(count(), i);
        ends.push_back(bounded(place.z - aside));
        ends.push_back(bounded(place.z + aside));
    }
    std::vector<Point> points;
    MatrixXd own(count(), static_cast<Index>(ends.size()));
    VectorXd slopes;
    for (const VectorXd& end : ends) {
        points.push_back(point_at(end, slopes));
        own.col(static_cast<Index>(points.size()) - 1) = slopes;
    }
    const std::size_t p = minimised_.task.model.parameters.size();
    const std::vector<double> half = refitter_.half_slopes(points);
    const auto slope = [&](Index i, Index k) {
        return own(i, k) * half[at(k) * (p + 1) + unknown(i).parameter.value_or(p)];
    };
    MatrixXd h(count(), count());
    for (Index i = 0; i < count(); ++i) {
        const double width = ends[at(2 * i + 1)](i) - ends[at(2 * i)](i);
        for (Index j = 0; j < count(); ++j) h(j, i) = (slope(j, 2 * i + 1) - slope(j, 2 * i)) / width;
    }
    return (h + h.transpose()) / 2 - place.a;
}

Place Neighbourhood::with_own_misfit(Place place) const {
    if (!(share_ > 0)) return place;
    const MatrixXd s = share_ * bend(place);
    if (s.allFinite()) place.s = s;
    return place;
}

Response Neighbourhood::respond(const Place& from, Index psi, double by, double damping) const {
    const MatrixXd whole = from.a + from.s;
    if (const auto found = respond(from, whole, psi, by, damping)) return *found;
    return respond(from, from.a, psi, by, damping)
        .value_or(Response{VectorXd::Zero(count()), from.loss2, from.g(psi), from.a(psi, psi), 0,
                           VectorXd::Unit(count(), psi)});
}

/// By the method of active sets: from a feasible point to the minimum of those that are not held, up to the first bound
/// in the way, which then holds; at a minimum the bound that pushes most is let go.
std::optional<Response> Neighbourhood::respond(const Place& from, const MatrixXd& h, Index psi, double by,
                                               double damping) const {
    constexpr double kRidge = 1e-10;
    const Index n = count();
    VectorXd unit = h.diagonal().cwiseAbs().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    MatrixXd q = unit.asDiagonal() * h * unit.asDiagonal();  // in units that make its diagonal 1
    q.diagonal().array() += kRidge + damping;
    const VectorXd g = unit.cwiseProduct(from.g);
    std::vector<bool> held(at(n), false);
    VectorXd x = VectorXd::Zero(n);  // step in those units
    x(psi) = by / unit(psi);
    VectorXd low(n), high(n);
    for (Index i = 0; i < n; ++i) {
        low(i) = (lower_(i) - from.z(i)) / unit(i);
        high(i) = (upper_(i) - from.z(i)) / unit(i);
        held[at(i)] = i == psi || low(i) >= 0 || high(i) <= 0;
    }
    std::vector<Index> inside;
    Eigen::LDLT<MatrixXd> solver;
    for (int round = 0; round < 50; ++round) {
        inside.clear();
        for (Index i = 0; i < n; ++i)
            if (!held[at(i)]) inside.push_back(i);
        const VectorXd slope = g + q * x;
        Index blocked = -1;
        if (!inside.empty()) {
            solver.compute(q(inside, inside));
            if (solver.info() != Eigen::Success || !(solver.vectorD().minCoeff() > 0)) return std::nullopt;
            const VectorXd found = -solver.solve(VectorXd(slope(inside)));
            double part = 1;
            for (Index k = 0; k < found.size(); ++k) {
                const Index i = inside[at(k)];
                const double room = found(k) < 0 ? low(i) - x(i) : high(i) - x(i);
                if (std::abs(found(k)) * part > std::abs(room)) part = room / found(k), blocked = i;
            }
            for (Index k = 0; k < found.size(); ++k) x(inside[at(k)]) += part * found(k);
            if (blocked >= 0) {
                x(blocked) = x(blocked) - low(blocked) < high(blocked) - x(blocked) ? low(blocked) : high(blocked);
                held[at(blocked)] = true;
                continue;
            }
        }
        const VectorXd push = g + q * x;
        Index freed = -1;
        double most = 1e-9 * std::sqrt(std::max(from.loss2, 0.0));
        for (Index i = 0; i < n; ++i) {
            if (!held[at(i)] || i == psi || !(low(i) < high(i))) continue;
            const double wrong = x(i) <= low(i) ? -push(i) : push(i);
            if (wrong > most) most = wrong, freed = i;
        }
        if (freed < 0) break;
        held[at(freed)] = false;
    }
    Response result;
    result.step = unit.cwiseProduct(x);
    result.loss2 = from.loss2 + 2 * from.g.dot(result.step) + result.step.dot(h * result.step);
    result.slope = from.g(psi) + h.row(psi).dot(result.step);
    VectorXd along = VectorXd::Zero(n);
    along(psi) = 1;
    if (!inside.empty()) {
        const VectorXd column = q.col(psi)(inside) / unit(psi);
        const VectorXd back = -solver.solve(column);
        for (Index k = 0; k < back.size(); ++k) along(inside[at(k)]) = unit(inside[at(k)]) * back(k);
    }
    result.curvature = along.dot(h * along);
    result.noise = along.dot(from.b * along) / result.curvature;
    result.along = std::move(along);
    return result;
}

std::optional<Place> Neighbourhood::at_lower_bound(const Place& from, Index i, Index held, double close) const {
    constexpr int kMostSteps = 12;
    Neighbourhood without = *this;
    without.lower_(held) = without.upper_(held) = from.z(held);
    std::optional<Place> result;
    double damping = 0;
    for (int k = 0; k < kMostSteps && !control().over(); ++k) {
        const Place& at_hand = result ? *result : from;
        const double by = lower_(i) - at_hand.z(i);
        Place there = look(without.bounded(at_hand.z + without.respond(at_hand, i, by, damping).step));
        if (!there.is_finite()) break;
        const double gain = at_hand.loss2 - there.loss2;
        if (!result || gain > 0) {
            const bool done = result && gain <= close;
            result = std::move(there);
            damping = damping > 1e-3 ? damping / 5 : 0;
            if (done) break;
        } else {
            damping = std::max(1e-2, 5 * damping);
        }
    }
    return result;
}

}  // namespace brdfit::optim
