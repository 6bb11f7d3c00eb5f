/// Where a profile of the loss has risen as far as noise lifts it.
#pragma once

#include <cmath>
#include <optional>
#include <vector>

#include "optim/neighbourhood.h"

namespace brdfit::optim {

/// A place on the way to an unknown's end: as far from the minimum as noise may well bring it.
struct PlaceOnTheWay {
    Place place;
    Eigen::Index psi;  ///< whose end
    double share;      ///< of what the loss rises by up to there
};

/// One end of an unknown's interval. Newton's method on the root of the rise, which is nearly linear, the others
/// following by damped Gauss-Newton steps. What it is about must outlive it. Members throw what an evaluator throws.
class ProfileEnd {
public:
    using Index = Eigen::Index;

    /// side: -1 for the lower end, 1 for the upper one.
    ProfileEnd(const Neighbourhood& about, Index psi, int side);

    void find();
    /// On the unknown's own scale; none if the time was over.
    [[nodiscard]] std::optional<double> z() const { return end_; }
    [[nodiscard]] Index psi() const { return psi_; }

    /// Adds places on the way to the end, by the bend that the valley has up to there, if other unknowns see much more
    /// noise at the end than at the minimum.
    void add_places(std::vector<PlaceOnTheWay>& all) const;
    /// Finds the end anew, farther out, if elsewhere one standard error lifts the loss by so much that it matters.
    /// noise: the most that is left for this unknown.
    void allow_for(double noise);

private:
    /// What is known of where the end lies.
    class Bracket {
    public:
        Bracket(double centre, int side) : side_(side), centre_(centre), inner_(centre), outer_(side * HUGE_VAL) {}

        /// excess: of the root of the rise over its reach; below 0 within the interval.
        void add(double z, double excess);
        /// The farthest value that is known to belong to the interval.
        [[nodiscard]] double inner() const { return inner_; }
        [[nodiscard]] bool closed() const { return std::abs(outer_ - inner_) < 1e-3 * std::abs(outer_ - centre_); }
        /// In place of `to` a value within what is known, no farther than `most` from z.
        [[nodiscard]] double narrowed(double to, double z, double most) const;

    private:
        int side_;
        double centre_, inner_, outer_;
        double inner_excess_ = -HUGE_VAL, outer_excess_ = HUGE_VAL;
    };

    std::optional<double> search(bool at_start);
    /// Learns how far the profile has risen where the search stands.
    void see();
    /// The same, against how far it may, and whether the others have followed closely enough to tell.
    void judge(bool at_start);
    /// By what loss^2 may rise.
    [[nodiscard]] double allowed() const { return reach_ * reach_ * unit_; }
    /// Of that what is hardly more than nothing.
    [[nodiscard]] double close() const;
    [[nodiscard]] bool follows() const { return still_ || from_.loss2 - here_.loss2 <= close(); }
    /// Learns how the valley bends.
    void follow();
    /// Where the end would be by the slope of the rise.
    [[nodiscard]] double next(bool at_start) const;
    /// Moves the unknown to a value, if the loss there is what was expected, or has the others follow once more.
    void step(double to);
    /// Of the others: they are at the minimum, whatever the quadratic form says.
    void forget_slopes();
    /// By what a step is too long for an unknown, 1 if for none.
    [[nodiscard]] double shortening(const Eigen::VectorXd& step) const;
    /// Where a step ends, along the valley's bend, within the bounds.
    [[nodiscard]] Eigen::VectorXd landing(const Eigen::VectorXd& step, double to, double by, double factor) const;
    /// The end by linear theory, or the farthest that was found to belong to the interval.
    [[nodiscard]] double linear() const;

    const Neighbourhood& about_;
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
    Eigen::VectorXd before_along_, bend_;
};

}  // namespace brdfit::optim
