#include "optim/descent.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

namespace brdfit::optim {
namespace {

using Eigen::Index;

/// Coordinates of a cube whose matrices need no memory of their own: those of the models here.
constexpr int kFew = 16;
template <int Most>
using VectorOf = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, Most, 1>;
template <int Most>
using MatrixOf = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, Most, Most>;

/// Farthest step in a coordinate of the cube.
constexpr double kTrust = 0.25;
/// No step beyond this damping: the slope is lost in round-off.
constexpr double kMostDamping = 1e12;

bool finite(const Look& look) {
    const auto all = [](const std::vector<double>& values) {
        return std::all_of(values.begin(), values.end(), [](double x) { return std::isfinite(x); });
    };
    return std::isfinite(look.value) && all(look.gradient) && all(look.curvature);
}

class Descent {
public:
    Descent(std::vector<double> start, double damping) : next_(std::move(start)), damping_(damping) {}

    [[nodiscard]] bool over() const { return over_; }
    [[nodiscard]] const std::vector<double>& next() const { return next_; }
    [[nodiscard]] const Minimum& end() const { return best_; }
    [[nodiscard]] double promised() const { return promised_; }
    void stop(StopReason reason) {
        over_ = true;
        best_.stop = reason;
    }

    /// What was found at next().
    void receive(Look look, const DescentGoal& goal) {
        ++looks_;
        const bool first = best_.u.empty();
        const bool known = finite(look);
        if (first || (known && look.value < here_)) {
            if (!first) {
                const double gain = (here_ - look.value) / promised_;
                damping_ *= std::max(1.0 / 3, 1 - std::pow(2 * gain - 1, 3));
                growth_ = 2;
            }
            here_ = look.value;
            gradient_ = std::move(look.gradient);
            curvature_ = std::move(look.curvature);
            best_.u = next_;
            best_.loss2 = look.value;
            if (!known) return stop(StopReason::roundoff);
        } else {
            damping_ *= growth_;
            growth_ *= 2;
        }
        if (looks_ >= goal.looks) return stop(StopReason::evaluation_limit);
        if (gradient_.size() <= kFew) take_step<kFew>();
        else take_step<Eigen::Dynamic>();
        if (!(promised_ > goal.relative * here_ + goal.absolute)) {
            // Damping may be all that holds the step back.
            return stop(damping_ > 1 ? StopReason::roundoff : StopReason::converged);
        }
        if (damping_ > kMostDamping) stop(StopReason::roundoff);
    }

private:
    /// Sets next_ a step from the best point, and what the step promises.
    template <int Most>
    void take_step() {
        const auto n = static_cast<Index>(gradient_.size());
        const Eigen::Map<const VectorOf<Most>> gradient(gradient_.data(), n);
        const Eigen::Map<const MatrixOf<Most>> curvature(curvature_.data(), n, n);
        const VectorOf<Most> step = bounded_step<Most>(gradient, curvature);
        const VectorOf<Most> bend = curvature * step;
        promised_ = -(gradient.dot(step) + step.dot(bend) / 2);
        for (std::size_t i = 0; i < next_.size(); ++i)
            next_[i] = std::clamp(best_.u[i] + step(static_cast<Index>(i)), 0.0, 1.0);
    }

    /// The damped step within the cube: where it leaves, the coordinate goes to its bound and the others follow.
    template <int Most>
    [[nodiscard]] VectorOf<Most> bounded_step(const Eigen::Map<const VectorOf<Most>>& gradient,
                                              const Eigen::Map<const MatrixOf<Most>>& curvature) const {
        const Index n = gradient.size();
        MatrixOf<Most> h = curvature;
        const double largest = h.diagonal().maxCoeff();
        for (Index i = 0; i < n; ++i) h(i, i) += damping_ * std::max(h(i, i), 1e-9 * largest) + 1e-300;
        VectorOf<Most> step = VectorOf<Most>::Zero(n);
        Eigen::Matrix<Index, Eigen::Dynamic, 1, 0, Most, 1> inside(n);
        Index count = 0;
        for (Index i = 0; i < n; ++i) {
            const double x = best_.u[static_cast<std::size_t>(i)];
            const double g = gradient(i);
            if (!(x <= 0 && g > 0) && !(x >= 1 && g < 0)) inside(count++) = i;
        }
        while (count > 0) {
            const auto free = inside.head(count);
            const VectorOf<Most> slope = gradient + h * step;
            const MatrixOf<Most> part = h(free, free);
            const VectorOf<Most> found = -part.ldlt().solve(VectorOf<Most>(slope(free)));
            Index still = 0;
            for (Index i = 0; i < found.size(); ++i) {
                const Index coordinate = inside(i);
                const double x = best_.u[static_cast<std::size_t>(coordinate)];
                if (x + found(i) < 0) step(coordinate) = -x;
                else if (x + found(i) > 1) step(coordinate) = 1 - x;
                else inside(still++) = coordinate;
            }
            if (still == count) {
                for (Index i = 0; i < count; ++i) step(inside(i)) = found(i);
                break;
            }
            count = still;
        }
        const double farthest = n > 0 ? step.cwiseAbs().maxCoeff() : 0.0;
        if (farthest > kTrust) step *= kTrust / farthest;
        return step;
    }

    std::vector<double> next_;
    Minimum best_{};
    double here_ = 0;
    std::vector<double> gradient_;
    std::vector<double> curvature_;
    double promised_ = 0;
    double damping_ = 0;
    double growth_ = 2;
    int looks_ = 0;
    bool over_ = false;
};

double distance(const std::vector<double>& a, const std::vector<double>& b) {
    double most = 0;
    for (std::size_t i = 0; i < a.size(); ++i) most = std::max(most, std::abs(a[i] - b[i]));
    return most;
}

}  // namespace

std::vector<Minimum> descend_together(const Landscape& landscape, const std::vector<std::vector<double>>& starts,
                                      const DescentGoal& goal, const SearchControl& control) {
    std::vector<Descent> descents;
    descents.reserve(starts.size());
    for (const std::vector<double>& start : starts) descents.emplace_back(start, goal.damping);
    std::vector<Descent*> running;
    for (Descent& descent : descents) running.push_back(&descent);
    std::vector<std::vector<double>> points;
    while (!running.empty()) {
        if (control.over()) {
            for (Descent* descent : running)
                descent->stop(control.stop.stop_requested() ? StopReason::cancelled : StopReason::time_limit);
            break;
        }
        points.resize(running.size());
        for (std::size_t i = 0; i < running.size(); ++i) points[i] = running[i]->next();
        std::vector<Look> looks = landscape(points);
        double least = looks.front().value;
        for (const Look& look : looks) least = std::min(least, look.value);
        control.evaluated(looks.size(), least);
        for (std::size_t i = 0; i < running.size(); ++i) running[i]->receive(std::move(looks[i]), goal);
        double best = HUGE_VAL;
        for (const Descent& descent : descents)
            if (!descent.end().u.empty()) best = std::min(best, descent.end().loss2);
        for (Descent* descent : running) {
            if (descent->over()) continue;
            if (goal.hopeful > 0 && descent->promised() < goal.hopeful * (descent->end().loss2 - best)) {
                descent->stop(StopReason::converged);
                continue;
            }
            for (const Descent& other : descents)
                if (&other != descent && other.end().loss2 <= descent->end().loss2 && !other.end().u.empty() &&
                    distance(other.end().u, descent->end().u) < goal.apart &&
                    (other.end().loss2 < descent->end().loss2 || &other < descent)) {
                    descent->stop(StopReason::converged);
                    break;
                }
        }
        std::erase_if(running, [](const Descent* descent) { return descent->over(); });
    }
    std::vector<Minimum> ends;
    for (const Descent& descent : descents) {
        ends.push_back(descent.end());
        if (ends.back().u.empty()) ends.back().u = descent.next();
    }
    return ends;
}

}  // namespace brdfit::optim
