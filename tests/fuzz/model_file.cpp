// A model file: any text is a family whose variants hold together, or a ModelFileError that names the file.

#include <cmath>
#include <set>

#include "optim/fit.h"
#include "optim/space.h"
#include "tests/fuzz/fuzz.h"

using namespace brdfit;

namespace {

void check(const kernels::Model& model) {
    const std::size_t n = model.parameters.size();
    fuzz::require(n > 0 && !model.terms.empty(), "parameters and terms");
    std::set<std::string> names;
    for (const kernels::Parameter& p : model.parameters) {
        fuzz::require(names.insert(p.name).second, p.name + " twice");
        fuzz::require(p.domain_min <= p.min && p.min <= p.typical_min && p.typical_min < p.typical_max &&
                          p.typical_max <= p.max && p.max <= p.domain_max && std::isfinite(p.max - p.min),
                      "bounds of " + p.name);
        fuzz::require(p.scale == kernels::Scale::linear || p.min > 0, "the scale of " + p.name);
    }
    for (const kernels::Term& term : model.terms) {
        fuzz::require(term.factor.value_or(0) < n, "a factor");
        fuzz::require(std::set(term.of.begin(), term.of.end()).size() == term.of.size(), "a slope twice");
        for (const std::size_t i : term.of) fuzz::require(i < n && !model.is_linear(i), "what a term depends on");
        if (!term.homogeneous) continue;
        const auto& [plane, degree, pole, columns] = *term.homogeneous;
        fuzz::require(std::set{plane.first, plane.second, degree}.size() == 3, "a plane and its degree");
        fuzz::require(std::isfinite(pole), "a pole");
        fuzz::require(!columns || std::max(columns->first, columns->second) < kernels::geometry_columns().size(),
                      "geometry columns");
    }
    fuzz::require(model.group_begin + model.repeats * model.group_size == n, "the group stands last");
    fuzz::require(model.repeats == 0 || model.order_by < model.group_size, "lobes are ordered by one of theirs");
    for (const kernels::SpecialCase& special : model.special_cases)
        for (const auto& [i, value] : special.fixed)
            fuzz::require(value >= model.parameters.at(i).domain_min && value <= model.parameters.at(i).domain_max,
                          "a special case within the domain");

    // A search can start.
    std::vector<optim::Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    const optim::SearchSpace space(model, bounds);
    const std::vector<double> middle(space.dimension(), 0.5);
    for (const double value : space.candidate(middle).parameters)
        fuzz::require(std::isfinite(value), "a candidate is finite");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    const std::string_view text = fuzz::text_of(data, size);
    try {
        const kernels::Family family = kernels::parse_family("fuzzed", "fuzzed.cl", text);
        const std::size_t expected = family.repeat ? family.repeat->max - family.repeat->min + 1 : 1;
        fuzz::require(family.variants.size() == expected, "a variant for each number of lobes");
        for (const kernels::Model& model : family.variants) {
            check(model);
            (void)kernels::program_text(model, kernels::Precision::double_precision, 1);
        }
    } catch (const kernels::ModelFileError& error) {
        const std::string_view what = error.what();
        fuzz::require(what.starts_with("fuzzed.cl: ") && what.size() > 11, "the file and the reason");
        for (const char* word : {"exception", "parse error"})
            fuzz::require(what.find(word) == std::string_view::npos || text.find(word) != std::string_view::npos,
                          "an exception's words: " + std::string(what));
    }
    return 0;
}
