/// Directional albedo: the share of light from one direction that a model sends back, by quadrature on the device.
#pragma once

#include <memory>
#include <span>
#include <vector>

#include "kernels/engine.h"
#include "kernels/model.h"
#include "kernels/precision.h"

namespace brdfit::kernels {

/// The integral of f cos theta_r over the exitant hemisphere.
struct Albedo {
    double value = 0;
    double error = 0;       ///< estimated; infinite where the value is not finite
    double scale = 0;       ///< the integral of |f| cos theta_r
    bool negative = false;  ///< f falls below 0 at some node
};

/// A model's integrals over the hemisphere. Owns its queue, kernels and buffers. Not for two threads at once; use one
/// each. Where the calling thread has a Waiter (kernels/waiting.h), a launch is left to it to wait for; else it blocks.
class Hemisphere {
public:
    /// Throws PrecisionError, BuildError, DeviceError.
    Hemisphere(Engine& engine, const Model& model, Precision precision);
    ~Hemisphere();
    Hemisphere(Hemisphere&&) noexcept;
    Hemisphere& operator=(Hemisphere&&) noexcept;

    /// At each angle, in [0, 90), of a model with these parameters (in its own unit). Cells are divided until the
    /// estimated error is below tolerance * max(1, integral of |f|), or there are too many: what is left, the error
    /// tells. Lobes are looked for about the mirror direction and the axes that the model's header declares; of others,
    /// narrower than a few degrees, some may be missed. All angles go in the same launches. Throws DeviceError.
    std::vector<Albedo> albedo(std::span<const double> parameters, std::span<const double> theta_i_deg,
                               double tolerance);
    /// Directions at which the model was evaluated so far.
    [[nodiscard]] std::size_t evaluations() const;

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

}  // namespace brdfit::kernels
