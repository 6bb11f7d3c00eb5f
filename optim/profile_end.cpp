#include "optim/profile_end.h"

#include <algorithm>
#include <array>
#include <utility>

#include "optim/critical_value.h"
#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::VectorXd;

/// By what noise elsewhere is more than at the estimate so that it counts. Less does not: at an estimate it is as often
/// too large as too small, which makes up for it.
constexpr double kMuchMore = 1.3;
/// Of what loss^2 may rise by: hardly more than nothing.
constexpr double kClose = 0.02;

/// Whether at a place any unknown but one sees much more noise than at the minimum.
bool has_more_noise(const Neighbourhood& about, const Place& place, Index but) {
    for (Index i = 0; i < about.count(); ++i)
        if (i != but && about.respond(place, i, 0, 0).noise > kMuchMore * about.respond(about.start(), i, 0, 0).noise)
            return true;
    return false;
}

}  // namespace

ProfileEnd::ProfileEnd(const Neighbourhood& about, Index psi, int side)
    : about_(about),
      psi_(psi),
      side_(side),
      bound_(side < 0 ? about.lower(psi) : about.upper(psi)),
      centre_(about.start().z(psi)),
      size_(about.size(psi)),
      degrees_(std::max(about.degrees(psi), 1.0)),
      first_(about.respond(about.start(), psi, 0, 0)),
      least_(std::min(about.start().loss2, first_.loss2)),
      bracket_(centre_, side),
      from_(about.start()),
      reach_(standard_errors_of_interval(degrees_)),
      most_(size_) {}

void ProfileEnd::find() { end_ = centre_ == bound_ ? bound_ : search(true); }

void ProfileEnd::add_places(std::vector<PlaceOnTheWay>& all) const {
    constexpr std::array kParts{0.35, 0.65};  // of the way
    if (!found_ || !has_more_noise(about_, from_, psi_)) return;
    const double whole = from_.z(psi_) - centre_;
    const VectorXd bend = from_.z - about_.start().z - whole * first_.along;
    for (const double part : kParts) {
        Place there = about_.look(about_.bounded(about_.start().z + part * whole * first_.along + part * part * bend));
        if (!there.is_finite()) continue;
        const double share = std::max(about_.respond(there, psi_, 0, 0).loss2 - least_, 0.0) / allowed();
        if (share < 1) all.push_back({std::move(there), psi_, share});
    }
}

void ProfileEnd::allow_for(double noise) {
    const double t = standard_errors_of_interval(degrees_);
    if (!found_ || !(t * t * noise > kMuchMore * allowed())) return;
    floor_ = t * t * noise;
    bracket_ = Bracket(centre_, side_);
    judged_ = NAN;
    const auto farther = search(false);
    if (farther && side_ * (*farther - *end_) > 0) end_ = farther;
}

void ProfileEnd::Bracket::add(double z, double excess) {
    if (excess < 0 && side_ * (z - inner_) > 0) inner_ = z, inner_excess_ = excess;
    if (excess >= 0 && side_ * (outer_ - z) > 0) outer_ = z, outer_excess_ = excess;
}

double ProfileEnd::Bracket::narrowed(double to, double z, double most) const {
    to = std::clamp(to, z - most, z + most);
    if (side_ * (to - inner_) < 0) to = inner_;
    if (!std::isfinite(outer_)) return to;
    const double share =
        std::isfinite(inner_excess_) ? std::clamp(inner_excess_ / (inner_excess_ - outer_excess_), 0.1, 0.9) : 0.5;
    return std::clamp(inner_ + share * (outer_ - inner_), z - most, z + most);
}

std::optional<double> ProfileEnd::search(bool at_start) {
    constexpr int kMostLooks = 40;
    found_ = false;
    for (int k = 0; k < kMostLooks; ++k, at_start = false) {
        if (about_.control().over()) return std::nullopt;
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

void ProfileEnd::see() {
    constexpr double kMostChange = 3;  // of noise, from the estimate on: beyond, a term has vanished
    here_ = about_.respond(from_, psi_, 0, 0);
    if (still_) here_.loss2 = from_.loss2;
    here_.noise = here_.noise > 0 ? std::clamp(here_.noise, first_.noise / kMostChange, first_.noise * kMostChange)
                                  : first_.noise;
    unit_ = std::max(here_.noise, 1e-300);
    root_ = std::sqrt(std::max(here_.loss2 - least_, 0.0) / unit_);
    reach_ = std::max(reach_, std::sqrt(floor_ / unit_));
}

void ProfileEnd::judge(bool at_start) {
    see();
    settled_ = at_start || follows();
    if (at_start || !settled_ || std::abs(reach_ - root_) >= 0.4 * reach_ || from_.z(psi_) == judged_) return;
    from_ = about_.with_own_misfit(std::move(from_));
    see();
    // The noise at the estimate or here, whichever is more: bent, the profile shows both.
    const double more = std::max(1.0, first_.noise / here_.noise);
    reach_ =
        std::sqrt(std::max(more * critical_value(about_, from_, psi_, here_.noise, degrees_, close()), floor_) / unit_);
    settled_ = follows();
    judged_ = from_.z(psi_);
}

double ProfileEnd::close() const { return kClose * allowed(); }

void ProfileEnd::follow() {
    const double z = from_.z(psi_);
    if (z == before_z_) return;
    if (std::isfinite(before_z_)) bend_ = (here_.along - before_along_) / (z - before_z_);
    before_z_ = z;
    before_along_ = here_.along;
}

double ProfileEnd::next(bool at_start) const {
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
    return std::clamp(to, about_.lower(psi_), about_.upper(psi_));
}

void ProfileEnd::step(double to) {
    const double by = to - from_.z(psi_);
    if (by != 0 && still_) forget_slopes();
    const VectorXd whole = about_.respond(from_, psi_, by, damping_).step;
    const double factor = shortening(whole);
    const VectorXd step = whole * factor;
    const Place there = about_.look(landing(step, to, by, factor));
    const double expected = from_.loss2 + 2 * from_.g.dot(step) + step.dot((from_.a + from_.s) * step);
    if (there.is_finite() && (by == 0 ? there.loss2 <= from_.loss2 : there.loss2 - expected <= 0.5 * allowed())) {
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

void ProfileEnd::forget_slopes() {
    for (Index i = 0; i < about_.count(); ++i)
        if (i != psi_ && from_.z(i) > about_.lower(i) && from_.z(i) < about_.upper(i)) from_.g(i) = 0;
}

double ProfileEnd::shortening(const VectorXd& step) const {
    double factor = 1;
    for (Index i = 0; i < about_.count(); ++i)
        if (i != psi_) factor = std::min(factor, about_.size(i) / std::max(std::abs(step(i)), 1e-300));
    return factor;
}

VectorXd ProfileEnd::landing(const VectorXd& step, double to, double by, double factor) const {
    VectorXd z = from_.z + step;
    if (by != 0 && bend_.size() > 0 && factor == 1) {
        VectorXd more = 0.5 * by * by * bend_;
        more(psi_) = 0;
        if (more.cwiseAbs().maxCoeff() < step.cwiseAbs().maxCoeff()) z += more;
    }
    z = about_.bounded(std::move(z));
    if (factor == 1) z(psi_) = to;
    return z;
}

double ProfileEnd::linear() const {
    const double error = std::sqrt(first_.noise / first_.curvature);
    const double end = std::clamp(centre_ + side_ * standard_errors_of_interval(degrees_) * error, about_.lower(psi_),
                                  about_.upper(psi_));
    return side_ * (end - bracket_.inner()) > 0 ? end : bracket_.inner();
}

}  // namespace brdfit::optim
