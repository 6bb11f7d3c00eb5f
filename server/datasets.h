/// Measurements that are kept under the hash of what they say.
#pragma once

#include <vector>

#include "server/route.h"
#include "server/store.h"

namespace brdfit::server {

class Datasets {
public:
    explicit Datasets(JobStore& store) : store_(store) {}

    /// They refer to this object.
    [[nodiscard]] std::vector<Route> routes();

private:
    [[nodiscard]] Response post(const Call& call);
    [[nodiscard]] Response list(const Call& call);
    [[nodiscard]] Response get(const Call& call);
    [[nodiscard]] Response remove(const Call& call);

    JobStore& store_;
};

}  // namespace brdfit::server
