/// Names of choices on the wire, each declared once.
#pragma once

#include <algorithm>
#include <array>
#include <optional>
#include <string>
#include <string_view>

#include "kernels/engine.h"
#include "kernels/selftest.h"
#include "optim/dataset.h"
#include "optim/fit.h"
#include "optim/loss.h"
#include "optim/report.h"
#include "optim/search.h"
#include "optim/trade.h"

namespace brdfit::api {

template <class Choice>
struct Named {
    Choice choice;
    std::string_view name;
    std::string_view doc;
};

inline constexpr std::array<Named<optim::Effort>, 3> kEfforts{{
    {optim::Effort::draft, "draft", "a quick look: a quarter of the starts"},
    {optim::Effort::standard, "standard", "the default"},
    {optim::Effort::thorough, "thorough", "four times the starts"},
}};
inline constexpr std::array<Named<kernels::Precision>, 2> kPrecisions{{
    {kernels::Precision::single_precision, "single", "the search in 32 bits"},
    {kernels::Precision::double_precision, "double", "the search in 64 bits"},
}};
inline constexpr std::array<Named<kernels::SelfTestForm>, 2> kSelfTestForms{{
    {kernels::SelfTestForm::brief, "brief", "a handful of points a model"},
    {kernels::SelfTestForm::whole, "whole", "all points"},
}};
inline constexpr std::array<Named<optim::Unit>, 2> kUnits{{
    {optim::Unit::per_steradian, "1/sr", "absolute"},
    {optim::Unit::relative, "relative", "one unknown positive factor a channel is fitted and reported as scale"},
}};
inline constexpr std::array<Named<optim::StopReason>, 5> kStopReasons{{
    {optim::StopReason::converged, "converged", "the last descent met its tolerance"},
    {optim::StopReason::evaluation_limit, "evaluation_limit", "the budget of evaluations was spent"},
    {optim::StopReason::time_limit, "time_limit", "options.time_limit_s passed"},
    {optim::StopReason::roundoff, "roundoff", "round-off stopped progress; the point is usable"},
    {optim::StopReason::cancelled, "cancelled", "the request was withdrawn"},
}};
inline constexpr std::array<Named<optim::Robust>, 3> kRobusts{{
    {optim::Robust::none, "none", "squares"},
    {optim::Robust::huber, "huber", "squares up to robust_threshold, straight lines beyond"},
    {optim::Robust::cauchy, "cauchy", "logarithms beyond robust_threshold: a far outlier hardly counts"},
}};
inline constexpr std::array<Named<optim::Requirement>, 3> kRequirements{{
    {optim::Requirement::energy_conserving, "energy_conserving", "no directional albedo above 1"},
    {optim::Requirement::reciprocal, "reciprocal", "f(u, v) = f(v, u)"},
    {optim::Requirement::nonnegative, "nonnegative", "no value below 0"},
}};
inline constexpr std::array<Named<optim::RankBy>, 5> kRankBy{{
    {optim::RankBy::loss, "loss", "the fit's own loss"},
    {optim::RankBy::aicc, "aicc", "Akaike's criterion, corrected for few samples"},
    {optim::RankBy::bic, "bic", "the Bayesian criterion"},
    {optim::RankBy::held_out, "held_out", "the loss at incidence angles that were left out"},
    {optim::RankBy::log10_rmse, "log10_rmse", "the error in decades"},
}};
inline constexpr std::array<Named<optim::NoiseSource>, 4> kNoiseSources{{
    {optim::NoiseSource::none, "none", "too few samples, or all are 0"},
    {optim::NoiseSource::residuals, "residuals", "of each fit: differences of neighbouring samples cannot tell"},
    {optim::NoiseSource::given, "given", "sigma in the data"},
    {optim::NoiseSource::estimated, "estimated", "from differences of neighbouring samples"},
}};
/// States of a fit that was taken, those that end it last.
inline constexpr std::array<std::string_view, 6> kFitStates{"queued",    "running", "cancelling",
                                                            "succeeded", "failed",  "cancelled"};
inline constexpr std::array<Named<optim::LessWork>, 6> kLessWork{{
    {optim::LessWork::single_precision, "precision single", "the option precision"},
    {optim::LessWork::draft, "effort draft", "the option effort"},
    {optim::LessWork::standard, "effort standard", "the option effort"},
    {optim::LessWork::stop_after_screening, "stop after screening", "the best of the starts"},
    {optim::LessWork::stop_after_descents, "stop after descents", "the best end of the first descents"},
    {optim::LessWork::stop_after_exchange, "stop after exchange", "the best end before it is polished"},
}};
inline constexpr std::array<Named<optim::Arithmetic>, 4> kArithmetics{{
    {optim::Arithmetic::automatic, "auto", "the default of the option precision"},
    {optim::Arithmetic::single_search, "single", "the search in 32 bits, the report in 64"},
    {optim::Arithmetic::double_search, "double", "all in 64 bits"},
    {optim::Arithmetic::single_alone, "single alone", "all in 32 bits"},
}};
inline constexpr const auto& kLosses = optim::kLossNames;

/// The value that an entry of a table names.
template <class Choice>
constexpr Choice value_of(const Named<Choice>& entry) {
    return entry.choice;
}
constexpr optim::Loss value_of(const optim::LossName& entry) { return entry.loss; }

/// Name of a choice; every choice stands in its table.
template <class Table, class Choice>
constexpr std::string_view name_of(const Table& table, Choice choice) {
    return std::find_if(table.begin(), table.end(), [&](const auto& e) { return value_of(e) == choice; })->name;
}

/// The choice of that name, if there is one.
template <class Table>
auto choice_of(const Table& table, std::string_view name) -> std::optional<decltype(value_of(table.front()))> {
    for (const auto& entry : table)
        if (entry.name == name) return value_of(entry);
    return std::nullopt;
}

/// "a, b, c" for messages.
template <class Table>
std::string names_of(const Table& table) {
    std::string names;
    for (const auto& entry : table) names += (names.empty() ? "" : ", ") + std::string(entry.name);
    return names;
}

}  // namespace brdfit::api
