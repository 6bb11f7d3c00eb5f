#include "optim/profile.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Dense>
#include <boost/math/distributions/normal.hpp>

#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Of a parameter that the model is even in: below, it is 0, where it has no slope.
constexpr double kNought = 1e-3;

std::size_t at(Index i) { return static_cast<std::size_t>(i); }

/// The loss about a point: L + 2 g'd + d'(A + S)d.
struct Place {
    VectorXd z;
    double loss2 = 0;
    VectorXd g;
    MatrixXd a;  ///< Gauss and Newton's
    MatrixXd b;  ///< covariance of g by noise
};

/// Unknowns near bounds that a threshold takes account of, besides the one whose interval it is.
constexpr Index kMostNear = 2;
/// Standard errors within which a bound is near.
constexpr double kNear = 3;
constexpr std::size_t kDraws = 500;
using Few = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMostNear + 1, 1>;
using FewByFew = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kMostNear + 1, kMostNear + 1>;

/// Standard normal points, evenly spread: Halton's.
const std::vector<std::array<double, kMostNear + 1>>& draws() {
    static const auto instance = [] {
        constexpr std::array<std::size_t, kMostNear + 1> kBases{2, 3, 5};
        std::vector<std::array<double, kMostNear + 1>> points(kDraws);
        for (std::size_t d = 0; d < kBases.size(); ++d)
            for (std::size_t k = 0; k < kDraws; ++k) {
                double part = 1;
                double sum = 0;
                for (std::size_t i = k + 1; i > 0; i /= kBases[d]) {
                    part /= static_cast<double>(kBases[d]);
                    sum += part * static_cast<double>(i % kBases[d]);
                }
                points[k][d] = boost::math::quantile(boost::math::normal(), sum);
            }
        return points;
    }();
    return instance;
}

/// Least values of 2 g'd + d'hd over low <= d <= high, h positive definite: that of one face of the box, where d is
/// free or at a bound, coordinate by coordinate.
class Box {
public:
    Box(const FewByFew& h, const Few& low, const Few& high) : h_(h), low_(low), high_(high) {
        const Index n = h.rows();
        std::array<int, kMostNear + 1> state{};  // 0: free, 1: at the lower bound, 2: at the upper one
        for (Index i = 0; i < n;) {
            add(state);
            for (i = 0; i < n && ++state[at(i)] == 3; ++i) state[at(i)] = 0;
        }
    }

    [[nodiscard]] double least(const Few& g) const {
        double least = HUGE_VAL;
        for (const Face& face : faces_) {
            const Few d = face.held - face.inverse * (g + face.base);
            if ((d.array() >= low_.array()).all() && (d.array() <= high_.array()).all())
                least = std::min(least, 2 * g.dot(d) + d.dot(h_ * d));
        }
        return least;
    }

private:
    struct Face {
        Few held, base;
        FewByFew inverse;  ///< of the free part, 0 elsewhere
    };

    void add(const std::array<int, kMostNear + 1>& state) {
        const Index n = h_.rows();
        Face face{Few::Zero(n), Few::Zero(n), FewByFew::Zero(n, n)};
        std::vector<Index> free;
        for (Index i = 0; i < n; ++i) {
            if (state[at(i)] == 0) free.push_back(i);
            else face.held(i) = state[at(i)] == 1 ? low_(i) : high_(i);
            if (!std::isfinite(face.held(i)) || (state[at(i)] != 1 && low_(i) == high_(i))) return;
        }
        face.base = h_ * face.held;
        const MatrixXd inverse = MatrixXd(h_(free, free)).inverse();
        for (std::size_t i = 0; i < free.size(); ++i)
            for (std::size_t j = 0; j < free.size(); ++j)
                face.inverse(free[i], free[j]) = inverse(static_cast<Index>(i), static_cast<Index>(j));
        faces_.push_back(std::move(face));
    }

    FewByFew h_;
    Few low_, high_;
    std::vector<Face> faces_;
};

class Profile {
public:
    Profile(const Minimised& minimised, Refitter& refitter) : m_(minimised), refitter_(refitter) {
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = m_.unknowns[at(i)];
            const Interval& bounds = m_.bounds[at(i)];
            double low = c.own == Own::logarithm && !(bounds.min > 0) ? -HUGE_VAL : c.z(bounds.min);
            if (c.own == Own::square) low = std::max(low, kNought * kNought);
            lower_.push_back(low);
            upper_.push_back(std::max(low, c.z(bounds.max)));
        }
        VectorXd z(count());
        for (Index i = 0; i < count(); ++i)
            z(i) = std::clamp(m_.unknowns[at(i)].z(m_.unknowns[at(i)].p), lower_[at(i)], upper_[at(i)]);
        start_ = look(z);
    }

    std::vector<std::optional<std::array<double, 2>>> intervals() {
        std::vector<std::optional<std::array<double, 2>>> result(m_.unknowns.size());
        if (!std::isfinite(start_.loss2) || !start_.a.allFinite()) return result;
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = m_.unknowns[at(i)];
            if (!c.parameter) continue;
            const auto low = end(i, -1);
            const auto high = end(i, 1);
            if (!low || !high) continue;
            const Interval& bounds = m_.bounds[at(i)];
            const auto value = [&](double z) {
                if (z <= lower_[at(i)]) return bounds.min;
                return z >= upper_[at(i)] ? bounds.max : std::clamp(c.value(z), bounds.min, bounds.max);
            };
            result[at(i)] = {std::min(value(*low), c.p), std::max(value(*high), c.p)};
        }
        return result;
    }

private:
    [[nodiscard]] Index count() const { return static_cast<Index>(m_.unknowns.size()); }

    Place look(const VectorXd& z) {
        Point point = m_.point;
        std::vector<double> values;
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = m_.unknowns[at(i)];
            const double value = std::clamp(c.value(z(i)), m_.bounds[at(i)].min, m_.bounds[at(i)].max);
            values.push_back(value);
            (c.parameter ? point.parameters[*c.parameter] : point.scale) = value;
        }
        const kernels::Values there = refitter_.values(point, true);
        const Residuals residual = residuals(m_.task.weighted, there.f);
        const auto n = static_cast<Index>(there.f.size());
        VectorXd root(n), r(n);
        for (Index j = 0; j < n; ++j) {
            const double w = std::sqrt(m_.task.weighted.weight[at(j)]);
            root(j) = w * residual.by_f[at(j)];
            r(j) = w * residual.r[at(j)];
        }
        MatrixXd rows(n, count());
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = m_.unknowns[at(i)];
            const double* slopes = c.parameter ? there.by_parameter.data() + *c.parameter * at(n) : there.f.data();
            rows.col(i) =
                (c.parameter ? c.slope(values[at(i)]) : 1.0) * root.cwiseProduct(Eigen::Map<const VectorXd>(slopes, n));
        }
        Place result{z, residual.loss2, rows.transpose() * r, rows.transpose() * rows, {}};
        VectorXd noise(n);
        for (Index j = 0; j < n; ++j) noise(j) = std::sqrt(m_.task.weighted.weight[at(j)]) * m_.spreads(j);
        const MatrixXd shaken = noise.asDiagonal() * rows;
        result.b = shaken.transpose() * shaken;
        return result;
    }

    /// What the others do where one unknown moves by a step: the minimum of the loss's quadratic form within bounds.
    struct Response {
        VectorXd step;
        double loss2 = 0;      ///< there
        double slope = 0;      ///< half of the loss's, by the unknown, there
        double curvature = 0;  ///< of the profile
        double noise = 0;      ///< what the loss rises by one standard error
        VectorXd along;        ///< d unknowns/d the one
    };
    [[nodiscard]] Response respond(const Place& from, Index psi, double by, double damping) const {
        const MatrixXd whole = from.a + m_.misfit;
        if (const auto found = respond(from, whole, psi, by, damping)) return *found;
        return respond(from, from.a, psi, by, damping)
            .value_or(Response{VectorXd::Zero(count()), from.loss2, from.g(psi), from.a(psi, psi), 0,
                               VectorXd::Unit(count(), psi)});
    }

    /// None if h is not positive definite. By the method of active sets: from a feasible point to the minimum of those
    /// that are not held, up to the first bound in the way, which then holds; at a minimum the bound that pushes most
    /// is let go.
    [[nodiscard]] std::optional<Response> respond(const Place& from, const MatrixXd& h, Index psi, double by,
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
            low(i) = (lower_[at(i)] - from.z(i)) / unit(i);
            high(i) = (upper_[at(i)] - from.z(i)) / unit(i);
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

    /// From a place to an unknown's bound, in that unit of it.
    [[nodiscard]] double room(const Place& here, Index i, double unit, bool up) const {
        return (up ? upper_[at(i)] - here.z(i) : lower_[at(i)] - here.z(i)) / unit;
    }

    /// A place as one unknown is tested there: in units that make the curvature's diagonal 1.
    struct Tested {
        VectorXd unit;
        MatrixXd h, b;
        std::vector<Index> others;
        /// Of them those with a bound at hand, nearest first: standard errors to it, infinite if it is not left.
        std::vector<std::pair<double, Index>> near;
    };
    [[nodiscard]] Tested tested(const Place& here, Index psi) const {
        Tested result;
        auto& [unit, h, b, others, near] = result;
        h = here.a + m_.misfit;
        unit = h.diagonal().cwiseAbs().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
        h = unit.asDiagonal() * h * unit.asDiagonal();
        h.diagonal().array() += 1e-10;
        b = unit.asDiagonal() * here.b * unit.asDiagonal();
        for (Index i = 0; i < count(); ++i)
            if (i != psi && lower_[at(i)] < upper_[at(i)]) others.push_back(i);
        if (!others.empty()) {
            const MatrixXd inverse = h(others, others).inverse();
            const MatrixXd cov = inverse * b(others, others) * inverse;
            for (Index k = 0; k < cov.rows(); ++k) {
                const Index i = others[at(k)];
                const double error = std::sqrt(std::max(cov(k, k), 0.0));
                const double distance =
                    std::min(-room(here, i, unit(i), false), room(here, i, unit(i), true)) / std::max(error, 1e-300);
                // A bound that holds back more than noise pushes is not left.
                const double pushed = std::abs(here.g(i)) * unit(i) / std::sqrt(std::max(b(i, i), 1e-300));
                if (distance < kNear && !(distance <= 0 && pushed > kNear)) near.emplace_back(distance, i);
                else if (distance <= 0) near.emplace_back(HUGE_VAL, i);
            }
        }
        std::sort(near.begin(), near.end());
        return result;
    }

    /// Where an unknown stands at its lower bound, another is held, and the rest make up for it. None if the loss has
    /// no minimum there.
    std::optional<Place> at_lower_bound(const Place& from, Index i, Index held, double close) {
        constexpr int kMostSteps = 12;
        const auto [low, high] = std::pair{lower_[at(held)], upper_[at(held)]};
        lower_[at(held)] = upper_[at(held)] = from.z(held);
        std::optional<Place> result;
        double damping = 0;
        for (int k = 0; k < kMostSteps && !m_.task.control.over(); ++k) {
            const Place& at_hand = result ? *result : from;
            const double by = lower_[at(i)] - at_hand.z(i);
            VectorXd z = at_hand.z + respond(at_hand, i, by, damping).step;
            for (Index j = 0; j < count(); ++j) z(j) = std::clamp(z(j), lower_[at(j)], upper_[at(j)]);
            Place there = look(z);
            if (!std::isfinite(there.loss2) || !there.a.allFinite() || !there.g.allFinite()) break;
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
        lower_[at(held)] = low;
        upper_[at(held)] = high;
        return result;
    }

    /// The same as threshold(), or what it is if k is 0 in truth, as any dielectric's is, and only noise lifts it, if
    /// that is more: the noise that shows at the estimate of k may be far from the truth's.
    double safe_threshold(const Place& here, Index psi, double noise, double degrees, double close) {
        double most = threshold(here, psi, noise, degrees);
        for (const auto& [distance, i] : tested(here, psi).near) {
            const bool lower = here.z(i) - lower_[at(i)] < upper_[at(i)] - here.z(i);
            if (m_.unknowns[at(i)].own != Own::square || !lower || distance <= 0 || !std::isfinite(distance)) continue;
            const auto there = at_lower_bound(here, i, psi, close);
            if (!there || there->loss2 - here.loss2 > kNear * kNear * respond(here, i, 0, 0).noise) continue;
            most = std::max(most, threshold(*there, psi, respond(*there, psi, 0, 0).noise, degrees));
        }
        return most;
    }

    /// By what the loss's profile rises above its minimum at most in 95 % of cases, if the truth is here: noise^2 t^2
    /// where no bound is near, and what repetition in the quadratic form and its bounds says elsewhere.
    [[nodiscard]] double threshold(const Place& here, Index psi, double noise, double degrees) const {
        const double t = standard_errors_of_interval(degrees);
        const auto [unit, h, b, others, near] = tested(here, psi);
        const Index n = count();
        std::vector<Index> kept{psi}, free;
        for (const auto& [distance, i] : near)
            if (std::isfinite(distance) && kept.size() <= at(kMostNear)) kept.push_back(i);
        for (const Index i : others) {
            const bool is_kept = std::find(kept.begin(), kept.end(), i) != kept.end();
            const bool is_held = here.z(i) <= lower_[at(i)] || here.z(i) >= upper_[at(i)];
            if (!is_kept && !is_held) free.push_back(i);
        }
        MatrixXd to = MatrixXd::Zero(static_cast<Index>(kept.size()), n);
        for (std::size_t k = 0; k < kept.size(); ++k) to(static_cast<Index>(k), kept[k]) = 1;
        MatrixXd left = h(kept, kept);
        if (!free.empty()) {
            const MatrixXd back = h(free, free).ldlt().solve(h(free, kept));
            left -= h(kept, free) * back;
            for (std::size_t k = 0; k < free.size(); ++k)
                to.col(free[k]) = -back.row(static_cast<Index>(k)).transpose();
        }
        const MatrixXd shaken = to * b * to.transpose();
        const double error = std::sqrt(shaken(0, 0)) / left(0, 0);
        const double to_low = -room(here, psi, unit(psi), false) / error;
        const double to_high = room(here, psi, unit(psi), true) / error;
        if (kept.size() == 1 && to_low > kNear && to_high > kNear) return t * t * noise;
        const auto m = static_cast<Index>(kept.size());
        Few low(m), high(m);
        for (Index k = 0; k < m; ++k) {
            const Index i = kept[at(k)];
            low(k) = std::min(room(here, i, unit(i), false), 0.0);
            high(k) = std::max(room(here, i, unit(i), true), 0.0);
            if (k > 0 && -low(k) < high(k)) high(k) = HUGE_VAL;  // the nearer one counts
            else if (k > 0) low(k) = -HUGE_VAL;
        }
        if (to_low > 2 * kNear) low(0) = -HUGE_VAL;
        if (to_high > 2 * kNear) high(0) = HUGE_VAL;
        if (!left.allFinite() || !shaken.allFinite()) return t * t * noise;
        const Box all(left, low, high);
        low(0) = high(0) = 0;
        const Box fixed(left, low, high);
        const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(shaken);
        const FewByFew root = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0).cwiseSqrt().asDiagonal();
        std::vector<double> rises;
        for (const auto& draw : draws()) {
            const Few g = root * Eigen::Map<const VectorXd>(draw.data(), m);
            rises.push_back(std::max(fixed.least(g) - all.least(g), 0.0));
        }
        const auto place = rises.begin() + static_cast<std::ptrdiff_t>(kConfidence * kDraws);
        std::nth_element(rises.begin(), place, rises.end());
        const double wider = t / standard_errors_of_interval(HUGE_VAL);
        return *place * wider * wider;
    }

    /// The end of the unknown's interval to a side; none if the time is over.
    std::optional<double> end(Index psi, int side) {
        constexpr int kMostLooks = 40;
        constexpr double kClose = 0.02;
        constexpr double kMostChange = 3;  // of noise, from the estimate on: beyond, a term has vanished
        const double bound = side < 0 ? lower_[at(psi)] : upper_[at(psi)];
        const double centre = start_.z(psi);
        if (centre == bound) return bound;
        const double size = m_.unknowns[at(psi)].size(m_.task.model);
        const double degrees = std::max(m_.degrees[at(psi)], 1.0);
        Place from = start_;
        const Response first = respond(start_, psi, 0, 0);
        const double least = std::min(start_.loss2, first.loss2);
        VectorXd before_along, bend;
        double before_z = NAN;
        double inner = centre;                                     // of the interval
        double outer = side * HUGE_VAL;                            // not of it
        double inner_excess = -HUGE_VAL, outer_excess = HUGE_VAL;  // of the root over its reach
        double most = size;
        double damping = 0;
        bool still = false, refused = false;
        double reach = standard_errors_of_interval(degrees);
        double judged = NAN;  // where reach was found
        for (int k = 0; k < kMostLooks; ++k) {
            if (m_.task.control.over()) return std::nullopt;
            Response here = respond(from, psi, 0, 0);
            if (still) here.loss2 = from.loss2;
            here.noise = here.noise > 0 ? std::clamp(here.noise, first.noise / kMostChange, first.noise * kMostChange)
                                        : first.noise;
            const double z = from.z(psi);
            const double rise = std::max(here.loss2 - least, 0.0);
            const double unit = std::max(here.noise, 1e-300);
            const double root = std::sqrt(rise / unit);
            bool settled = k == 0 || still || from.loss2 - here.loss2 <= kClose * reach * reach * unit;
            if (k > 0 && settled && std::abs(reach - root) < 0.4 * reach && z != judged) {
                // The noise at the estimate or here, whichever is more: bent, the profile shows both.
                const double more = std::max(1.0, first.noise / here.noise);
                reach = std::sqrt(more * safe_threshold(from, psi, here.noise, degrees, kClose * reach * reach * unit) /
                                  unit);
                settled = still || from.loss2 - here.loss2 <= kClose * reach * reach * unit;
                judged = z;
            }
            const double enough = reach * reach * unit;
            double to = z;
            if (settled) {
                if (std::isfinite(before_z) && z != before_z) bend = (here.along - before_along) / (z - before_z);
                if (!(z == before_z)) before_z = z, before_along = here.along;
                if (root < reach && z == bound) return bound;
                if (root < reach && side * (z - inner) > 0) inner = z, inner_excess = root - reach;
                if (root >= reach && side * (outer - z) > 0) outer = z, outer_excess = root - reach;
                const double outward = side * here.slope;  // half the slope of the rise
                if (k == 0 || root < 1e-3) {
                    const double off = std::max(outward, 0.0);  // rise = 2 off x + curvature x^2
                    to = z + side * (-off + std::sqrt(off * off + here.curvature * enough)) / here.curvature;
                } else if (outward > 0) {
                    to = z + side * (reach - root) * root * unit / outward;  // Newton's step: the root is nearly linear
                } else {
                    to = z + side * std::max(std::abs(z - centre), 0.1 * size);
                }
                if (!std::isfinite(to)) to = z + side * size;
                to = std::clamp(to, lower_[at(psi)], upper_[at(psi)]);
                if (k > 0 && std::abs(reach - root) <= kClose * reach) return to;
                const double far = most;
                to = std::clamp(to, z - far, z + far);
                if (side * (to - inner) < 0) to = inner;
                if (std::isfinite(outer)) {  // between what is known
                    const double share = std::isfinite(inner_excess)
                                             ? std::clamp(inner_excess / (inner_excess - outer_excess), 0.1, 0.9)
                                             : 0.5;
                    to = inner + share * (outer - inner);
                    to = std::clamp(to, z - most, z + most);
                }
                if (std::abs(outer - inner) < 1e-3 * std::abs(outer - centre)) return inner;
            }
            const double by = to - z;
            if (by != 0 && still) {  // at the minimum, whatever the quadratic form says
                for (Index i = 0; i < count(); ++i)
                    if (i != psi && from.z(i) > lower_[at(i)] && from.z(i) < upper_[at(i)]) from.g(i) = 0;
            }
            Response next = respond(from, psi, by, damping);
            double factor = 1;
            for (Index i = 0; i < count(); ++i)
                if (i != psi)
                    factor = std::min(
                        factor, m_.unknowns[at(i)].size(m_.task.model) / std::max(std::abs(next.step(i)), 1e-300));
            const VectorXd step = next.step * factor;
            VectorXd z_next = from.z + step;
            if (by != 0 && bend.size() > 0 && factor == 1) {
                VectorXd more = 0.5 * by * by * bend;
                more(psi) = 0;
                if (more.cwiseAbs().maxCoeff() < step.cwiseAbs().maxCoeff()) z_next += more;
            }
            for (Index i = 0; i < count(); ++i) z_next(i) = std::clamp(z_next(i), lower_[at(i)], upper_[at(i)]);
            if (factor == 1) z_next(psi) = to;
            const double expected = from.loss2 + 2 * from.g.dot(step) + step.dot((from.a + m_.misfit) * step);
            Place there = look(z_next);
            const bool finite = std::isfinite(there.loss2) && there.a.allFinite() && there.g.allFinite();
            const bool fine = finite && (by == 0 ? there.loss2 <= from.loss2 : there.loss2 - expected <= 0.5 * enough);
            if (fine) {
                still = by == 0 && from.loss2 - there.loss2 <= 0.25 * kClose * enough;
                from = std::move(there);
                damping = damping > 1e-3 ? damping / 5 : 0;
                if (by != 0) most = std::max(most, (refused ? 1.3 : 2) * std::abs(by)), refused = false;
            } else if (by == 0) {
                still = damping > 1e4;
                damping = std::max(1e-2, 5 * damping);
            } else {
                most = 0.35 * std::abs(by) * factor, refused = true;
            }
        }
        const double wald =
            std::clamp(centre + side * standard_errors_of_interval(degrees) * std::sqrt(first.noise / first.curvature),
                       lower_[at(psi)], upper_[at(psi)]);
        return side * (wald - inner) > 0 ? wald : inner;
    }

    const Minimised& m_;
    Refitter& refitter_;
    std::vector<double> lower_, upper_;
    Place start_;
};

}  // namespace

std::vector<std::optional<std::array<double, 2>>> profile_intervals(const Minimised& minimised, Refitter& refitter) {
    return Profile(minimised, refitter).intervals();
}

}  // namespace brdfit::optim
