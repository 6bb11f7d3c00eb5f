/// The front end's workers: started, watched, started again, and asked what only a device can tell.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <stop_token>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/model.h"
#include "server/compute.h"
#include "server/store.h"

namespace brdfit::server {

struct SupervisorOptions {
    unsigned workers = 2;
    /// Arguments of `brdfit worker` besides those that say which one it is.
    std::vector<std::string> arguments;
    Retention retention{};
};

/// Keeps workers running on a store, and the store in order. With two or more, the first takes only jobs that somebody
/// waits for, so that it is never busy with others; the rest take any, at a lower priority of their processes. One that
/// ends is started again, ever later if it ends before it takes jobs; its own are given to others. The other
/// workers start when the first has built all programs, for they find them on disk then.
///
/// No OpenCL call is made in this process.
class Supervisor final : public Compute {
public:
    Supervisor(const kernels::Catalogue& catalogue, JobStore& store, SupervisorOptions options);
    /// As after stop().
    ~Supervisor() override;

    /// Starts the workers, and returns when the first takes jobs, or when none can although they were tried several
    /// times: they are tried on. Throws std::runtime_error with the worker's own words if it refuses to start.
    void start(const std::stop_token& stop);
    /// Lets the workers end: what is soon done is, the rest goes back to the store. Takes eight seconds at most.
    void stop();

    /// None while no worker has told of it.
    [[nodiscard]] std::optional<kernels::DeviceInfo> known_device() const;

    struct Processes {
        std::size_t ready = 0;    ///< that take jobs
        std::uint64_t ended = 0;  ///< since the start; another followed each
    };
    [[nodiscard]] Processes processes() const;

    // Compute
    [[nodiscard]] kernels::DeviceInfo device() const override;
    [[nodiscard]] std::vector<kernels::SelfTest> self_tests() const override;
    [[nodiscard]] std::vector<kernels::Cost> costs(const kernels::Family& family) const override;
    /// Waits a few seconds for a worker to be there.
    [[nodiscard]] bool usable() const override;
    [[nodiscard]] std::optional<std::string> refusal(kernels::Precision precision) const override;
    /// Waits some seconds for a worker to be there; asked once more of one that is still there if the first ends over
    /// it.
    [[nodiscard]] std::string evaluate(std::string_view body) override;

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

}  // namespace brdfit::server
