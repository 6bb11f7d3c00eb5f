/// A model's loss over the space that a search moves in.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "kernels/evaluator.h"
#include "optim/loss.h"
#include "optim/search.h"
#include "optim/space.h"

namespace brdfit::optim {

/// The loss of a model over a space, divided by scale2 > 0, as an objective. References must outlive it. All members
/// throw what the evaluator throws.
class SpaceLoss {
public:
    /// With Unknowns::nonlinear the loss is Evaluator::project. With Unknowns::all `form`, the evaluator's data, says
    /// whether residuals are logarithmic and whether the loss is robust.
    SpaceLoss(kernels::Evaluator& evaluator, const SearchSpace& space, double scale2, const Weighted* form = nullptr)
        : evaluator_(evaluator), space_(space), scale2_(scale2), form_(form) {}

    /// The value at u, and its gradient unless that is empty.
    double operator()(std::span<const double> u, std::span<double> gradient);
    /// Looks at many points in one launch.
    std::vector<Look> looks(std::span<const std::vector<double>> points);
    /// Values at many points, in launches small enough to look at the clock between them; points left when time runs
    /// out have the largest value.
    std::vector<double> screen(const std::vector<std::vector<double>>& points, const SearchControl& control);
    /// The same with Newton's curvature in place of Gauss and Newton's: what large residuals add is told by `part`, a
    /// loss of the same space and unit through fewer samples, by differences of its gradients. Left out where the sum
    /// would not be positive definite.
    std::vector<Look> looks_bent_by(SpaceLoss& part, std::span<const std::vector<double>> points);
    /// Has screen_roughly() look through fewer samples first, by a loss of the same space that must outlive this.
    void glance_through(SpaceLoss& fewer) { fewer_ = &fewer; }
    /// This is seen through a part of the samples, which stands for a loss of the same space that must outlive this.
    void stand_for(SpaceLoss& whole) { whole_ = &whole; }
    [[nodiscard]] SpaceLoss& whole() { return whole_ != nullptr ? *whole_ : *this; }
    /// Values at points of which `wanted` shall be chosen: as screen(), but those that fewer samples tell to be poor
    /// have the largest value.
    std::vector<double> screen_roughly(const std::vector<std::vector<double>>& points, std::size_t wanted,
                                       const SearchControl& control);
    /// Values where the term of SearchSpace::strength() may have any strength that its coordinate reaches; the points
    /// move there, as far as strength is that coordinate's square. Of a space without such a term, those of screen().
    std::vector<double> screen_freed(std::vector<std::vector<double>>& points, const SearchControl& control);
    /// The same through the fewer samples, where there are such.
    std::vector<double> screen_freed_roughly(std::vector<std::vector<double>>& points, const SearchControl& control) {
        return (fewer_ != nullptr ? *fewer_ : *this).screen_freed(points, control);
    }
    /// Fills in the loss, not divided, and the coefficients at minimum.u.
    void complete(Minimum& minimum);

    /// Those through fewer samples included.
    [[nodiscard]] std::size_t evaluations() const {
        return evaluations_ + (fewer_ != nullptr ? fewer_->evaluations() : 0);
    }
    /// Values and slopes of every term at every sample (Evaluator::terms).
    [[nodiscard]] std::vector<double> terms(const Candidate& at) { return evaluator_.terms(at.parameters); }

    [[nodiscard]] const SearchSpace& space() const { return space_; }
    [[nodiscard]] double scale2() const { return scale2_; }
    [[nodiscard]] bool robust() const { return form_ != nullptr && form_->robust != Robust::none; }
    [[nodiscard]] std::size_t samples() const { return evaluator_.samples(); }

private:
    [[nodiscard]] bool logarithmic() const { return form_ != nullptr && form_->logarithmic; }
    /// What is known of a point.
    struct Known {
        std::vector<double> u;
        std::vector<double> gradient;
        double value = 0;
        std::vector<double> coefficients;
    };
    /// Its gradient may be empty unless it is asked for.
    Known at(std::span<const double> u, bool gradient);
    /// An evaluation sees so many samples that the last ones are kept, with their gradients: searches come back to
    /// them.
    [[nodiscard]] bool is_dear() const;
    void keep(Known known);
    /// Evaluates points into batch_ and candidates_; with `freed` that term may have another strength.
    void evaluate(std::span<const std::vector<double>> points, bool gradient,
                  const std::optional<Strength>& freed = std::nullopt);
    std::vector<double> screen(const std::vector<std::vector<double>>& points, const SearchControl& control,
                               const std::optional<Strength>& freed, std::vector<double>& strengths);

    kernels::Evaluator& evaluator_;
    const SearchSpace& space_;
    double scale2_;
    const Weighted* form_;
    std::vector<Candidate> candidates_;  ///< of the last points, and memory of more
    std::vector<double> parameters_, lower_, upper_;
    kernels::Batch batch_;
    std::vector<double> normal_, jacobian_, bent_;  ///< of one look
    std::vector<Known> known_;                      ///< the last ones, the latest at the end
    SpaceLoss* fewer_ = nullptr;
    SpaceLoss* whole_ = nullptr;
    std::size_t evaluations_ = 0;
};

}  // namespace brdfit::optim
