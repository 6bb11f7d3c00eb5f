/// The catalogue of reflectance models: what the JSON header of each kernels/models/<name>.cl declares.
#pragma once

#include <cstddef>
#include <filesystem>
#include <limits>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "kernels/precision.h"

namespace brdfit::kernels {

/// How a parameter is spaced for a search: evenly, or evenly in its logarithm.
enum class Scale { linear, logarithmic };

/// One parameter as its model declares it.
struct Parameter {
    std::string name;  ///< as on the wire: "n", or "n_2" for the second lobe's n
    std::string unit;  ///< "1", or "wavelength" for a length in units of the channel's wavelength
    std::string doc;   ///< one sentence
    double min = 0;    ///< default bounds of a fit, in `unit`
    double max = 0;
    double domain_min = -std::numeric_limits<double>::infinity();  ///< the model is defined from here ...
    double domain_max = std::numeric_limits<double>::infinity();   ///< ... to here; no request may go beyond
    double typical_min = 0;  ///< where the starts of a search lie; within [min, max]
    double typical_max = 0;
    Scale scale = Scale::linear;
    std::optional<std::size_t> repeat{};  ///< the lobe it belongs to, from 0

    bool operator==(const Parameter&) const = default;
};

/// One summand phi_t of f = sum_t c_t phi_t. Indices are into Model::parameters.
struct Term {
    std::string name;
    std::optional<std::size_t> factor;  ///< the linear parameter c_t; without one c_t = 1
    std::vector<std::size_t> of;        ///< the nonlinear parameters phi_t depends on, in the order of its slopes
    /// phi_t is homogeneous of degree `degree` in the pair `plane`: scaling both by s multiplies phi_t by s^degree.
    /// A search may then treat phi_t's height as a linear coefficient. Narrow lobes lie about the angle `pole` of the
    /// pair's plane [rad].
    struct Homogeneous {
        std::pair<std::size_t, std::size_t> plane;
        std::size_t degree;
        double pole;
        /// phi_t = max(0, x a + y b)^degree of these geometry columns a and b, by their places in geometry_columns().
        std::optional<std::pair<std::size_t, std::size_t>> columns{};
    };
    std::optional<Homogeneous> homogeneous{};
};

/// A pair of parameters that a search should see in other coordinates.
struct Chart {
    enum class Kind { complex_index } kind;  ///< n + ik = (1 + rho)/(1 - rho), searched in modulus and argument of rho
    std::pair<std::size_t, std::size_t> parameters;
};

/// A special case of the model: some parameters fixed, the rest free.
struct SpecialCase {
    std::string name;
    std::map<std::size_t, double> fixed;
};

/// A model with its number of lobes settled: what is compiled, searched and reported.
struct Model {
    std::string name;
    std::string title;
    std::string source;
    std::string formula;
    std::vector<Parameter> parameters;  ///< in the order of the wire and of the kernel's Params
    std::vector<Term> terms;
    std::vector<Chart> charts;
    std::vector<SpecialCase> special_cases;
    std::map<std::string, bool> traits;
    std::size_t repeats = 0;      ///< number of lobes; 0 for a model without a repeated group
    std::size_t group_begin = 0;  ///< first parameter of the first lobe; the lobes follow each other
    std::size_t group_size = 0;   ///< parameters of a lobe
    std::size_t order_by = 0;     ///< lobes are reported in falling order of this parameter of the group
    std::string text;             ///< kernel text
    std::string file;             ///< its name in messages, e.g. "models/ward.cl"
    std::string prelude;          ///< generated structs Params and Terms and the tables of residual.cl

    /// Index of the parameter, if there is one of that name.
    [[nodiscard]] std::optional<std::size_t> find(std::string_view parameter) const;
    /// True if the parameter is the factor of a term.
    [[nodiscard]] bool is_linear(std::size_t parameter) const;
    /// The parameters that some term depends on, in rising order.
    [[nodiscard]] std::vector<std::size_t> nonlinear() const;
    /// Whether a term sums a series, whose accuracy a search may lower (Accuracy::search).
    [[nodiscard]] bool sums_series() const;
    /// Whether searches begin in the quickest precision: with one unknown there is nothing to gain.
    [[nodiscard]] bool begins_quickly() const { return nonlinear().size() > 1; }
    /// The accuracy with which such searches begin.
    [[nodiscard]] Accuracy first_accuracy() const { return sums_series() ? Accuracy::search : Accuracy::full; }
    /// Number of values in the kernel's Terms: each term and its slopes.
    [[nodiscard]] std::size_t term_values() const;
    /// For each term the parameter values' product: c_t, given all parameters in `unit`.
    [[nodiscard]] std::vector<double> coefficients(const std::vector<double>& parameters) const;
};

/// "ward", "lafortune (2)" with two lobes, "ward, no diffuse term" for a submodel: for people.
std::string variant_name(const std::string& model, std::size_t repeats, const std::string& submodel = "");

/// A simpler form of a model, for those whom it serves as well: parameters held, or a part of its text left out.
struct Submodel {
    std::string name;                     ///< for people and the wire, e.g. "no diffuse term"
    std::map<std::string, double> fixed;  ///< parameters that are held
    std::vector<Model> variants;          ///< of a text of its own, as Family::variants; else empty
};

/// A model file before the number of lobes is settled.
struct Family {
    std::string name;
    struct Repeat {
        std::string name;    ///< of the group, e.g. "lobe"
        std::string option;  ///< of the request, e.g. "lobes"
        std::size_t min = 1;
        std::size_t max = 1;
        std::size_t auto_max = 1;  ///< most lobes that "auto" tries
    };
    std::optional<Repeat> repeat{};
    std::vector<Model> variants;  ///< one, or one for each number of repeats from min to max

    std::vector<Submodel> submodels;

    /// The variant with that many repeats (ignored without a repeated group), of a submodel where that has a text of
    /// its own. Throws std::out_of_range.
    [[nodiscard]] const Model& variant(std::size_t repeats = 1, const Submodel* submodel = nullptr) const;
    /// nullptr if there is none.
    [[nodiscard]] const Submodel* submodel(std::string_view name) const;
    /// Every text: the variants, and those of submodels.
    [[nodiscard]] std::vector<const Model*> texts() const;
};

/// A model file that cannot be used; what() names the file and the reason.
class ModelFileError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// Reads one model file. `file` is its name in messages. Throws ModelFileError.
Family parse_family(std::string_view name, std::string_view file, std::string_view text);

/// All models by name. Built-in ones first, fewest parameters first, then those of the given folders (*.cl); a name
/// twice is an error.
class Catalogue {
public:
    /// Throws ModelFileError.
    explicit Catalogue(const std::vector<std::filesystem::path>& folders = {});

    [[nodiscard]] const std::vector<Family>& families() const { return families_; }
    /// nullptr if there is none.
    [[nodiscard]] const Family* find(std::string_view name) const;
    /// "lambert, phong, ..." for messages.
    [[nodiscard]] std::string names() const;

private:
    void add(Family family);
    std::vector<Family> families_;
};

}  // namespace brdfit::kernels
