#include "optim/profile.h"

#include <algorithm>
#include <cmath>

#include "optim/profile_end.h"

namespace brdfit::optim {
namespace {

using Eigen::Index;

/// What one standard error of an unknown lifts the loss by where other unknowns' profiles lead, less the share of it
/// that it took to get there: the most there is. Noise shakes an estimate as it does at the truth, and an interval that
/// is narrow where the others are found to be may be wide where they are.
double noise_elsewhere(const Neighbourhood& about, Index psi, const std::vector<PlaceOnTheWay>& places) {
    double most = 0;
    for (const PlaceOnTheWay& elsewhere : places) {
        if (elsewhere.psi == psi) continue;
        const double noise = (1 - elsewhere.share) * about.respond(elsewhere.place, psi, 0, 0).noise;
        if (std::isfinite(noise)) most = std::max(most, noise);
    }
    return most;
}

}  // namespace

std::vector<std::optional<std::array<double, 2>>> profile_intervals(const Minimised& minimised, Refitter& refitter) {
    const Neighbourhood about(minimised, refitter);
    std::vector<std::optional<std::array<double, 2>>> result(minimised.unknowns.size());
    if (!std::isfinite(about.start().loss2) || !about.start().a.allFinite()) return result;
    std::vector<ProfileEnd> ends;
    for (Index i = 0; i < about.count(); ++i)
        if (about.unknown(i).parameter)
            for (const int side : {-1, 1}) ends.emplace_back(about, i, side);
    for (ProfileEnd& end : ends) end.find();
    std::vector<PlaceOnTheWay> elsewhere;
    for (const ProfileEnd& end : ends) end.add_places(elsewhere);
    for (std::size_t k = 0; k < ends.size(); k += 2) {
        const Index i = ends[k].psi();
        const double noise = noise_elsewhere(about, i, elsewhere);
        for (const std::size_t side : {k, k + 1}) ends[side].allow_for(noise);
        const auto low = ends[k].z(), high = ends[k + 1].z();
        if (!low || !high) continue;
        const double p = about.unknown(i).p;
        result[static_cast<std::size_t>(i)] = {std::min(about.value(i, *low), p), std::max(about.value(i, *high), p)};
    }
    return result;
}

}  // namespace brdfit::optim
