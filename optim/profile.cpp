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
/// By what noise elsewhere is more than at the estimate so that it counts. Less does not: at an estimate it is as often
/// too large as too small, which makes up for it.
constexpr double kMuchMore = 1.3;
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

    std::vector<std::optional<std::array<double, 2>>> intervals();

private:
    class End;

    /// A place on the way to another unknown's end: as far from the minimum as noise may well bring it.
    struct Elsewhere {
        Place place;
        Index psi;     ///< whose end
        double share;  ///< of what the loss rises by up to there
    };

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

    [[nodiscard]] static bool is_finite(const Place& place) {
        return std::isfinite(place.loss2) && place.a.allFinite() && place.g.allFinite();
    }
    [[nodiscard]] VectorXd bounded(VectorXd z) const {
        for (Index i = 0; i < count(); ++i) z(i) = std::clamp(z(i), lower_[at(i)], upper_[at(i)]);
        return z;
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

    /// What one standard error of an unknown lifts the loss by where other unknowns' profiles lead, less the share of
    /// it that it took to get there: the most there is. Noise shakes an estimate as it does at the truth, and an
    /// interval that is narrow where the others are found to be may be wide where they are.
    [[nodiscard]] double noise_elsewhere(Index psi, const std::vector<Elsewhere>& places) const {
        double most = 0;
        for (const Elsewhere& elsewhere : places) {
            if (elsewhere.psi == psi) continue;
            const double noise = (1 - elsewhere.share) * respond(elsewhere.place, psi, 0, 0).noise;
            if (std::isfinite(noise)) most = std::max(most, noise);
        }
        return most;
    }

    /// Whether at a place any unknown but one sees much more noise than at the minimum.
    [[nodiscard]] bool has_more_noise(const Place& place, Index but) const {
        for (Index i = 0; i < count(); ++i)
            if (i != but && respond(place, i, 0, 0).noise > kMuchMore * respond(start_, i, 0, 0).noise) return true;
        return false;
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
            Place there = look(bounded(std::move(z)));
            if (!is_finite(there)) break;
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

    const Minimised& m_;
    Refitter& refitter_;
    std::vector<double> lower_, upper_;
    Place start_;
};

/// One end of an unknown's interval: where the profile of the loss has risen as far as noise lifts it. Newton's method
/// on the root of the rise, which is nearly linear, the others following by damped Gauss-Newton steps.
class Profile::End {
public:
    End(Profile& profile, Index psi, int side)
        : profile_(profile),
          psi_(psi),
          side_(side),
          bound_((side < 0 ? profile.lower_ : profile.upper_)[at(psi)]),
          centre_(profile.start_.z(psi)),
          size_(profile.m_.unknowns[at(psi)].size(profile.m_.task.model)),
          degrees_(std::max(profile.m_.degrees[at(psi)], 1.0)),
          first_(profile.respond(profile.start_, psi, 0, 0)),
          least_(std::min(profile.start_.loss2, first_.loss2)),
          bracket_(centre_, side),
          from_(profile.start_),
          reach_(standard_errors_of_interval(degrees_)),
          most_(size_) {}

    void find() { end_ = centre_ == bound_ ? bound_ : search(true); }
    /// On the unknown's own scale; none if the time was over.
    [[nodiscard]] std::optional<double> z() const { return end_; }
    [[nodiscard]] Index psi() const { return psi_; }

    /// Adds places on the way to the end, by the bend that the valley has up to there.
    void add_places(std::vector<Elsewhere>& all) const {
        constexpr std::array kParts{0.35, 0.65};  // of the way
        if (!found_ || !profile_.has_more_noise(from_, psi_)) return;
        const double whole = from_.z(psi_) - centre_;
        const VectorXd bend = from_.z - profile_.start_.z - whole * first_.along;
        for (const double part : kParts) {
            Place there =
                profile_.look(profile_.bounded(profile_.start_.z + part * whole * first_.along + part * part * bend));
            if (!is_finite(there)) continue;
            const double share = std::max(profile_.respond(there, psi_, 0, 0).loss2 - least_, 0.0) / allowed();
            if (share < 1) all.push_back({std::move(there), psi_, share});
        }
    }

    /// Finds the end anew, farther out, if elsewhere one standard error lifts the loss by so much that it matters.
    /// noise: the most that is left for this unknown.
    void allow_for(double noise) {
        const double t = standard_errors_of_interval(degrees_);
        if (!found_ || !(t * t * noise > kMuchMore * allowed())) return;
        floor_ = t * t * noise;
        bracket_ = Bracket(centre_, side_);
        judged_ = NAN;
        const auto farther = search(false);
        if (farther && side_ * (*farther - *end_) > 0) end_ = farther;
    }

private:
    static constexpr double kClose = 0.02;

    std::optional<double> search(bool at_start) {
        constexpr int kMostLooks = 40;
        found_ = false;
        for (int k = 0; k < kMostLooks; ++k, at_start = false) {
            if (profile_.m_.task.control.over()) return std::nullopt;
            judge(at_start);
            double to = from_.z(psi_);
            if (settled_) {
                if (root_ < reach_ && to == bound_) return bound_;
                follow();
                bracket_.add(to, root_ - reach_);
                to = next(at_start);
                found_ = !at_start && std::abs(reach_ - root_) <= kClose * reach_;
                if (found_) return to;
                if (bracket_.closed()) return bracket_.inner();
                to = bracket_.narrowed(to, from_.z(psi_), most_);
            }
            step(to);
        }
        return linear();
    }

    /// What is known of where the end lies.
    class Bracket {
    public:
        Bracket(double centre, int side) : side_(side), centre_(centre), inner_(centre), outer_(side * HUGE_VAL) {}

        /// excess: of the root of the rise over its reach; below 0 within the interval.
        void add(double z, double excess) {
            if (excess < 0 && side_ * (z - inner_) > 0) inner_ = z, inner_excess_ = excess;
            if (excess >= 0 && side_ * (outer_ - z) > 0) outer_ = z, outer_excess_ = excess;
        }
        /// The farthest value that is known to belong to the interval.
        [[nodiscard]] double inner() const { return inner_; }
        [[nodiscard]] bool closed() const { return std::abs(outer_ - inner_) < 1e-3 * std::abs(outer_ - centre_); }
        /// In place of `to` a value within what is known, no farther than `most` from z.
        [[nodiscard]] double narrowed(double to, double z, double most) const {
            to = std::clamp(to, z - most, z + most);
            if (side_ * (to - inner_) < 0) to = inner_;
            if (!std::isfinite(outer_)) return to;
            const double share = std::isfinite(inner_excess_)
                                     ? std::clamp(inner_excess_ / (inner_excess_ - outer_excess_), 0.1, 0.9)
                                     : 0.5;
            return std::clamp(inner_ + share * (outer_ - inner_), z - most, z + most);
        }

    private:
        int side_;
        double centre_, inner_, outer_;
        double inner_excess_ = -HUGE_VAL, outer_excess_ = HUGE_VAL;
    };

    /// How far the profile has risen where the search stands, against how far it may, and whether the others have
    /// followed closely enough to tell.
    void judge(bool at_start) {
        constexpr double kMostChange = 3;  // of noise, from the estimate on: beyond, a term has vanished
        here_ = profile_.respond(from_, psi_, 0, 0);
        if (still_) here_.loss2 = from_.loss2;
        here_.noise = here_.noise > 0 ? std::clamp(here_.noise, first_.noise / kMostChange, first_.noise * kMostChange)
                                      : first_.noise;
        unit_ = std::max(here_.noise, 1e-300);
        root_ = std::sqrt(std::max(here_.loss2 - least_, 0.0) / unit_);
        reach_ = std::max(reach_, std::sqrt(floor_ / unit_));
        settled_ = at_start || follows();
        if (at_start || !settled_ || std::abs(reach_ - root_) >= 0.4 * reach_ || from_.z(psi_) == judged_) return;
        // The noise at the estimate or here, whichever is more: bent, the profile shows both.
        const double more = std::max(1.0, first_.noise / here_.noise);
        reach_ = std::sqrt(
            std::max(more * profile_.safe_threshold(from_, psi_, here_.noise, degrees_, close()), floor_) / unit_);
        settled_ = follows();
        judged_ = from_.z(psi_);
    }
    /// By what loss^2 may rise.
    [[nodiscard]] double allowed() const { return reach_ * reach_ * unit_; }
    /// Of that what is hardly more than nothing.
    [[nodiscard]] double close() const { return kClose * allowed(); }
    [[nodiscard]] bool follows() const { return still_ || from_.loss2 - here_.loss2 <= close(); }

    /// Learns how the valley bends.
    void follow() {
        const double z = from_.z(psi_);
        if (z == before_z_) return;
        if (std::isfinite(before_z_)) bend_ = (here_.along - before_along_) / (z - before_z_);
        before_z_ = z;
        before_along_ = here_.along;
    }

    /// Where the end would be by the slope of the rise.
    [[nodiscard]] double next(bool at_start) const {
        const double z = from_.z(psi_);
        const double outward = side_ * here_.slope;  // half the slope of the rise
        double to = z;
        if (at_start || root_ < 1e-3) {
            const double off = std::max(outward, 0.0);  // rise = 2 off x + curvature x^2
            to += side_ * (-off + std::sqrt(off * off + here_.curvature * allowed())) / here_.curvature;
        } else if (outward > 0) {
            to += side_ * (reach_ - root_) * root_ * unit_ / outward;
        } else {
            to += side_ * std::max(std::abs(z - centre_), 0.1 * size_);
        }
        if (!std::isfinite(to)) to = z + side_ * size_;
        return std::clamp(to, profile_.lower_[at(psi_)], profile_.upper_[at(psi_)]);
    }

    /// Moves the unknown to a value, if the loss there is what was expected, or has the others follow once more.
    void step(double to) {
        const double by = to - from_.z(psi_);
        if (by != 0 && still_) forget_slopes();
        const VectorXd whole = profile_.respond(from_, psi_, by, damping_).step;
        const double factor = shortening(whole);
        const VectorXd step = whole * factor;
        const Place there = profile_.look(landing(step, to, by, factor));
        const double expected = from_.loss2 + 2 * from_.g.dot(step) + step.dot((from_.a + profile_.m_.misfit) * step);
        if (is_finite(there) && (by == 0 ? there.loss2 <= from_.loss2 : there.loss2 - expected <= 0.5 * allowed())) {
            still_ = by == 0 && from_.loss2 - there.loss2 <= 0.25 * close();
            from_ = there;
            damping_ = damping_ > 1e-3 ? damping_ / 5 : 0;
            if (by == 0) return;
            most_ = std::max(most_, (refused_ ? 1.3 : 2) * std::abs(by));
            refused_ = false;
        } else if (by == 0) {
            still_ = damping_ > 1e4;
            damping_ = std::max(1e-2, 5 * damping_);
        } else {
            most_ = 0.35 * std::abs(by) * factor;
            refused_ = true;
        }
    }
    /// Of the others: they are at the minimum, whatever the quadratic form says.
    void forget_slopes() {
        for (Index i = 0; i < profile_.count(); ++i)
            if (i != psi_ && from_.z(i) > profile_.lower_[at(i)] && from_.z(i) < profile_.upper_[at(i)]) from_.g(i) = 0;
    }
    /// By what a step is too long for an unknown, 1 if for none.
    [[nodiscard]] double shortening(const VectorXd& step) const {
        double factor = 1;
        for (Index i = 0; i < profile_.count(); ++i)
            if (i != psi_)
                factor = std::min(factor, profile_.m_.unknowns[at(i)].size(profile_.m_.task.model) /
                                              std::max(std::abs(step(i)), 1e-300));
        return factor;
    }
    /// Where a step ends, along the valley's bend, within the bounds.
    [[nodiscard]] VectorXd landing(const VectorXd& step, double to, double by, double factor) const {
        VectorXd z = from_.z + step;
        if (by != 0 && bend_.size() > 0 && factor == 1) {
            VectorXd more = 0.5 * by * by * bend_;
            more(psi_) = 0;
            if (more.cwiseAbs().maxCoeff() < step.cwiseAbs().maxCoeff()) z += more;
        }
        z = profile_.bounded(std::move(z));
        if (factor == 1) z(psi_) = to;
        return z;
    }

    /// The end by linear theory, or the farthest that was found to belong to the interval.
    [[nodiscard]] double linear() const {
        const double error = std::sqrt(first_.noise / first_.curvature);
        const double end = std::clamp(centre_ + side_ * standard_errors_of_interval(degrees_) * error,
                                      profile_.lower_[at(psi_)], profile_.upper_[at(psi_)]);
        return side_ * (end - bracket_.inner()) > 0 ? end : bracket_.inner();
    }

    Profile& profile_;
    Index psi_;
    int side_;
    double bound_, centre_, size_, degrees_;
    std::optional<double> end_;
    bool found_ = false;  ///< to where the rise is what it may be
    double floor_ = 0;    ///< of what loss^2 may rise by
    Response first_;      ///< at the minimum
    double least_;        ///< loss^2
    Bracket bracket_;
    // Where the search stands.
    Place from_;
    Response here_{};
    bool settled_ = false;  ///< the others have followed
    bool still_ = false;    ///< they cannot any further
    double damping_ = 0;
    // In roots of the noise that one standard error is: how far the profile has risen, and may.
    double unit_ = 0, root_ = 0;
    double reach_;
    double judged_ = NAN;  ///< where reach was found
    // Of the next step: the longest, and whether the last was refused.
    double most_;
    bool refused_ = false;
    // How the others follow, by the unknown: where it was last, and what that changes.
    double before_z_ = NAN;
    VectorXd before_along_, bend_;
};

std::vector<std::optional<std::array<double, 2>>> Profile::intervals() {
    std::vector<std::optional<std::array<double, 2>>> result(m_.unknowns.size());
    if (!std::isfinite(start_.loss2) || !start_.a.allFinite()) return result;
    std::vector<End> ends;
    for (Index i = 0; i < count(); ++i)
        if (m_.unknowns[at(i)].parameter)
            for (const int side : {-1, 1}) ends.emplace_back(*this, i, side);
    for (End& end : ends) end.find();
    std::vector<Elsewhere> elsewhere;
    for (const End& end : ends) end.add_places(elsewhere);
    for (std::size_t k = 0; k < ends.size(); k += 2) {
        const double noise = noise_elsewhere(ends[k].psi(), elsewhere);
        for (const std::size_t side : {k, k + 1}) ends[side].allow_for(noise);
        const auto low = ends[k].z(), high = ends[k + 1].z();
        if (!low || !high) continue;
        const Index i = ends[k].psi();
        const Coordinate& c = m_.unknowns[at(i)];
        const Interval& bounds = m_.bounds[at(i)];
        const auto value = [&](double z) {
            if (z <= lower_[at(i)]) return bounds.min;
            return z >= upper_[at(i)] ? bounds.max : std::clamp(c.value(z), bounds.min, bounds.max);
        };
        result[at(i)] = {std::min(value(*low), c.p), std::max(value(*high), c.p)};
    }
    return result;
}

}  // namespace

std::vector<std::optional<std::array<double, 2>>> profile_intervals(const Minimised& minimised, Refitter& refitter) {
    return Profile(minimised, refitter).intervals();
}

}  // namespace brdfit::optim
