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
constexpr double kDamping = 1e-5;

using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

/// The other terms without a step: changed along columns, all of them or all but one whose term is taken away. What a
/// step at some samples then gains follows from sums over these samples.
struct Others {
    double loss2 = 0;
    VectorXd left;  ///< of the data, times the weights
    Rows whitened;  ///< samples x columns, times the weights: columns of which the damped squares are the unit matrix
    struct Floor {
        double room;      ///< by which its change is above the least one
        VectorXd in_sum;  ///< how a step's sums over `whitened` lower it, for a height of 1
    };
    std::vector<Floor> floors;
};

/// columns: of norm 1, each with the least change along it (-HUGE_VAL for any).
std::vector<Others> ways(const MatrixXd& columns, const VectorXd& least, const VectorXd& weights,
                         const VectorXd& rest) {
    std::vector<Others> result;
    for (Index removed = -1; removed < columns.cols(); ++removed) {
        if (removed >= 0 && !std::isfinite(least[removed])) continue;
        std::vector<Index> kept;
        for (Index k = 0; k < columns.cols(); ++k)
            if (k != removed) kept.push_back(k);
        const auto m = static_cast<Index>(kept.size());
        const VectorXd target = removed >= 0 ? VectorXd(rest - least[removed] * columns.col(removed)) : rest;
        const MatrixXd of = columns(Eigen::all, kept);
        const MatrixXd weighted = weights.asDiagonal() * of;
        MatrixXd gram = of.transpose() * weighted;
        gram.diagonal().array() += kDamping;
        const Eigen::LLT<MatrixXd> root(gram);
        const VectorXd moment = weighted.transpose() * target;
        const VectorXd change = root.solve(moment);
        Others others;
        others.loss2 = weights.dot(target.cwiseAbs2()) - change.dot(moment);
        others.left = weights.cwiseProduct(target - of * change);
        const MatrixXd inverse_root = root.matrixL().solve(MatrixXd::Identity(m, m));
        others.whitened = weighted * inverse_root.transpose();
        for (Index i = 0; i < m; ++i)
            if (const double floor = least[kept[static_cast<std::size_t>(i)]]; std::isfinite(floor))
                others.floors.push_back({change[i] - floor, inverse_root.col(i)});
        result.push_back(std::move(others));
    }
    return result;
}

/// Sums over the samples on one side of an edge, and what a step there leaves of loss^2.
struct Side {
    double square = 0, moment = 0;
    VectorXd products;

    [[nodiscard]] double loss2(const Others& others) const {
        const double own = square - products.squaredNorm();
        if (!(moment > 0) || !(own > 1e-9 * square)) return HUGE_VAL;
        const double height = moment / own;
        for (const Others::Floor& floor : others.floors)
            if (height * floor.in_sum.dot(products) > floor.room) return HUGE_VAL;
        return others.loss2 - moment * height;
    }
};

struct Place {
    Step step;
    std::size_t gap;
    bool above;
};

}  // namespace

const StepScan::Order& StepScan::order_in(const std::pair<std::size_t, std::size_t>& columns) {
    const auto [at, fresh] = orders_.try_emplace(columns);
    Order& order = at->second;
    if (!fresh) return order;
    const auto points = directions_.points(columns.first, columns.second);
    if (points.size() != data_.y.size()) return order;  // of many directions only some are told
    std::vector<double> angles;
    for (const auto& [a, b] : points) angles.push_back(std::atan2(b, a));
    order.samples.resize(angles.size());
    std::iota(order.samples.begin(), order.samples.end(), std::size_t{0});
    std::sort(order.samples.begin(), order.samples.end(),
              [&](std::size_t a, std::size_t b) { return angles[a] < angles[b]; });
    for (const std::size_t j : order.samples) order.angles.push_back(angles[j]);
    return order;
}

std::vector<Step> StepScan::best(std::size_t term, const StepBase& base, std::size_t most) {
    const Order& order = order_in(*model_.terms[term].homogeneous->columns);
    if (order.samples.empty()) return {};
    const std::size_t n = data_.y.size();
    const auto samples = static_cast<Index>(n);
    const VectorXd weights = Eigen::Map<const VectorXd>(data_.weight.data(), samples);

    VectorXd rest = Eigen::Map<const VectorXd>(data_.y.data(), samples);
    MatrixXd columns(samples, static_cast<Index>(model_.term_values()));
    VectorXd least(columns.cols());
    Index used = 0;
    const auto add_column = [&](const auto& column, double floor) {
        const double norm = std::sqrt(weights.dot(column.cwiseAbs2()));
        if (!std::isfinite(norm) || !(norm > 0)) return;
        columns.col(used) = column / norm;
        least[used++] = floor * norm;
    };
    std::size_t row = 0;
    for (std::size_t t = 0; t < model_.terms.size(); row += 1 + model_.terms[t++].of.size()) {
        if (t == term) continue;
        const auto values = [&](std::size_t k) {
            return Eigen::Map<const VectorXd>(base.values.data() + (row + k) * n, samples);
        };
        const double c = base.coefficients[t];
        rest -= c * values(0);
        const std::size_t slopes = c > 0 ? model_.terms[t].of.size() : 0;
        for (std::size_t k = 1; k <= slopes; ++k) add_column(values(k), -HUGE_VAL);
        // A homogeneous term's height changes with its pair.
        const bool held = !(base.lower[t] < base.upper[t]) || (slopes > 0 && model_.terms[t].homogeneous);
        if (!held) add_column(values(0), base.lower[t] - c);
    }

    std::vector<double> below(n, HUGE_VAL), above(n, HUGE_VAL);  // loss^2 of steps on either side of the gap after each
    for (const Others& others : ways(columns.leftCols(used), least.head(used), weights, rest)) {
        const Side all{weights.sum(), others.left.sum(), others.whitened.colwise().sum().transpose()};
        Side low{0, 0, VectorXd::Zero(others.whitened.cols())};
        Side high = all;
        for (std::size_t k = 0; k + 1 < n; ++k) {
            const auto j = static_cast<Index>(order.samples[k]);
            low.square += weights[j];
            low.moment += others.left[j];
            low.products += others.whitened.row(j).transpose();
            high.square = all.square - low.square;
            high.moment = all.moment - low.moment;
            high.products = all.products - low.products;
            below[k] = std::min(below[k], low.loss2(others));
            above[k] = std::min(above[k], high.loss2(others));
        }
    }
    std::vector<Place> places;
    for (std::size_t k = 0; k + 1 < n; ++k) {
        if (order.angles[k + 1] - order.angles[k] < kSameAngle) continue;
        const double edge = (order.angles[k] + order.angles[k + 1]) / 2;
        if (std::isfinite(below[k])) places.push_back({{edge - std::numbers::pi / 2, below[k]}, k, false});
        if (std::isfinite(above[k])) places.push_back({{edge + std::numbers::pi / 2, above[k]}, k, true});
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
