/// The service itself: its documents, models, health, and values of models.
#pragma once

#include <stop_token>
#include <string>
#include <vector>

#include "kernels/model.h"
#include "server/compute.h"
#include "server/route.h"
#include "server/store.h"

namespace brdfit::server {

class About {
public:
    About(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, std::size_t largest_body,
          std::stop_token stop)
        : catalogue_(catalogue),
          store_(store),
          compute_(compute),
          largest_body_(largest_body),
          stop_(std::move(stop)) {}

    /// They refer to this object.
    [[nodiscard]] std::vector<Route> routes();
    /// What is answered before requests come to the table.
    [[nodiscard]] static std::vector<api::Operation> elsewhere();
    /// The documents of the whole table. To be called once, before requests come.
    void publish(std::span<const api::Operation* const> operations);

private:
    [[nodiscard]] Response index(const Call& call);
    [[nodiscard]] Response model(const Call& call);
    [[nodiscard]] Response evaluate(const Call& call);
    [[nodiscard]] Response ready(const Call& call);

    const kernels::Catalogue& catalogue_;
    JobStore& store_;
    Compute& compute_;
    std::size_t largest_body_;
    std::stop_token stop_;
    std::string openapi_;
    std::string docs_;
};

}  // namespace brdfit::server
