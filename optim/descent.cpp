#include "optim/descent.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

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
    void stop(StopReason reason) {
        over_ = true;
        best_.stop = reason;
    }

    /// What was found at next().
    void receive(const Look& look, const DescentGoal& goal) {
        ++looks_;
        const bool first = best_.u.empty();
        if (first || (finite(look) && look.value < here_)) {
            if (!first) {
                const double gain = (here_ - look.value) / promised_;
                damping_ *= std::max(1.0 / 3, 1 - std::pow(2 * gain - 1, 3));
                growth_ = 2;
            }
            here_ = look.value;
            gradient_ = Eigen::Map<const VectorXd>(look.gradient.data(), static_cast<Index>(look.gradient.size()));
            curvature_ = Eigen::Map<const MatrixXd>(look.curvature.data(), gradient_.size(), gradient_.size());
            best_.u = next_;
            best_.loss2 = look.value;
            if (!finite(look)) return stop(StopReason::roundoff);
        } else {
            damping_ *= growth_;
            growth_ *= 2;
        }
        if (looks_ >= goal.looks) return stop(StopReason::evaluation_limit);
        const VectorXd step = bounded_step();
        promised_ = -(gradient_.dot(step) + step.dot(curvature_ * step) / 2);
        if (!(promised_ > goal.relative * here_ + goal.absolute)) {
            // Damping may be all that holds the step back.
            return stop(damping_ > 1 ? StopReason::roundoff : StopReason::converged);
        }
        if (damping_ > kMostDamping) return stop(StopReason::roundoff);
        for (std::size_t i = 0; i < next_.size(); ++i)
            next_[i] = std::clamp(best_.u[i] + step(static_cast<Index>(i)), 0.0, 1.0);
    }

private:
    /// The damped step within the cube: where it leaves, the coordinate goes to its bound and the others follow.
    [[nodiscard]] VectorXd bounded_step() const {
        const Index n = gradient_.size();
        const auto at = [&](Index i) { return best_.u[static_cast<std::size_t>(i)]; };
        MatrixXd h = curvature_;
        const double largest = h.diagonal().maxCoeff();
        for (Index i = 0; i < n; ++i) h(i, i) += damping_ * std::max(h(i, i), 1e-9 * largest) + 1e-300;
        VectorXd step = VectorXd::Zero(n);
        std::vector<Index> inside;
        for (Index i = 0; i < n; ++i) {
            const double g = gradient_(i);
            if (!(at(i) <= 0 && g > 0) && !(at(i) >= 1 && g < 0)) inside.push_back(i);
        }
        while (!inside.empty()) {
            const VectorXd slope = gradient_ + h * step;
            const VectorXd found = -h(inside, inside).ldlt().solve(slope(inside));
            std::vector<Index> still;
            for (Index i = 0; i < found.size(); ++i) {
                const Index coordinate = inside[static_cast<std::size_t>(i)];
                const double x = at(coordinate);
                if (x + found(i) < 0) step(coordinate) = -x;
                else if (x + found(i) > 1) step(coordinate) = 1 - x;
                else still.push_back(coordinate);
            }
            if (still.size() == inside.size()) {
                step(inside) = found;
                break;
            }
            inside = std::move(still);
        }
        const double farthest = n > 0 ? step.cwiseAbs().maxCoeff() : 0.0;
        if (farthest > kTrust) step *= kTrust / farthest;
        return step;
    }

    std::vector<double> next_;
    Minimum best_{};
    double here_ = 0;
    VectorXd gradient_;
    MatrixXd curvature_;
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
        points.clear();
        for (const Descent* descent : running) points.push_back(descent->next());
        const std::vector<Look> looks = landscape(points);
        double least = looks.front().value;
        for (const Look& look : looks) least = std::min(least, look.value);
        control.evaluated(looks.size(), least);
        for (std::size_t i = 0; i < running.size(); ++i) running[i]->receive(looks[i], goal);
        for (Descent* descent : running) {
            if (descent->over()) continue;
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
