#include "optim/uncertainty.h"

#include <algorithm>
#include <cmath>
#include <random>

#include <fmt/format.h>
#include <Eigen/Dense>  // small dense symmetric problems: eigenvalues tell what the data do not determine
#include <boost/math/distributions/normal.hpp>  // quantiles

#include "optim/coordinate.h"
#include "optim/index.h"
#include "optim/profile.h"
#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Parts of the data's size that are rounding.
constexpr double kUnseen = 1e-12;
/// Relative to unit columns: below, a direction is rounding noise.
constexpr double kUndetermined = 1e-11;

class Sandwich {
public:
    Sandwich(const Estimate& estimate, Refitter& refitter)
        : estimate_(estimate), refitter_(refitter), values_(refitter.values(estimate.point, true)) {
        const Task& task = estimate.task;
        residuals_ = residuals(task.weighted, values_.f);
        n_ = static_cast<Index>(values_.f.size());
        root_ = root_weights(task.weighted, residuals_);
    }

    Uncertainty uncertainty(std::span<const double> units) {
        const kernels::Model& model = estimate_.task.model;
        Uncertainty result;
        result.parameters.resize(model.parameters.size());
        for (std::size_t i = 0; i < model.parameters.size(); ++i) {
            if (estimate_.bounds[i].fixed() || estimate_.at_bound[i]) continue;
            const Coordinate coordinate = coordinate_of(i);
            if (!sees(coordinate)) result.parameters[i].undetermined = true;
            else coordinates_.push_back(coordinate);
        }
        if (estimate_.scale_free) coordinates_.push_back({std::nullopt, Own::logarithm, estimate_.point.scale});
        result.too_few = estimate_.task.weighted.used <= coordinates_.size();
        if (result.too_few) return result;
        solve();
        if (!cov_.allFinite()) {
            for (const Coordinate& c : coordinates_)
                if (c.parameter) result.parameters[*c.parameter].undetermined = true;
            return result;
        }
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = coordinates_[at(i)];
            if (!c.parameter) continue;
            ParameterUncertainty& p = result.parameters[*c.parameter];
            const double error = std::sqrt(std::max(cov_(i, i), 0.0));
            const double std_error = error * std::abs(c.slope(c.p));
            p.undetermined = !determined_[at(i)] || !std::isfinite(std_error);
            if (p.undetermined) continue;
            p.std_error = std_error;
            const Interval& bounds = estimate_.bounds[*c.parameter];
            const double t = standard_errors_of_interval(degrees_of(i));
            const double low = c.value(c.z(c.p) - t * error);
            const double high = c.value(c.z(c.p) + t * error);
            if (std::isfinite(low) && std::isfinite(high))
                p.interval_95 = {std::clamp(low, bounds.min, c.p), std::clamp(high, c.p, bounds.max)};
        }
        for (std::size_t i = 0; i < model.parameters.size(); ++i)
            if (estimate_.at_bound[i])
                result.parameters[i].interval_95 =
                    one_sided(coordinate_of(i), standard_errors_of_interval(degrees_of_all()));
        if (estimate_.profiled) profile(result);
        correlations(result);
        remarks(result, units);
        return result;
    }

private:
    /// Replaces intervals by those of profiles.
    void profile(Uncertainty& result) {
        const kernels::Model& model = estimate_.task.model;
        std::vector<Coordinate> unknowns;
        std::vector<Interval> bounds;
        std::vector<Index> known;  // of coordinates_, or -1
        const auto add = [&](const Coordinate& c, Index i) {
            unknowns.push_back(c);
            known.push_back(i);
            bounds.push_back(c.parameter ? estimate_.bounds[*c.parameter]
                                         : Interval{estimate_.task.scale.min, estimate_.task.scale.max});
        };
        for (Index i = 0; i < count(); ++i) add(coordinates_[at(i)], i);
        for (std::size_t i = 0; i < model.parameters.size(); ++i)
            if (estimate_.at_bound[i] && !estimate_.bounds[i].fixed() && sees(coordinate_of(i)))
                add(coordinate_of(i), -1);
        const auto m = static_cast<Index>(unknowns.size());
        MatrixXd misfit = MatrixXd::Zero(m, m);
        if (misfit_.size() > 0 && misfit_.allFinite()) misfit.topLeftCorner(count(), count()) = misfit_;
        VectorXd spreads(n_);
        for (Index j = 0; j < n_; ++j) {
            const double pull = estimate_.task.weighted.weight[at(j)] * residuals_.by_f[at(j)];
            spreads(j) = pull > 0 ? std::abs(spreads_(j)) / pull : 0.0;
        }
        std::vector<double> degrees;
        for (const Index i : known) degrees.push_back(i < 0 ? degrees_of_all() : degrees_of(i));
        const Minimised minimised{estimate_.task, estimate_.point, unknowns, bounds, spreads, misfit, degrees};
        const auto intervals = profile_intervals(minimised, refitter_);
        for (std::size_t i = 0; i < unknowns.size(); ++i)
            if (unknowns[i].parameter && intervals[i])
                result.parameters[*unknowns[i].parameter].interval_95 = intervals[i];
        for (std::size_t i = 0; i < model.parameters.size(); ++i) {  // whatever the data do not see may be anything
            ParameterUncertainty& parameter = result.parameters[i];
            if (parameter.undetermined && !parameter.interval_95)
                parameter.interval_95 = {estimate_.bounds[i].min, estimate_.bounds[i].max};
        }
    }

    [[nodiscard]] Index count() const { return static_cast<Index>(coordinates_.size()); }

    [[nodiscard]] Coordinate coordinate_of(std::size_t i) const {
        const kernels::Model& model = estimate_.task.model;
        const kernels::Parameter& declared = model.parameters[i];
        const double p = estimate_.point.parameters[i];
        if (declared.scale == kernels::Scale::logarithmic && p > 0) return {i, Own::logarithm, p};
        const bool even = std::any_of(model.charts.begin(), model.charts.end(), [&](const kernels::Chart& chart) {
            return chart.kind == kernels::Chart::Kind::complex_index && chart.parameters.second == i;
        });
        return {i, even ? Own::square : Own::linear, p};
    }

    /// d scale f/d z at each sample.
    [[nodiscard]] VectorXd column(const Coordinate& c) const {
        if (!c.parameter) return Eigen::Map<const VectorXd>(values_.f.data(), n_);
        const double* row = values_.by_parameter.data() + *c.parameter * at(n_);
        if (c.own != Own::square || c.p > 0) return c.slope(c.p) * Eigen::Map<const VectorXd>(row, n_);
        // Of an even function at 0: the slope by the square, from a little beside it.
        std::vector<double> beside = estimate_.point.parameters;
        const double step = 1e-3;
        beside[*c.parameter] = step;
        const kernels::Values there = refitter_.evaluator().values(beside, true);
        return 0.5 / step * estimate_.point.scale *
               Eigen::Map<const VectorXd>(there.by_parameter.data() + *c.parameter * at(n_), n_);
    }

    /// Root of the weights, with the slope of the residual.
    [[nodiscard]] static VectorXd root_weights(const Weighted& weighted, const Residuals& residuals) {
        VectorXd root(static_cast<Index>(weighted.weight.size()));
        for (std::size_t j = 0; j < weighted.weight.size(); ++j)
            root(static_cast<Index>(j)) = std::sqrt(weighted.weight[j]) * residuals.by_f[j];
        return root;
    }

    /// What the samples do not feel over the parameter's whole interval is rounding, not a slope.
    [[nodiscard]] bool sees(const Coordinate& c) const {
        const kernels::Parameter& declared = estimate_.task.model.parameters[*c.parameter];
        const double reach = c.own == Own::logarithm ? c.p : std::max(declared.max - declared.min, std::abs(c.p));
        const double* row = values_.by_parameter.data() + *c.parameter * at(n_);
        const double effect = root_.cwiseProduct(Eigen::Map<const VectorXd>(row, n_)).norm();
        const double size = std::max(estimate_.task.weighted.norm, std::sqrt(residuals_.loss2));
        return effect * reach > kUnseen * size;
    }

    /// w r d r/d f at each sample: what is multiplied with df/dz in half the loss's gradient.
    [[nodiscard]] static VectorXd pulls(const Weighted& weighted, const Residuals& residuals) {
        VectorXd result(static_cast<Index>(residuals.r.size()));
        for (std::size_t j = 0; j < residuals.r.size(); ++j)
            result(static_cast<Index>(j)) = weighted.weight[j] * residuals.r[j] * residuals.by_f[j];
        return result;
    }

    /// The standard deviation of each sample's pull: its slope by y, where the data's is known, else its own size.
    [[nodiscard]] VectorXd spreads(const MatrixXd& a_inverse) const {
        const Task& task = estimate_.task;
        if (estimate_.sigma.empty()) {
            VectorXd result = pulls(task.weighted, residuals_);
            for (Index j = 0; j < n_; ++j) {  // HC3: a sample that draws the fit near looks better than it is
                const double leverage =
                    count() == 0 ? 0.0
                                 : root_(j) * root_(j) * slopes_.row(j).dot(a_inverse * slopes_.row(j).transpose());
                result(j) /= std::max(1 - leverage, 0.05);
            }
            return result;
        }
        VectorXd result(n_);
        for (Index j = 0; j < n_; ++j) {
            const double y = task.channel.samples[at(j)].brdf;
            const double weight = task.weighted.weight[at(j)];
            double by_y = -weight * residuals_.by_f[at(j)];
            if (weight > 0 && estimate_.loss.kind == Loss::log) by_y /= y;
            if (weight > 0 && estimate_.loss.kind == Loss::relative) by_y *= 2 * values_.f[at(j)] / y - 1;
            result(j) = by_y * estimate_.sigma[at(j)];
        }
        return result;
    }

    /// The slopes' weighted products: sum over samples of weights^2 slope slope'.
    static MatrixXd products(const MatrixXd& slopes, const VectorXd& weights) {
        constexpr Index kBlock = 256;
        MatrixXd sum = MatrixXd::Zero(slopes.cols(), slopes.cols());
        MatrixXd block;
        for (Index first = 0; first < slopes.rows(); first += kBlock) {
            const Index size = std::min(kBlock, slopes.rows() - first);
            block.noalias() = weights.segment(first, size).asDiagonal() * slopes.middleRows(first, size);
            sum.noalias() += block.transpose() * block;
        }
        return sum;
    }

    void solve() {
        const Index p = count();
        slopes_.resize(n_, p);  // d scale f/d z
        for (Index i = 0; i < p; ++i) slopes_.col(i) = column(coordinates_[at(i)]);
        const MatrixXd a = products(slopes_, root_);
        unit_ = a.diagonal().cwiseSqrt().cwiseInverse();
        cov_ = MatrixXd::Constant(p, p, NAN);
        determined_.assign(at(p), true);
        if (p == 0) {  // all are fixed or at bounds
            a_inverse_ = MatrixXd(0, 0);
            spreads_ = spreads(a_inverse_);
            return;
        }
        const MatrixXd scaled = unit_.asDiagonal() * a * unit_.asDiagonal();
        if (!scaled.allFinite()) return;
        const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(scaled);
        std::vector<Index> kept;
        for (Index e = 0; e < p; ++e) {
            if (eigen.eigenvalues()(e) > kUndetermined) {
                kept.push_back(e);
                continue;
            }
            null_.push_back(eigen.eigenvectors().col(e));
            for (Index i = 0; i < p; ++i)
                if (std::abs(eigen.eigenvectors()(i, e)) > 1e-3) determined_[at(i)] = false;
        }
        if (kept.empty()) return;
        const MatrixXd v = eigen.eigenvectors()(Eigen::all, kept);
        const VectorXd lambda = eigen.eigenvalues()(kept);
        const MatrixXd directions = unit_.asDiagonal() * v;
        a_inverse_ = directions * lambda.cwiseInverse().asDiagonal() * directions.transpose();
        spreads_ = spreads(a_inverse_);
        const MatrixXd b = directions.transpose() * products(slopes_, spreads_) * directions;
        // The curvature in units of Gauss and Newton's, so that it is 1 where there is no misfit.
        const VectorXd white = lambda.cwiseSqrt().cwiseInverse();
        const VectorXd errors = b.diagonal().cwiseSqrt().cwiseQuotient(lambda);
        const Eigen::SelfAdjointEigenSolver<MatrixXd> bend(MatrixXd::Identity(white.size(), white.size()) +
                                                           misfit_curvature(directions, errors, white));
        constexpr double kLeast = 0.05;  // less is a kink, or no minimum
        const VectorXd bent = bend.eigenvalues().cwiseMax(kLeast);
        const VectorXd inverse = bent.cwiseInverse();
        const MatrixXd h_inverse = white.asDiagonal() * bend.eigenvectors() * inverse.asDiagonal() *
                                   bend.eigenvectors().transpose() * white.asDiagonal();
        cov_ = directions * h_inverse * b * h_inverse * directions.transpose();
        by_slopes_ = directions * h_inverse * directions.transpose();
        const MatrixXd back = unit_.cwiseInverse().asDiagonal() * v * lambda.cwiseSqrt().asDiagonal();
        const VectorXd more = bent.array() - 1;
        misfit_ = back * bend.eigenvectors() * more.asDiagonal() * bend.eigenvectors().transpose() * back.transpose();
    }

    /// From 0 to 1: whether residuals are larger than noise makes them, by 2 standard deviations of their weighted sum
    /// of squares or less, or by 3 or more. Residuals that are noise bend the loss at random: that says nothing.
    [[nodiscard]] double misfit() const {
        if (estimate_.sigma.empty()) return 1;
        double noise = 0;
        double squares = 0;
        for (Index j = 0; j < n_; ++j) {
            const double weight =
                estimate_.task.weighted.weight[at(j)] * std::pow(residuals_.by_f[at(j)], 2);  // of the model's square
            if (!(weight > 0)) continue;
            const double expected = spreads_(j) * spreads_(j) / weight;
            noise += expected;
            squares += 2 * expected * expected;
        }
        const double size = noise * std::sqrt(2 / estimate_.noise.degrees);  // what is not known of sigma^2
        return std::clamp((residuals_.loss2 - noise) / std::hypot(std::sqrt(squares), size) - 2, 0.0, 1.0);
    }

    /// What misfit adds to half the loss's curvature, in units of Gauss and Newton's: from gradients at either side of
    /// the point along each direction, all in one launch.
    MatrixXd misfit_curvature(const MatrixXd& directions, const VectorXd& errors, const VectorXd& white) {
        const Index m = directions.cols();
        const double share = misfit();
        if (share == 0) return MatrixXd::Zero(m, m);
        std::vector<VectorXd> steps;
        VectorXd per(m);
        for (Index e = 0; e < m; ++e) {
            const double step = length(directions.col(e), errors(e));
            for (const double side : {-step, step}) steps.emplace_back(side * directions.col(e));
            per(e) = white(e) / (2 * step);
        }
        const MatrixXd gradients = half_gradients(steps);
        const MatrixXd to = directions * white.asDiagonal();
        MatrixXd h(m, m);
        for (Index e = 0; e < m; ++e)
            h.col(e) = per(e) * (to.transpose() * (gradients.col(2 * e + 1) - gradients.col(2 * e)));
        const MatrixXd bend = (h + h.transpose()) / 2 - MatrixXd::Identity(m, m);
        return bend.allFinite() ? MatrixXd(share * bend) : MatrixXd::Zero(m, m);
    }

    /// Of a step along a direction: half a standard error, but neither rounding nor another place.
    [[nodiscard]] double length(const VectorXd& direction, double error) const {
        constexpr double kShort = 1e-5;
        constexpr double kLong = 0.03;
        double share = 0;  // of a large step
        for (Index i = 0; i < count(); ++i)
            share = std::max(share, std::abs(direction(i)) / coordinates_[at(i)].size(estimate_.task.model));
        double length = std::clamp(0.5 * error, kShort / share, kLong / share);
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = coordinates_[at(i)];
            if (!c.parameter || c.own == Own::logarithm || direction(i) == 0) continue;
            const kernels::Parameter& declared = estimate_.task.model.parameters[*c.parameter];
            for (const double end : {declared.domain_min, declared.domain_max})
                if (std::isfinite(end))
                    length = std::min(length, 0.9 * std::abs(c.z(c.p) - c.z(end)) / std::abs(direction(i)));
        }
        return length;
    }

    /// Half the loss's gradient by the unknowns' z, a column for each step away from the point, none beyond the bounds.
    [[nodiscard]] MatrixXd half_gradients(const std::vector<VectorXd>& steps) const {
        std::vector<Point> points;
        MatrixXd result(count(), static_cast<Index>(steps.size()));  // at first the slope of each unknown by its z
        for (const VectorXd& step : steps) {
            Point point = estimate_.point;
            for (Index i = 0; i < count(); ++i) {
                const Coordinate& c = coordinates_[at(i)];
                double value = c.value(c.z(c.p) + step(i));
                if (c.parameter) {
                    const Interval& bounds = estimate_.bounds[*c.parameter];
                    value = std::clamp(value, bounds.min, bounds.max);
                }
                result(i, static_cast<Index>(points.size())) = !c.parameter                         ? 1.0
                                                               : value == 0 && c.own == Own::square ? 0.0
                                                                                                    : c.slope(value);
                (c.parameter ? point.parameters[*c.parameter] : point.scale) = value;
            }
            points.push_back(std::move(point));
        }
        const std::size_t p = estimate_.task.model.parameters.size();
        const std::vector<double> slopes = refitter_.half_slopes(points);
        for (std::size_t k = 0; k < points.size(); ++k)
            for (Index i = 0; i < count(); ++i)
                result(i, static_cast<Index>(k)) *= slopes[k * (p + 1) + coordinates_[at(i)].parameter.value_or(p)];
        return result;
    }

    /// Degrees of freedom of the noise, taken as a whole.
    [[nodiscard]] double degrees_of_all() const {
        if (!estimate_.sigma.empty()) return estimate_.noise.degrees;
        return static_cast<double>(estimate_.task.weighted.used) - static_cast<double>(coordinates_.size());
    }
    /// The same as an unknown sees it.
    [[nodiscard]] double degrees_of(Index i) const {
        if (estimate_.sigma.empty() || !estimate_.noise.record.floor || by_slopes_.size() == 0) return degrees_of_all();
        const VectorXd influences = spreads_.cwiseProduct(slopes_ * by_slopes_.col(i));
        const double floor = *estimate_.noise.record.floor;
        double part = 0;
        double whole = 0;
        for (Index j = 0; j < n_; ++j) {
            const double variance = influences(j) * influences(j);
            whole += variance;
            part += variance * std::min(std::pow(floor / estimate_.noise.sigma[at(j)], 2), 1.0);
        }
        return whole > 0 ? estimate_.noise.degrees_of(part / whole) : degrees_of_all();
    }

    /// Of a parameter at a bound: from there to the upper end of its interval if it were free.
    [[nodiscard]] std::optional<std::array<double, 2>> one_sided(const Coordinate& c, double t) const {
        const Interval& bounds = estimate_.bounds[*c.parameter];
        const VectorXd own = column(c);
        const VectorXd root2 = root_.cwiseAbs2();
        VectorXd rest = own;  // less what the others can make up for
        if (count() > 0) rest -= slopes_ * (a_inverse_ * (slopes_.transpose() * root2.cwiseProduct(own)));
        const double curvature = root2.dot(own.cwiseProduct(rest));
        if (!(curvature > kUndetermined * root2.dot(own.cwiseAbs2()))) return std::nullopt;
        const double centre = c.z(c.p) - pulls(estimate_.task.weighted, residuals_).dot(rest) / curvature;
        const double error = spreads_.cwiseProduct(rest).norm() / curvature;
        const bool lower = std::abs(c.p - bounds.min) < std::abs(c.p - bounds.max);
        const double end = c.value(centre + (lower ? t : -t) * error);
        if (!std::isfinite(end)) return std::nullopt;
        if (lower) return std::array{bounds.min, std::clamp(end, c.p, std::max(c.p, bounds.max))};
        return std::array{std::clamp(end, std::min(c.p, bounds.min), c.p), bounds.max};
    }

    void correlations(Uncertainty& result) const {
        std::vector<Index> told;
        for (Index i = 0; i < count(); ++i) {
            const Coordinate& c = coordinates_[at(i)];
            if (c.parameter && !result.parameters[*c.parameter].undetermined && cov_(i, i) > 0) told.push_back(i);
        }
        for (const Index i : told) {
            result.correlations.names.push_back(name(i));
            for (const Index j : told)
                result.correlations.matrix.push_back(
                    i == j ? 1.0 : std::clamp(cov_(i, j) / std::sqrt(cov_(i, i) * cov_(j, j)), -1.0, 1.0));
        }
    }

    [[nodiscard]] const std::string& name(Index i) const {
        return estimate_.task.model.parameters[*coordinates_[at(i)].parameter].name;
    }
    [[nodiscard]] std::string term(Index i) const {
        const Own own = coordinates_[at(i)].own;
        return own == Own::logarithm ? "ln " + name(i) : own == Own::square ? name(i) + "^2" : name(i);
    }

    /// Parameters that are open by as much as their own size while a combination of them is well known.
    void remarks(Uncertainty& result, std::span<const double> units) const {
        VectorXd sizes(count());
        for (Index i = 0; i < count(); ++i) sizes(i) = coordinates_[at(i)].size(estimate_.task.model);
        const auto together = [&](const VectorXd& direction, bool known) {
            std::vector<Index> large;
            const VectorXd shares = direction.cwiseQuotient(sizes);
            const double most = shares.cwiseAbs().maxCoeff();
            for (Index i = 0; i < count(); ++i)
                if (coordinates_[at(i)].parameter && std::abs(shares(i)) > 0.2 * most) large.push_back(i);
            if (large.size() < 2) return;
            std::string names, ranges;
            for (const Index i : large) {
                const bool last = i == large.back();
                names += (names.empty() ? "" : last ? " and " : ", ") + name(i);
                const auto& interval = result.parameters[*coordinates_[at(i)].parameter].interval_95;
                if (!known || !interval) continue;
                const double unit = units[*coordinates_[at(i)].parameter];
                ranges += fmt::format("{}{} in [{:.4g}, {:.4g}]", ranges.empty() ? "; " : ", ", name(i),
                                      (*interval)[0] / unit, (*interval)[1] / unit);
            }
            std::string what = "only together";
            if (large.size() == 2) {
                const double factor = -direction(large[0]) / direction(large[1]);
                what += fmt::format(", as {} {} {:.3g} {}: what keeps this sum fits as well", term(large[0]),
                                    factor < 0 ? "-" : "+", std::abs(factor), term(large[1]));
            } else {
                what += ": along one direction all of them may change and the fit hardly does";
            }
            result.remarks.push_back("the data determine " + names + " " + what + ranges);
        };
        if (count() == 0) return;
        for (const VectorXd& direction : null_) together(unit_.cwiseProduct(direction), false);
        const VectorXd inverse = sizes.cwiseInverse();
        const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(inverse.asDiagonal() * cov_ * inverse.asDiagonal());
        constexpr double kOpen = 0.25;   // standard error, of a parameter's size
        constexpr double kNarrow = 0.8;  // correlation
        for (Index e = count(); e-- > 0 && std::sqrt(std::max(eigen.eigenvalues()(e), 0.0)) > kOpen;) {
            const VectorXd direction = eigen.eigenvectors().col(e);
            Index first = 0;
            direction.cwiseAbs().maxCoeff(&first);
            bool narrow = false;
            for (Index i = 0; i < count(); ++i)
                narrow = narrow || (i != first && std::abs(direction(i)) > 0.2 * std::abs(direction(first)) &&
                                    std::abs(cov_(i, first)) > kNarrow * std::sqrt(cov_(i, i) * cov_(first, first)));
            if (narrow) together(sizes.cwiseProduct(direction), true);
        }
    }

    const Estimate& estimate_;
    Refitter& refitter_;
    const kernels::Values& values_;  ///< the refitter's, until it is asked for others: profiles do so
    Residuals residuals_;
    Index n_ = 0;
    std::vector<Coordinate> coordinates_;
    std::vector<bool> determined_;
    std::vector<VectorXd> null_;
    VectorXd root_;  ///< of the weights
    VectorXd unit_, spreads_;
    MatrixXd slopes_, a_inverse_, cov_;
    MatrixXd misfit_;     ///< what misfit adds to half the loss's curvature
    MatrixXd by_slopes_;  ///< what a pull on the slopes does to each unknown
};

/// Bias-corrected percentiles of a sorted sample about the estimate (Efron 1981), as far out as `reach` standard errors
/// of a normal distribution.
std::array<double, 2> percentiles(const std::vector<double>& sorted, double estimate, double reach) {
    const boost::math::normal normal;
    const auto n = static_cast<double>(sorted.size());
    const auto below = std::lower_bound(sorted.begin(), sorted.end(), estimate) - sorted.begin();
    const auto upto = std::upper_bound(sorted.begin(), sorted.end(), estimate) - sorted.begin();
    const double share = std::clamp(static_cast<double>(below + upto) / (2 * n), 0.5 / n, 1 - 0.5 / n);
    const double bias = 2 * boost::math::quantile(normal, share);
    const auto at_share = [&](double z) {
        const double place = boost::math::cdf(normal, z) * (n - 1);
        const auto index = std::min(static_cast<std::size_t>(place), sorted.size() - 2);
        const double part = place - static_cast<double>(index);
        return (1 - part) * sorted[index] + part * sorted[index + 1];
    };
    return {std::min(at_share(bias - reach), estimate), std::max(at_share(bias + reach), estimate)};
}

}  // namespace

Uncertainty uncertainty_of(const Estimate& estimate, Refitter& refitter, std::span<const double> units) {
    return Sandwich(estimate, refitter).uncertainty(units);
}

std::vector<std::array<double, 2>> bootstrap_intervals(const Estimate& estimate, Refitter& refitter,
                                                       std::size_t replicates) {
    constexpr double kEnough = 1e-9;  // of loss^2: far below what noise does
    const Task& task = estimate.task;
    std::vector<std::vector<double>> found(estimate.point.parameters.size());
    std::mt19937_64 random(task.control.seed);
    std::normal_distribution<double> normal;
    Channel channel = task.channel;
    for (std::size_t k = 0; k < replicates && !task.control.over(); ++k) {
        for (std::size_t j = 0; j < channel.samples.size(); ++j)
            channel.samples[j].brdf = task.channel.samples[j].brdf + estimate.sigma[j] * normal(random);
        const auto ends = refitter.descend(weigh(channel, estimate.loss), {&estimate.point, 1}, kEnough);
        for (std::size_t i = 0; i < found.size(); ++i) found[i].push_back(ends.front().parameters[i]);
    }
    std::vector<std::array<double, 2>> result;
    if (found.empty() || found.front().size() < replicates) return result;
    const double reach = standard_errors_of_interval(estimate.noise.degrees);
    for (std::size_t i = 0; i < found.size(); ++i) {
        std::sort(found[i].begin(), found[i].end());
        result.push_back(percentiles(found[i], estimate.point.parameters[i], reach));
    }
    return result;
}

}  // namespace brdfit::optim
