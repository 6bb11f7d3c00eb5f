/// Fits models to the channels of a dataset.
#pragma once

#include <memory>
#include <stop_token>
#include <vector>

#include "kernels/cost.h"
#include "kernels/engine.h"
#include "optim/dataset.h"
#include "optim/progress.h"
#include "optim/report.h"
#include "optim/request.h"

namespace brdfit::optim {

/// Fits on an engine, over channels and models: on a device that runs launches in the calling thread with a pool of
/// threads, one search each; on others with a Broker. Safe to use from several threads; their fits share the workers.
class Fitter {
public:
    /// threads: of the pool, at least one.
    Fitter(kernels::Engine& engine, unsigned threads);
    ~Fitter();
    Fitter(const Fitter&) = delete;
    Fitter& operator=(const Fitter&) = delete;

    /// Builds the programs of all variants of a model and runs each kernel once, so that no fit waits for a compiler.
    /// Throws kernels::PrecisionError, kernels::BuildError, kernels::DeviceError.
    void warm_up(const kernels::Family& family);
    /// Does so for a submodel with a text of its own, once; a fit tells what does not build. Throws
    /// kernels::PrecisionError, kernels::DeviceError.
    void warm_up(const kernels::Submodel& submodel);

    /// Fits every model to every channel. A model that fails is in the report's failures. `progress`: gets a task for
    /// each before the first begins; may be nullptr. Throws std::invalid_argument (see weigh), InvalidBounds and
    /// kernels::PrecisionError.
    Report fit(const Dataset& dataset, const std::vector<ModelRequest>& models, const FitOptions& options,
               std::stop_token stop = {}, Progress* progress = nullptr);

    [[nodiscard]] kernels::Engine& engine() const { return engine_; }
    [[nodiscard]] kernels::CostBook& costs() { return costs_; }

private:
    void warm_up(const kernels::Model& model);

    struct Workers;
    kernels::Engine& engine_;
    kernels::CostBook costs_;
    std::unique_ptr<Workers> workers_;
};

}  // namespace brdfit::optim
