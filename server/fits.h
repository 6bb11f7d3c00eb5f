/// Fits: taken, waited for, listed, cancelled, removed; their results and plots.
#pragma once

#include <chrono>
#include <optional>
#include <stop_token>
#include <string>
#include <vector>

#include "api/request.h"
#include "api/stored.h"
#include "kernels/model.h"
#include "server/compute.h"
#include "server/route.h"
#include "server/store.h"

namespace brdfit::server {

class Fits {
public:
    Fits(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, std::stop_token stop);

    /// They refer to this object.
    [[nodiscard]] std::vector<Route> routes();

private:
    [[nodiscard]] Response post(const Call& call);
    [[nodiscard]] Response list(const Call& call);
    [[nodiscard]] Response get(const Call& call);
    [[nodiscard]] Response cancel(const Call& call);
    [[nodiscard]] Response remove(const Call& call);
    [[nodiscard]] Response events(const Call& call);
    [[nodiscard]] Response result(const Call& call);
    [[nodiscard]] Response plot(const Call& call);

    [[nodiscard]] api::PostedFit read(const Request& request);
    /// Refuses a precision that may not be used.
    void require_proven(std::optional<kernels::Precision> precision) const;
    /// The key of all that decides the result.
    [[nodiscard]] std::string result_key_of(const api::PostedFit& posted, const Request& request) const;
    /// The job, of this tenant. Throws Refusal: unknown-fit, gone.
    [[nodiscard]] Job find(const Request& request, const std::string& id);
    [[nodiscard]] api::FitStatus status(const Job& job, bool with_position);
    /// Waits until the job has ended, `known` is another state's tag (if it is not empty), or the time is over.
    [[nodiscard]] Job wait(const Request& request, const std::string& id, std::chrono::seconds time, bool for_change);
    /// What an ended job answers to the request that made it.
    [[nodiscard]] Response outcome(const Request& request, const Job& job);

    const kernels::Catalogue& catalogue_;
    JobStore& store_;
    Compute& compute_;
    std::stop_token stop_;
    std::string models_;  ///< digest of all models' texts
};

}  // namespace brdfit::server
