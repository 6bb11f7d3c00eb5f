/// All resources: which one a request is for, and what goes wrong.
#pragma once

#include <cstddef>
#include <stop_token>
#include <string>
#include <vector>

#include "api/problem.h"
#include "kernels/model.h"
#include "server/about.h"
#include "server/compute.h"
#include "server/datasets.h"
#include "server/fits.h"
#include "server/message.h"
#include "server/route.h"
#include "server/store.h"

namespace brdfit::server {

/// The most bytes a request's body may have, unless an option says otherwise.
inline constexpr std::size_t kLargestBody = std::size_t{32} << 20;

class Routes {
public:
    /// largest_body: [bytes] of a request, to be told.
    Routes(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, const std::stop_token& stop,
           std::size_t largest_body = kLargestBody);
    Routes(const Routes&) = delete;
    Routes& operator=(const Routes&) = delete;

    /// Never throws: what goes wrong is a problem+json answer, and a line in the log.
    [[nodiscard]] Response handle(const Request& request) const;

private:
    struct Row {
        Route route;
        std::vector<std::string> parts;  ///< of the path's template
    };
    /// The problem as an answer, with what this resource accepts and allows.
    [[nodiscard]] Response refusal(const api::Problem& problem, const Request& request) const;
    /// route: set to the template of the path as soon as that is known.
    [[nodiscard]] Response answer(const Request& request, std::string& route) const;
    [[nodiscard]] Response dispatch(const Request& request, std::string& route) const;

    Fits fits_;
    Datasets datasets_;
    About about_;
    std::vector<Row> table_;
};

}  // namespace brdfit::server
