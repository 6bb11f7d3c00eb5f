/// What computes, as those see it who answer requests.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/cost.h"
#include "kernels/engine.h"
#include "kernels/model.h"
#include "kernels/selftest.h"

namespace brdfit::server {

/// The device and what may be asked of it, wherever it is. Safe to use from several threads. Throws api::Refusal
/// (unavailable) where nobody who computes can be reached.
class Compute {
public:
    Compute() = default;
    virtual ~Compute() = default;
    Compute(const Compute&) = delete;
    Compute& operator=(const Compute&) = delete;

    [[nodiscard]] virtual kernels::DeviceInfo device() const = 0;
    /// What the self-tests found; waits for those that still run.
    [[nodiscard]] virtual std::vector<kernels::SelfTest> self_tests() const = 0;
    /// What an evaluation of each text of the model costs (Family::texts), as far as that is measured.
    [[nodiscard]] virtual std::vector<kernels::Cost> costs(const kernels::Family& family) const = 0;
    /// Whether some precision may be used.
    [[nodiscard]] virtual bool usable() const = 0;
    /// Why a precision may not be used, if so; waits for its self-test.
    [[nodiscard]] virtual std::optional<std::string> refusal(kernels::Precision precision) const = 0;
    /// The answer of POST /v1/evaluate. Throws Refusal.
    [[nodiscard]] virtual std::string evaluate(std::string_view body) = 0;
};

}  // namespace brdfit::server
