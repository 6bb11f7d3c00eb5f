#include "optim/critical_value.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>
#include <vector>

#include <Eigen/Dense>
#include <boost/math/distributions/normal.hpp>

#include "optim/index.h"
#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Unknowns near bounds that a critical value takes account of, besides the one whose interval it is.
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

/// From a place to an unknown's bound, in that unit of it.
double room(const Neighbourhood& about, const Place& here, Index i, double unit, bool up) {
    return (up ? about.upper(i) - here.z(i) : about.lower(i) - here.z(i)) / unit;
}

/// A place as one unknown is tested there: in units that make the curvature's diagonal 1.
struct Tested {
    VectorXd unit;
    MatrixXd h, b;
    std::vector<Index> others;
    /// Of them those with a bound at hand, nearest first: standard errors to it, infinite if it is not left.
    std::vector<std::pair<double, Index>> near;
};
Tested tested(const Neighbourhood& about, const Place& here, Index psi) {
    Tested result;
    auto& [unit, h, b, others, near] = result;
    h = here.a + here.s;
    unit = h.diagonal().cwiseAbs().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    h = unit.asDiagonal() * h * unit.asDiagonal();
    h.diagonal().array() += 1e-10;
    b = unit.asDiagonal() * here.b * unit.asDiagonal();
    for (Index i = 0; i < about.count(); ++i)
        if (i != psi && about.lower(i) < about.upper(i)) others.push_back(i);
    if (!others.empty()) {
        const MatrixXd inverse = h(others, others).inverse();
        const MatrixXd cov = inverse * b(others, others) * inverse;
        for (Index k = 0; k < cov.rows(); ++k) {
            const Index i = others[at(k)];
            const double error = std::sqrt(std::max(cov(k, k), 0.0));
            const double distance =
                std::min(-room(about, here, i, unit(i), false), room(about, here, i, unit(i), true)) /
                std::max(error, 1e-300);
            // A bound that holds back more than noise pushes is not left.
            const double pushed = std::abs(here.g(i)) * unit(i) / std::sqrt(std::max(b(i, i), 1e-300));
            if (distance < kNear && !(distance <= 0 && pushed > kNear)) near.emplace_back(distance, i);
            else if (distance <= 0) near.emplace_back(HUGE_VAL, i);
        }
    }
    std::sort(near.begin(), near.end());
    return result;
}

/// By what the loss's profile rises above its minimum at most in 95 % of cases, if the truth is here: noise^2 t^2
/// where no bound is near, and what repetition in the quadratic form and its bounds says elsewhere.
double of_one_truth(const Neighbourhood& about, const Place& here, Index psi, double noise, double degrees) {
    const double t = standard_errors_of_interval(degrees);
    const auto [unit, h, b, others, near] = tested(about, here, psi);
    const Index n = about.count();
    std::vector<Index> kept{psi}, free;
    for (const auto& [distance, i] : near)
        if (std::isfinite(distance) && kept.size() <= at(kMostNear)) kept.push_back(i);
    for (const Index i : others) {
        const bool is_kept = std::find(kept.begin(), kept.end(), i) != kept.end();
        const bool is_held = here.z(i) <= about.lower(i) || here.z(i) >= about.upper(i);
        if (!is_kept && !is_held) free.push_back(i);
    }
    MatrixXd to = MatrixXd::Zero(static_cast<Index>(kept.size()), n);
    for (std::size_t k = 0; k < kept.size(); ++k) to(static_cast<Index>(k), kept[k]) = 1;
    MatrixXd left = h(kept, kept);
    if (!free.empty()) {
        const MatrixXd back = h(free, free).ldlt().solve(h(free, kept));
        left -= h(kept, free) * back;
        for (std::size_t k = 0; k < free.size(); ++k) to.col(free[k]) = -back.row(static_cast<Index>(k)).transpose();
    }
    const MatrixXd shaken = to * b * to.transpose();
    const double error = std::sqrt(shaken(0, 0)) / left(0, 0);
    const double to_low = -room(about, here, psi, unit(psi), false) / error;
    const double to_high = room(about, here, psi, unit(psi), true) / error;
    if (kept.size() == 1 && to_low > kNear && to_high > kNear) return t * t * noise;
    const auto m = static_cast<Index>(kept.size());
    Few low(m), high(m);
    for (Index k = 0; k < m; ++k) {
        const Index i = kept[at(k)];
        low(k) = std::min(room(about, here, i, unit(i), false), 0.0);
        high(k) = std::max(room(about, here, i, unit(i), true), 0.0);
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

}  // namespace

double critical_value(const Neighbourhood& about, const Place& here, Index psi, double noise, double degrees,
                      double close) {
    double most = of_one_truth(about, here, psi, noise, degrees);
    for (const auto& [distance, i] : tested(about, here, psi).near) {
        const bool lower = here.z(i) - about.lower(i) < about.upper(i) - here.z(i);
        if (about.unknown(i).own != Own::square || !lower || distance <= 0 || !std::isfinite(distance)) continue;
        const auto there = about.at_lower_bound(here, i, psi, close);
        if (!there || there->loss2 - here.loss2 > kNear * kNear * about.respond(here, i, 0, 0).noise) continue;
        most = std::max(most, of_one_truth(about, *there, psi, about.respond(*there, psi, 0, 0).noise, degrees));
    }
    return most;
}

}  // namespace brdfit::optim
