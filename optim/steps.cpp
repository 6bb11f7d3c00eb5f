#include "optim/steps.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <numeric>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Core>

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Angles of samples that are told apart [rad].
constexpr double kSameAngle = 1e-9;
/// Gaps between samples that lie between two steps that are told.
constexpr std::size_t kApart = 5;
/// Of the changes of the other terms, beside their own squares.
constexpr double kDamping = 1e-3;

/// Sums over the samples that a step is 1 at.
struct Sums {
    double square = 0;  ///< of the step with itself
    double moment = 0;  ///< with what the other terms leave of the data
    VectorXd products;  ///< with the columns in which the other terms change
};

/// A set of the columns, with what they gain of loss^2 without a step.
struct Combination {
    std::vector<Index> columns;
    MatrixXd inverse;  ///< of their Gram matrix
    VectorXd without;  ///< changes along them
    double gain = 0;
    Index removed = -1;  ///< a column whose term is taken away altogether, ...
    double amount = 0;   ///< by so much of it
};

/// How the other terms may change: along all columns, or without one of those that must stay above 0.
class Changes {
public:
    /// columns: samples x m, of which those with a finite floor change by no less than it.
    Changes(MatrixXd columns, VectorXd floors, const VectorXd& weights, const VectorXd& rest)
        : floors_(std::move(floors)) {
        const Index m = columns.cols();
        for (Index k = 0; k < m; ++k) {
            const double norm = std::sqrt(weights.dot(columns.col(k).cwiseAbs2()));
            const bool seen = std::isfinite(norm) && norm > 0;
            if (seen) columns.col(k) /= norm;
            else columns.col(k).setZero();
            floors_[k] *= seen ? norm : 1.0;
        }
        weighted_ = weights.asDiagonal() * columns;
        MatrixXd gram = columns.transpose() * weighted_;
        gram.diagonal().array() += kDamping;
        const VectorXd moment = weighted_.transpose() * rest;
        for (Index removed = -1; removed < m; ++removed) {
            if (removed >= 0 && !std::isfinite(floors_[removed])) continue;
            Combination with;
            for (Index k = 0; k < m; ++k)
                if (k != removed) with.columns.push_back(k);
            VectorXd left = moment;
            if (removed >= 0) {
                with.removed = removed;
                with.amount = floors_[removed];
                left -= with.amount * (gram.col(removed) - kDamping * VectorXd::Unit(m, removed));
                with.gain = with.amount * (moment[removed] + left[removed]);
            }
            const auto n = static_cast<Index>(with.columns.size());
            with.inverse = gram(with.columns, with.columns).ldlt().solve(MatrixXd::Identity(n, n));
            with.without = with.inverse * left(with.columns);
            with.gain += with.without.dot(left(with.columns));
            combinations_.push_back(std::move(with));
        }
    }

    [[nodiscard]] const MatrixXd& weighted() const { return weighted_; }

    /// The most that loss^2 falls with a step above 0.
    [[nodiscard]] double gain(const Sums& step) const {
        double best = 0;
        for (const Combination& with : combinations_) {
            const VectorXd v = step.products(with.columns);
            const VectorXd z = with.inverse * v;
            double moment = step.moment - v.dot(with.without);
            if (with.removed >= 0) moment -= with.amount * step.products[with.removed];
            const double square = step.square - v.dot(z);
            if (!(moment > 0) || !(square > 1e-9 * step.square)) continue;
            const double height = moment / square;
            const double gain = with.gain + moment * height;
            bool possible = gain > best;
            for (Index i = 0; i < v.size(); ++i)
                possible =
                    possible && with.without[i] - height * z[i] >= floors_[with.columns[static_cast<std::size_t>(i)]];
            if (possible) best = gain;
        }
        return best;
    }

private:
    VectorXd floors_;
    MatrixXd weighted_;
    std::vector<Combination> combinations_;
};

struct Place {
    Step step;
    std::size_t gap;
    bool above;
};

}  // namespace

std::vector<Step> StepScan::best(std::size_t term, const StepBase& base, std::size_t most) const {
    const kernels::Term::Homogeneous& lobe = *model_.terms[term].homogeneous;
    const auto points = directions_.points(lobe.columns->first, lobe.columns->second);
    const std::size_t n = data_.y.size();
    if (points.size() != n) return {};
    const auto samples = static_cast<Index>(n);
    const VectorXd weights = Eigen::Map<const VectorXd>(data_.weight.data(), samples);

    VectorXd rest = Eigen::Map<const VectorXd>(data_.y.data(), samples);
    std::vector<VectorXd> columns;
    std::vector<double> floors;
    std::size_t row = 0;
    for (std::size_t t = 0; t < model_.terms.size(); row += 1 + model_.terms[t++].of.size()) {
        if (t == term) continue;
        const auto values = [&](std::size_t k) {
            return Eigen::Map<const VectorXd>(base.values.data() + (row + k) * n, samples);
        };
        const double c = base.coefficients[t];
        rest -= c * values(0);
        const bool held = !(base.lower[t] < base.upper[t]);
        const bool bends = c > 0 && !model_.terms[t].of.empty();
        for (std::size_t k = 1; bends && k <= model_.terms[t].of.size(); ++k) {
            columns.emplace_back(c * values(k));
            floors.push_back(-HUGE_VAL);
        }
        // The height of a homogeneous term changes with its pair.
        if (held || (bends && model_.terms[t].homogeneous)) continue;
        columns.emplace_back(values(0));
        floors.push_back(base.lower[t] - c);
    }
    MatrixXd matrix(samples, static_cast<Index>(columns.size()));
    for (std::size_t k = 0; k < columns.size(); ++k) matrix.col(static_cast<Index>(k)) = columns[k];
    const Changes changes(std::move(matrix),
                          Eigen::Map<const VectorXd>(floors.data(), static_cast<Index>(floors.size())), weights, rest);
    const Sums all{weights.sum(), weights.dot(rest), changes.weighted().colwise().sum().transpose()};
    const double without = weights.dot(rest.cwiseAbs2());

    std::vector<double> angles(n);
    for (std::size_t j = 0; j < n; ++j) angles[j] = std::atan2(points[j].second, points[j].first);
    std::vector<std::size_t> order(n);
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return angles[a] < angles[b]; });
    Sums below{0, 0, VectorXd::Zero(all.products.size())};
    std::vector<Place> places;
    for (std::size_t k = 0; k + 1 < n; ++k) {
        const auto j = static_cast<Index>(order[k]);
        below.square += weights[j];
        below.moment += weights[j] * rest[j];
        below.products += changes.weighted().row(j).transpose();
        const double next = angles[order[k + 1]];
        if (next - angles[order[k]] < kSameAngle) continue;
        const double edge = (angles[order[k]] + next) / 2;
        const Sums above{all.square - below.square, all.moment - below.moment, all.products - below.products};
        places.push_back({{edge - std::numbers::pi / 2, without - changes.gain(below)}, k, false});
        places.push_back({{edge + std::numbers::pi / 2, without - changes.gain(above)}, k, true});
    }
    std::sort(places.begin(), places.end(), [](const Place& a, const Place& b) { return a.step.loss2 < b.step.loss2; });
    std::vector<Place> chosen;
    for (const Place& place : places) {
        if (chosen.size() == most) break;
        if (std::none_of(chosen.begin(), chosen.end(), [&](const Place& other) {
                return other.above == place.above &&
                       std::max(other.gap, place.gap) - std::min(other.gap, place.gap) <= kApart;
            }))
            chosen.push_back(place);
    }
    std::vector<Step> result;
    for (const Place& place : chosen) result.push_back(place.step);
    return result;
}

}  // namespace brdfit::optim
