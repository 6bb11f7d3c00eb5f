/// A closed interval, as of angles, or of a parameter's bounds in the model's own unit.
#pragma once

namespace brdfit::optim {

struct Interval {
    double min = 0;
    double max = 0;

    /// Whether bounds leave no choice.
    [[nodiscard]] bool fixed() const { return min == max; }
    [[nodiscard]] bool holds(double x) const { return min <= x && x <= max; }
    bool operator==(const Interval&) const = default;
};

}  // namespace brdfit::optim
