#include "kernels/model.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iterator>
#include <set>
#include <sstream>

#include <nlohmann/json.hpp>  // the header of a model file is JSON: the parser we have anyway

#include "kernels/embedded.h"
#include "kernels/geometry.h"
#include "kernels/text_place.h"

namespace brdfit::kernels {
namespace {

using nlohmann::json;

constexpr std::string_view kOpening = "/*{";
constexpr std::string_view kClosing = "}*/";
constexpr int kDeepest = 16;

[[noreturn]] void refuse(std::string_view file, const std::string& reason) {
    throw ModelFileError(std::string(file) + ": " + reason);
}

bool is_identifier(std::string_view name) {
    const auto ok = [](char c) { return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '_'; };
    return !name.empty() && name[0] >= 'a' && name[0] <= 'z' && std::all_of(name.begin(), name.end(), ok);
}

/// Reads members of a JSON object and refuses those nobody asked for.
class Reader {
public:
    Reader(const json& object, std::string file, std::string where)
        : object_(object), file_(std::move(file)), where_(std::move(where)) {
        if (!object.is_object()) refuse(file_, where_ + " must be an object");
    }

    const json* optional(const char* key) {
        asked_.insert(key);
        const auto it = object_.find(key);
        return it == object_.end() ? nullptr : &*it;
    }
    const json& required(const char* key) {
        const json* value = optional(key);
        if (value == nullptr) refuse(file_, where_ + " lacks \"" + key + "\"");
        return *value;
    }
    std::string text(const char* key) {
        const json& value = required(key);
        if (!value.is_string()) refuse(file_, where_ + ": \"" + key + "\" must be a string");
        return value.get<std::string>();
    }
    std::string identifier(const char* key) {
        std::string value = text(key);
        if (!is_identifier(value))
            refuse(file_, where_ + ": \"" + key + "\" must be a lower-case identifier, not \"" + value + "\"");
        return value;
    }
    double number(const char* key) {
        const json& value = required(key);
        if (!value.is_number()) refuse(file_, where_ + ": \"" + key + "\" must be a number");
        return value.get<double>();
    }
    std::size_t count(const char* key, std::size_t least, std::size_t most) {
        const double value = number(key);
        if (value < static_cast<double>(least) || value > static_cast<double>(most) || value != std::floor(value))
            refuse(file_, where_ + ": \"" + key + "\" must be a whole number from " + std::to_string(least) + " to " +
                              std::to_string(most));
        return static_cast<std::size_t>(value);
    }
    std::vector<std::string> texts(const char* key) {
        const json* value = optional(key);
        if (value == nullptr) return {};
        if (!value->is_array()) refuse(file_, where_ + ": \"" + key + "\" must be an array of strings");
        std::vector<std::string> result;
        for (const json& item : *value) {
            if (!item.is_string()) refuse(file_, where_ + ": \"" + key + "\" must be an array of strings");
            result.push_back(item.get<std::string>());
        }
        return result;
    }
    /// An array; empty if it is not there.
    const json& array(const char* key) {
        static const json none = json::array();
        const json* value = optional(key);
        if (value == nullptr) return none;
        if (!value->is_array()) refuse(file_, where_ + ": \"" + key + "\" must be an array");
        return *value;
    }
    const json& object(const char* key) {
        static const json none = json::object();
        const json* value = optional(key);
        if (value == nullptr) return none;
        if (!value->is_object()) refuse(file_, where_ + ": \"" + key + "\" must be an object");
        return *value;
    }
    /// An array with at least one element.
    const json& elements(const char* key) {
        (void)required(key);
        const json& value = array(key);
        if (value.empty()) refuse(file_, "\"" + std::string(key) + "\" is empty");
        return value;
    }
    /// [low, high]; null leaves a side as it is.
    void interval(const char* key, double& low, double& high) {
        const json* value = optional(key);
        if (value == nullptr) return;
        const auto bad = [](const json& v) { return !v.is_number() && !v.is_null(); };
        if (!value->is_array() || value->size() != 2 || bad((*value)[0]) || bad((*value)[1]))
            refuse(file_, where_ + ": \"" + key + "\" must be [low, high]");
        if ((*value)[0].is_number()) low = (*value)[0].get<double>();
        if ((*value)[1].is_number()) high = (*value)[1].get<double>();
    }
    void finish() const {
        for (const auto& [key, value] : object_.items())
            if (asked_.count(key) == 0) refuse(file_, where_ + " has the unknown key \"" + key + "\"");
    }

private:
    const json& object_;
    std::string file_;
    std::string where_;
    std::set<std::string> asked_;
};

Parameter read_parameter(const json& object, const std::string& file) {
    Reader r(object, file, "a parameter");
    Parameter p;
    p.name = r.identifier("name");
    p.unit = r.text("unit");
    if (p.unit != "1" && p.unit != "wavelength") refuse(file, p.name + ": \"unit\" must be \"1\" or \"wavelength\"");
    p.doc = r.text("doc");
    p.min = r.number("min");
    p.max = r.number("max");
    r.interval("domain", p.domain_min, p.domain_max);
    p.typical_min = p.min;
    p.typical_max = p.max;
    r.interval("typical", p.typical_min, p.typical_max);
    const std::string scale = r.text("scale");
    if (scale != "linear" && scale != "log") refuse(file, p.name + ": \"scale\" must be \"linear\" or \"log\"");
    p.scale = scale == "log" ? Scale::logarithmic : Scale::linear;
    r.finish();
    if (!(p.domain_min <= p.min && p.min <= p.typical_min && p.typical_min < p.typical_max && p.typical_max <= p.max &&
          p.max <= p.domain_max && std::isfinite(p.max - p.min)))
        refuse(file, p.name + ": need domain min <= min <= typical min < typical max <= max <= domain max");
    if (p.scale == Scale::logarithmic && !(p.min > 0)) refuse(file, p.name + ": a logarithmic scale needs min > 0");
    return p;
}

/// A header, read but with its repeated group not yet multiplied.
struct Header {
    Model model;  // everything but terms, charts and special cases
    std::vector<Parameter> group;
    std::optional<Family::Repeat> repeat;
    std::string order_by;
    struct NamedTerm {
        std::string name, factor;
        std::vector<std::string> of, plane;
        std::string degree;
        double pole = 0;
        std::optional<std::pair<std::size_t, std::size_t>> columns;
        bool repeated = false;
    };
    std::vector<NamedTerm> terms;
    std::vector<std::vector<std::string>> charts;
    std::vector<std::pair<std::string, std::map<std::string, double>>> special_cases;
    struct NamedSubmodel {
        std::string name, define;
        std::map<std::string, double> fixed;
    };
    std::vector<NamedSubmodel> submodels;
};

bool are_different(const std::vector<std::string>& names, std::size_t count) {
    return names.size() == count && std::set(names.begin(), names.end()).size() == count;
}

bool in_group(const Header& header, const std::string& name) {
    return std::any_of(header.group.begin(), header.group.end(), [&](const Parameter& p) { return p.name == name; });
}

void read_repeated(const json& object, const std::string& file, Header& header) {
    Reader r(object, file, "\"repeated\"");
    Family::Repeat repeat;
    repeat.name = r.identifier("name");
    repeat.option = r.identifier("option");
    repeat.min = r.count("min", 1, 8);
    repeat.max = r.count("max", repeat.min, 8);
    repeat.auto_max = r.count("auto_max", repeat.min, repeat.max);
    header.order_by = r.text("order_by");
    for (const json& p : r.elements("parameters")) header.group.push_back(read_parameter(p, file));
    r.finish();
    if (!in_group(header, header.order_by)) refuse(file, "\"order_by\" must name a parameter of the group");
    header.repeat = repeat;
}

std::pair<std::size_t, std::size_t> read_columns(const std::vector<std::string>& names, const std::string& file) {
    const auto place = [&](const std::string& name) {
        const auto columns = geometry_columns();
        const auto it = std::find_if(columns.begin(), columns.end(), [&](const auto& c) { return c.name == name; });
        if (it == columns.end()) refuse(file, "there is no geometry column \"" + name + "\"");
        return static_cast<std::size_t>(it - columns.begin());
    };
    if (!are_different(names, 2)) refuse(file, "\"columns\" must name two geometry columns");
    return {place(names[0]), place(names[1])};
}

Header::NamedTerm read_term(const json& object, const std::string& file) {
    Reader r(object, file, "a term");
    Header::NamedTerm term;
    term.name = r.identifier("name");
    if (r.optional("factor") != nullptr) term.factor = r.text("factor");
    term.of = r.texts("of");
    if (!are_different(term.of, term.of.size())) refuse(file, "\"of\" names a parameter twice");
    if (const json* homogeneous = r.optional("homogeneous")) {
        Reader h(*homogeneous, file, "\"homogeneous\"");
        term.plane = h.texts("in");
        term.degree = h.text("degree");
        double x = 0;
        double y = 0;
        h.interval("pole", x, y);
        if (x == 0 && y == 0) refuse(file, "\"homogeneous\" needs a \"pole\" [x, y] other than [0, 0]");
        term.pole = std::atan2(y, x);
        if (h.optional("columns") != nullptr) term.columns = read_columns(h.texts("columns"), file);
        h.finish();
        const auto depends = [&](const std::string& name) {
            return std::find(term.of.begin(), term.of.end(), name) != term.of.end();
        };
        std::vector<std::string> all = term.plane;
        all.push_back(term.degree);
        if (!are_different(all, 3) || !std::all_of(all.begin(), all.end(), depends) || !term.factor.empty())
            refuse(file, "\"homogeneous\" needs two parameters and a degree the term depends on, and no factor");
    }
    r.finish();
    return term;
}

/// The member "fixed" of a special case or a submodel: parameters and what they are held at.
std::map<std::string, double> read_fixed(Reader& reader, const std::string& what, const std::string& file) {
    std::map<std::string, double> fixed;
    for (const auto& [name, value] : reader.object("fixed").items()) {
        if (!value.is_number()) refuse(file, what + " fixes parameters to numbers");
        fixed[name] = value.get<double>();
    }
    return fixed;
}

Header::NamedSubmodel read_submodel(const json& object, const std::string& file) {
    Reader r(object, file, "a submodel");
    Header::NamedSubmodel submodel{r.text("name"), "", read_fixed(r, "a submodel", file)};
    if (r.optional("define") != nullptr) submodel.define = r.identifier("define");
    r.finish();
    if (submodel.fixed.empty() == submodel.define.empty())
        refuse(file, "a submodel needs either \"fixed\" parameters or a \"define\"");
    return submodel;
}

Header read_header(const json& object, const std::string& file) {
    Header header;
    Reader r(object, file, "the header");
    header.model.title = r.text("title");
    header.model.source = r.text("source");
    header.model.formula = r.text("formula");
    for (const json& p : r.elements("parameters")) header.model.parameters.push_back(read_parameter(p, file));
    if (const json* repeated = r.optional("repeated")) read_repeated(*repeated, file, header);
    for (const json& t : r.elements("terms")) {
        header.terms.push_back(read_term(t, file));
        const auto same = [&](const auto& term) { return term.name == header.terms.back().name; };
        if (std::count_if(header.terms.begin(), header.terms.end(), same) > 1)
            refuse(file, "term \"" + header.terms.back().name + "\" stands twice");
    }
    for (const json& c : r.array("charts")) {
        Reader chart(c, file, "a chart");
        if (chart.text("kind") != "complex_index") refuse(file, "a chart's \"kind\" must be \"complex_index\"");
        header.charts.push_back(chart.texts("parameters"));
        chart.finish();
        if (!are_different(header.charts.back(), 2)) refuse(file, "\"complex_index\" needs two parameters: n and k");
    }
    for (const json& c : r.array("special_cases")) {
        Reader special(c, file, "a special case");
        const std::map<std::string, double> fixed = read_fixed(special, "a special case", file);
        if (fixed.empty()) refuse(file, "a special case fixes no parameter");
        header.special_cases.emplace_back(special.text("name"), fixed);
        special.finish();
    }
    for (const json& s : r.array("submodels")) {
        header.submodels.push_back(read_submodel(s, file));
        const auto same = [&](const auto& submodel) { return submodel.name == header.submodels.back().name; };
        if (std::count_if(header.submodels.begin(), header.submodels.end(), same) > 1)
            refuse(file, "submodel \"" + header.submodels.back().name + "\" stands twice");
    }
    for (const auto& [name, value] : r.object("traits").items()) {
        if (!value.is_boolean()) refuse(file, "\"traits\" are true or false");
        header.model.traits[name] = value.get<bool>();
    }
    r.finish();
    return header;
}

/// The header's JSON, which stands between /* and the end of this text. Messages say where it ceases to be JSON.
json parse_header(std::string_view text, const std::string& file) {
    std::size_t read = 2;
    const auto fail = [&](const std::string& reason) {
        const TextPlace at = place_of(text, read - 1);
        refuse(file, "line " + std::to_string(at.line) + ", column " + std::to_string(at.column) + ": " + reason);
    };
    std::vector<std::set<std::string>> keys;  // of the objects that are open
    const auto watch = [&](int depth, json::parse_event_t event, json& value) {
        if (depth > kDeepest) fail("the header is nested too deeply");
        if (event == json::parse_event_t::object_start) keys.emplace_back();
        else if (event == json::parse_event_t::object_end) keys.pop_back();
        else if (event == json::parse_event_t::key && !keys.back().insert(value.get<std::string>()).second)
            fail("the key \"" + value.get<std::string>() + "\" stands twice");
        return true;
    };
    std::size_t unused = 0;  // of the end, which does not move
    try {
        return json::parse(CountedChars(text.data() + read, read), CountedChars(text.data() + text.size(), unused),
                           watch);
    } catch (const json::parse_error&) {
        fail("the header is not JSON from here on");
    } catch (const json::out_of_range&) {
        fail("the number is too large for a double");
    }
    return {};
}

std::size_t index_of(const Model& model, const std::string& name, std::string_view file) {
    const auto index = model.find(name);
    if (!index) refuse(file, "there is no parameter \"" + name + "\"");
    return *index;
}

std::string upper(std::string text) {
    std::transform(text.begin(), text.end(), text.begin(),
                   [](char c) { return c >= 'a' && c <= 'z' ? static_cast<char>(c - 'a' + 'A') : c; });
    return text;
}

/// The generated part of the kernel text: structs and tables that follow from the header.
std::string generate_prelude(const Model& model, const Header& header) {
    std::ostringstream out;
    std::string macro;
    if (header.repeat) {
        macro = upper(header.repeat->option);
        out << "#define " << macro << ' ' << model.repeats << '\n';
    }
    out << "typedef struct {\n";
    for (const Parameter& p : header.model.parameters) out << "    real " << p.name << ";\n";
    if (header.repeat) {
        out << "    struct {\n        real";
        for (std::size_t i = 0; i < header.group.size(); ++i) out << (i ? ", " : " ") << header.group[i].name;
        out << ";\n    } " << header.repeat->name << '[' << macro << "];\n";
    }
    out << "} Params;\ntypedef struct {\n";
    for (const Header::NamedTerm& term : header.terms) {
        out << "    struct {\n        real value";
        for (const std::string& name : term.of) out << ", " << name;
        out << ";\n    } " << term.name;
        if (term.repeated) out << '[' << macro << ']';
        out << ";\n";
    }
    out << "} Terms;\n";

    const std::vector<std::size_t> nonlinear = model.nonlinear();
    std::ostringstream values, slope_terms, slope_values, slope_columns, parameters;
    for (const std::size_t parameter : nonlinear) parameters << parameter << ',';
    std::size_t value = 0;
    std::size_t slopes = 0;
    for (std::size_t t = 0; t < model.terms.size(); ++t) {
        values << value++ << ',';
        for (const std::size_t parameter : model.terms[t].of) {
            slope_terms << t << ',';
            slope_values << value++ << ',';
            slope_columns << std::lower_bound(nonlinear.begin(), nonlinear.end(), parameter) - nonlinear.begin() << ',';
            ++slopes;
        }
    }
    const auto table = [&](const char* name, const std::ostringstream& entries) {
        out << "constant int " << name << "[] = {" << (entries.str().empty() ? "0" : entries.str()) << "};\n";
    };
    out << "#define PARAMETERS " << model.parameters.size() << "\n#define TERMS " << model.terms.size()
        << "\n#define TERM_VALUES " << value << "\n#define SLOPES " << slopes << "\n#define NONLINEAR "
        << nonlinear.size() << "\n#define ADD_ALL_ROWS";
    for (std::size_t row = 0; row < value; row += 2) out << " ADD_ROWS(" << row << ')';
    out << '\n';
    table("term_value", values);
    table("slope_term", slope_terms);
    table("slope_value", slope_values);
    table("slope_column", slope_columns);
    table("nonlinear_parameter", parameters);
    // Within a kernel that asks for no slopes they need not be formed.
    out << "static void brdf(Params p, Geometry s, Terms *f) __attribute__((always_inline));\n";
    return out.str();
}

Model make_variant(const Header& header, std::size_t repeats, const std::string& file) {
    Model model = header.model;
    model.repeats = repeats;
    const auto suffixed = [](const std::string& name, std::size_t j) { return name + "_" + std::to_string(j + 1); };
    model.group_begin = model.parameters.size();
    model.group_size = header.group.size();
    for (std::size_t i = 0; i < header.group.size(); ++i)
        if (header.group[i].name == header.order_by) model.order_by = i;
    for (std::size_t j = 0; j < repeats; ++j)
        for (Parameter p : header.group) {
            p.name = suffixed(p.name, j);
            p.repeat = j;
            model.parameters.push_back(std::move(p));
        }
    std::set<std::string> seen;
    for (const Parameter& p : model.parameters)
        if (!seen.insert(p.name).second) refuse(file, "parameter \"" + p.name + "\" stands twice");

    for (const Header::NamedTerm& named : header.terms)
        for (std::size_t j = 0; j < (named.repeated ? repeats : 1); ++j) {
            const auto resolve = [&](const std::string& name) {
                return index_of(model, in_group(header, name) ? suffixed(name, j) : name, file);
            };
            Term term;
            term.name = named.repeated ? suffixed(named.name, j) : named.name;
            if (!named.factor.empty()) term.factor = resolve(named.factor);
            for (const std::string& name : named.of) term.of.push_back(resolve(name));
            if (!named.plane.empty())
                term.homogeneous = Term::Homogeneous{{resolve(named.plane[0]), resolve(named.plane[1])},
                                                     resolve(named.degree),
                                                     named.pole,
                                                     named.columns};
            model.terms.push_back(std::move(term));
        }
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        std::size_t factors = 0;
        bool used = false;
        for (const Term& term : model.terms) {
            if (term.factor == i) ++factors;
            used = used || std::find(term.of.begin(), term.of.end(), i) != term.of.end();
        }
        if (factors + (used ? 1 : 0) != 1)
            refuse(file, "parameter \"" + model.parameters[i].name +
                             "\" must be the factor of one term, or one that terms depend on");
    }
    for (const auto& names : header.charts)
        model.charts.push_back(
            {Chart::Kind::complex_index, {index_of(model, names[0], file), index_of(model, names[1], file)}});
    for (const auto& [name, fixed] : header.special_cases) {
        SpecialCase special{name, {}};
        for (const auto& [parameter, value] : fixed) {
            const std::size_t i = index_of(model, parameter, file);
            if (value < model.parameters[i].domain_min || value > model.parameters[i].domain_max)
                refuse(file, "a special case fixes " + parameter + " outside its domain");
            special.fixed[i] = value;
        }
        model.special_cases.push_back(std::move(special));
    }
    model.prelude = generate_prelude(model, header);
    return model;
}

std::vector<Model> make_variants(const Header& header, const std::string& file) {
    if (!header.repeat) return {make_variant(header, 0, file)};
    std::vector<Model> variants;
    for (std::size_t repeats = header.repeat->min; repeats <= header.repeat->max; ++repeats)
        variants.push_back(make_variant(header, repeats, file));
    return variants;
}

Submodel make_submodel(const Header& header, const Header::NamedSubmodel& named, const std::vector<Model>& variants,
                       const std::string& file) {
    Submodel submodel{named.name, named.fixed, {}};
    const Model& smallest = variants.front();
    for (const auto& [name, value] : named.fixed) {
        const Parameter& parameter = smallest.parameters[index_of(smallest, name, file)];
        if (value < parameter.domain_min || value > parameter.domain_max)
            refuse(file, "a submodel fixes " + name + " outside its domain");
    }
    if (named.define.empty()) return submodel;
    submodel.variants = variants;
    for (Model& model : submodel.variants) {
        model.name = header.model.name + "_" + named.define;
        model.prelude = "#define " + upper(named.define) + " 1\n" + model.prelude;
    }
    return submodel;
}

}  // namespace

std::string variant_name(const std::string& model, std::size_t repeats, const std::string& submodel) {
    return model + (repeats == 0 ? "" : " (" + std::to_string(repeats) + ")") +
           (submodel.empty() ? "" : ", " + submodel);
}

std::optional<std::size_t> Model::find(std::string_view parameter) const {
    for (std::size_t i = 0; i < parameters.size(); ++i)
        if (parameters[i].name == parameter) return i;
    return std::nullopt;
}

bool Model::is_linear(std::size_t parameter) const {
    return std::any_of(terms.begin(), terms.end(), [&](const Term& t) { return t.factor == parameter; });
}

std::vector<std::size_t> Model::nonlinear() const {
    std::set<std::size_t> result;
    for (const Term& term : terms) result.insert(term.of.begin(), term.of.end());
    return {result.begin(), result.end()};
}

bool Model::sums_series() const { return text.find("LOG_EPSILON") != std::string::npos; }

std::size_t Model::term_values() const {
    std::size_t values = 0;
    for (const Term& term : terms) values += 1 + term.of.size();
    return values;
}

std::vector<double> Model::coefficients(const std::vector<double>& values) const {
    std::vector<double> c;
    c.reserve(terms.size());
    for (const Term& term : terms) c.push_back(term.factor ? values.at(*term.factor) : 1.0);
    return c;
}

const Model& Family::variant(std::size_t repeats, const Submodel* submodel) const {
    const std::vector<Model>& models =
        submodel != nullptr && !submodel->variants.empty() ? submodel->variants : variants;
    return repeat ? models.at(repeats - repeat->min) : models.at(0);
}

const Submodel* Family::submodel(std::string_view wanted) const {
    for (const Submodel& submodel : submodels)
        if (submodel.name == wanted) return &submodel;
    return nullptr;
}

std::vector<const Model*> Family::texts() const {
    std::vector<const Model*> models;
    for (const Model& model : variants) models.push_back(&model);
    for (const Submodel& submodel : submodels)
        for (const Model& model : submodel.variants) models.push_back(&model);
    return models;
}

Family parse_family(std::string_view name, std::string_view file_view, std::string_view text) {
    const std::string file(file_view);
    if (!is_identifier(name)) refuse(file, "the file's name must be a lower-case identifier");
    const auto end = text.find(kClosing);
    if (!text.starts_with(kOpening) || end == std::string_view::npos)
        refuse(file, "must begin with a JSON header between /* and */: /*{ ... }*/");
    const json object = parse_header(text.substr(0, end + 1), file);
    Header header = read_header(object, file);
    header.model.name = std::string(name);
    header.model.file = file;
    header.model.text = std::string(text);
    for (Header::NamedTerm& term : header.terms)
        term.repeated =
            std::any_of(term.of.begin(), term.of.end(), [&](const auto& n) { return in_group(header, n); }) ||
            in_group(header, term.factor);

    Family family;
    family.name = std::string(name);
    family.repeat = header.repeat;
    family.variants = make_variants(header, file);
    for (const Header::NamedSubmodel& submodel : header.submodels)
        family.submodels.push_back(make_submodel(header, submodel, family.variants, file));
    return family;
}

Catalogue::Catalogue(const std::vector<std::filesystem::path>& folders) {
    for (const EmbeddedModel& model : embedded_models())
        add(parse_family(model.name, "models/" + std::string(model.name) + ".cl", model.text));
    std::stable_sort(families_.begin(), families_.end(), [](const Family& a, const Family& b) {
        return a.variants.front().parameters.size() < b.variants.front().parameters.size();
    });
    for (const auto& folder : folders) {
        std::error_code error;
        std::vector<std::filesystem::path> files;
        for (const auto& entry : std::filesystem::directory_iterator(folder, error))
            if (entry.path().extension() == ".cl") files.push_back(entry.path());
        if (error) throw ModelFileError(folder.string() + ": " + error.message());
        std::sort(files.begin(), files.end());
        for (const auto& file : files) {
            std::ifstream in(file, std::ios::binary);
            const std::string text{std::istreambuf_iterator<char>(in), {}};
            if (!in) throw ModelFileError(file.string() + ": cannot be read");
            add(parse_family(file.stem().string(), file.filename().string(), text));
        }
    }
}

void Catalogue::add(Family family) {
    if (find(family.name) != nullptr)
        throw ModelFileError(family.variants.front().file + ": there is a model of that name already");
    families_.push_back(std::move(family));
}

const Family* Catalogue::find(std::string_view name) const {
    for (const Family& family : families_)
        if (family.name == name) return &family;
    return nullptr;
}

std::string Catalogue::names() const {
    std::string names;
    for (const Family& family : families_) names += (names.empty() ? "" : ", ") + family.name;
    return names;
}

}  // namespace brdfit::kernels
