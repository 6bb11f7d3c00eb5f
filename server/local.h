/// Computing in this process.
#pragma once

#include <future>
#include <stop_token>
#include <thread>
#include <vector>

#include "optim/fit.h"
#include "server/compute.h"
#include "server/store.h"

namespace brdfit::server {

class LocalCompute final : public Compute {
public:
    LocalCompute(const kernels::Catalogue& catalogue, optim::Fitter& fitter,
                 std::shared_future<std::vector<kernels::SelfTest>> self_tests)
        : catalogue_(catalogue), fitter_(fitter), self_tests_(std::move(self_tests)) {}
    [[nodiscard]] kernels::DeviceInfo device() const override { return fitter_.engine().device(); }
    [[nodiscard]] std::vector<kernels::SelfTest> self_tests() const override { return self_tests_.get(); }
    [[nodiscard]] bool usable() const override { return fitter_.engine().usable(); }
    [[nodiscard]] std::optional<std::string> refusal(kernels::Precision precision) const override;
    [[nodiscard]] std::string evaluate(std::string_view body) override;

private:
    const kernels::Catalogue& catalogue_;
    optim::Fitter& fitter_;
    std::shared_future<std::vector<kernels::SelfTest>> self_tests_;
};

/// Threads that take jobs from a store.
class LocalWorkers {
public:
    LocalWorkers(const kernels::Catalogue& catalogue, optim::Fitter& fitter, JobStore& store, unsigned threads);

private:
    void work(const std::stop_token& stop);
    void compute(const Claimed& claimed, const std::stop_token& stop);

    const kernels::Catalogue& catalogue_;
    optim::Fitter& fitter_;
    JobStore& store_;
    std::vector<std::jthread> threads_;
};

}  // namespace brdfit::server
