// Model files: what a header must hold, and that a file is all a model needs.

#include "kernels/model.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <fstream>

#include "optim/fit.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Catalogue;
using kernels::Family;
using kernels::Model;
using kernels::ModelFileError;
using testing::AllOf;
using testing::HasSubstr;

/// A folder that goes with the test.
class Folder {
public:
    Folder() : path_(std::filesystem::temp_directory_path() / ("brdfit_models_" + std::to_string(::getpid()))) {
        std::filesystem::create_directories(path_);
    }
    ~Folder() { std::filesystem::remove_all(path_); }
    Folder(const Folder&) = delete;
    Folder& operator=(const Folder&) = delete;
    void write(const std::string& name, const std::string& text) const { std::ofstream(path_ / name) << text; }
    [[nodiscard]] const std::filesystem::path& path() const { return path_; }

private:
    std::filesystem::path path_;
};

/// Minnaert's moon: f = albedo (k + 1)/(2 pi) (cos theta_i cos theta_r)^(k - 1).
const std::string kHeader = R"cl(/*{
  "title": "Minnaert",
  "source": "Minnaert 1941",
  "formula": "f = albedo (k + 1)/(2 pi) (cos theta_i cos theta_r)^(k - 1)",
  "parameters": [
    {"name": "albedo", "unit": "1", "min": 0, "max": 1, "scale": "linear", "doc": "albedo at normal incidence"},
    {"name": "k", "unit": "1", "min": 0.1, "max": 4, "domain": [0, null], "scale": "log", "doc": "limb darkening"}
  ],
  "terms": [{"name": "moon", "factor": "albedo", "of": ["k"]}],
  "traits": {"reciprocal": true, "energy_conserving": false}
}*/
)cl";
const std::string kBody = R"cl(
void brdf(Params p, Geometry s, Terms *f) {
    const real l = log(s.ci * s.cr);
    const real e = exp((p.k - 1.0) * l);
    f->moon.value = (p.k + 1.0) / (2.0 * PI) * e;
    f->moon.k = e / (2.0 * PI) * (1.0 + (p.k + 1.0) * l);
}
)cl";

std::string replaced(std::string text, const std::string& from, const std::string& to) {
    const auto at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    return text.replace(at, from.size(), to);
}

/// The message of the refusal, "" if there is none.
std::string refusal(const std::string& text, const std::string& name = "minnaert") {
    try {
        (void)kernels::parse_family(name, "folder/" + name + ".cl", text);
        return "";
    } catch (const ModelFileError& error) {
        return error.what();
    }
}

TEST(BuiltInModels, AreAllThereWithTheirParameters) {
    const auto names = [](const std::string& model) {
        std::vector<std::string> result;
        for (const kernels::Parameter& p : variant(model).parameters) result.push_back(p.name);
        return result;
    };
    EXPECT_EQ(catalogue().families().size(), 5U);
    EXPECT_THAT(names("lambert"), testing::ElementsAre("k_d"));
    EXPECT_THAT(names("phong"), testing::ElementsAre("k_d", "k_s", "n"));
    EXPECT_THAT(names("ward"), testing::ElementsAre("rho_d", "rho_s", "alpha"));
    EXPECT_THAT(names("lafortune_2"), testing::ElementsAre("k_d", "c_xy_1", "c_z_1", "n_1", "c_xy_2", "c_z_2", "n_2"));
    EXPECT_THAT(names("he_torrance"), testing::ElementsAre("sigma", "tau", "n", "k", "rho_ud"));
    for (const Model* model : variants()) {
        EXPECT_FALSE(model->title.empty() || model->source.empty() || model->formula.empty()) << model->name;
        EXPECT_TRUE(model->traits.count("reciprocal")) << model->name;
        for (const kernels::Parameter& p : model->parameters) EXPECT_FALSE(p.doc.empty()) << p.name;
    }
    EXPECT_EQ(catalogue().find("blinn"), nullptr);
    EXPECT_THAT(catalogue().names(), AllOf(HasSubstr("ward"), HasSubstr("he_torrance")));
}

TEST(BuiltInModels, KnowTheirLinearParameters) {
    EXPECT_TRUE(variant("phong").is_linear(0) && variant("phong").is_linear(1) && !variant("phong").is_linear(2));
    EXPECT_TRUE(variant("he_torrance").is_linear(4) && !variant("he_torrance").is_linear(0));
    EXPECT_EQ(variant("lafortune_3").terms.size(), 4U);
    EXPECT_EQ(variant("lafortune_3").term_values(), 13U);
    EXPECT_EQ(variant("ward").coefficients({0.3, 0.2, 0.1}), (std::vector<double>{0.3, 0.2}));
}

TEST(Header, OfAWholeModelIsRead) {
    EXPECT_EQ(refusal(kHeader + kBody), "");
    const Family family = kernels::parse_family("minnaert", "minnaert.cl", kHeader + kBody);
    ASSERT_EQ(family.variants.size(), 1U);
    const Model& model = family.variants[0];
    EXPECT_EQ(model.parameters[1].scale, kernels::Scale::logarithmic);
    EXPECT_EQ(model.parameters[1].domain_min, 0);
    EXPECT_TRUE(std::isinf(model.parameters[1].domain_max));
    EXPECT_EQ(model.parameters[1].typical_max, 4);
    EXPECT_EQ(model.terms[0].factor, 0U);
}

TEST(BuiltInModels, KnowTheirSimplerForms) {
    const Family& he = *catalogue().find("he_torrance");
    const kernels::Submodel* real = he.submodel("real index");
    ASSERT_NE(real, nullptr);
    EXPECT_EQ(real->fixed, (std::map<std::string, double>{{"k", 0}}));
    EXPECT_EQ(&he.variant(1, real), &he.variants[0]) << "the same text";
    const kernels::Submodel* plain = he.submodel("no effective roughness");
    ASSERT_NE(plain, nullptr);
    EXPECT_TRUE(plain->fixed.empty());
    EXPECT_EQ(he.variant(1, plain).name, "he_torrance_roughness_as_given");
    EXPECT_EQ(he.submodel("no lobe"), nullptr);
    EXPECT_EQ(he.texts().size(), 2U);
    EXPECT_EQ(catalogue().find("lafortune")->texts().size(), 3U);
}

TEST(Header, MistakesAreRefusedWithTheFileAndTheReason) {
    const struct {
        std::string from, to, reason;
    } mistakes[] = {
        {"/*{", "{", "must begin with a JSON header"},
        {"}*/", "}", "must begin with a JSON header"},
        {"\"title\": \"Minnaert\",", "\"title\": Minnaert,", "line 2, column 12: the header is not JSON"},
        {"\"min\": 0.1", "\"min\": 1e999", "line 7, column 44: the number is too large for a double"},
        {"\"source\"", "\"title\": \"M\", \"source\"", "line 3, column 9: the key \"title\" stands twice"},
        {"\"traits\"", "\"traits\": [[[[[[[[[[[[[[[[[[", "line 10, column 29: the header is nested too deeply"},
        {"\"source\": \"Minnaert 1941\",", "", "lacks \"source\""},
        {"\"title\": \"Minnaert\"", "\"title\": 3", "\"title\" must be a string"},
        {"\"source\"", "\"colour\": 1, \"source\"", "unknown key \"colour\""},
        {"\"unit\": \"1\"", "\"units\": \"1\"", "lacks \"unit\""},
        {"\"unit\": \"1\"", "\"unit\": \"um\"", "\"unit\" must be"},
        {"\"name\": \"albedo\"", "\"name\": \"Albedo\"", "identifier"},
        {"\"min\": 0, \"max\": 1", "\"min\": 2, \"max\": 1", "albedo: need domain min"},
        {"\"min\": 0.1", "\"min\": \"low\"", "\"min\" must be a number"},
        {"\"min\": 0.1", "\"min\": 0", "logarithmic scale needs min > 0"},
        {"[0, null]", "[0.5, null]", "need domain min"},
        {"[0, null]", "[0]", "[low, high]"},
        {"\"scale\": \"log\"", "\"scale\": \"cubic\"", "\"scale\" must be"},
        {"\"name\": \"k\"", "\"name\": \"albedo\"", "stands twice"},
        {"\"of\": [\"k\"]", "\"of\": [\"k\", \"albedo\"]",
         "must be the factor of one term, or one that terms depend on"},
        {", \"of\": [\"k\"]", "", "\"k\" must be the factor"},
        {"\"of\": [\"k\"]", "\"of\": [\"q\"]", "no parameter \"q\""},
        {"\"factor\": \"albedo\"", "\"factor\": \"q\"", "no parameter \"q\""},
        {"[{\"name\": \"moon\", \"factor\": \"albedo\", \"of\": [\"k\"]}]", "[]", "\"terms\" is empty"},
        {"\"of\": [\"k\"]}]", "\"of\": [\"k\"]}, {\"name\": \"moon\"}]", "term \"moon\" stands twice"},
        {"\"of\": [\"k\"]", "\"of\": [\"k\", \"k\"]", "\"of\" names a parameter twice"},
        {"\"min\": 0, \"max\": 1", "\"min\": -1e308, \"max\": 1e308", "albedo: need"},
        {"{\"reciprocal\": true, \"energy_conserving\": false}", "true", "\"traits\" must be an object"},
        {"\"traits\"", "\"charts\": {}, \"traits\"", "\"charts\" must be an array"},
        {"\"traits\"", "\"charts\": [{\"kind\": \"complex_index\", \"parameters\": [\"k\", \"k\"]}], \"traits\"",
         "needs two parameters"},
        {"\"traits\"", "\"special_cases\": [{\"name\": \"x\", \"fixed\": {\"k\": -1}}], \"traits\"",
         "fixes k outside its domain"},
        {"\"traits\"", "\"special_cases\": [{\"name\": \"x\", \"fixed\": {}}], \"traits\"", "fixes no parameter"},
        {"\"traits\"", "\"submodels\": [{\"name\": \"x\"}], \"traits\"", "needs either"},
        {"\"traits\"", "\"submodels\": [{\"name\": \"x\", \"fixed\": {\"k\": 1}, \"define\": \"x\"}], \"traits\"",
         "needs either"},
        {"\"traits\"", "\"submodels\": [{\"name\": \"x\", \"fixed\": {\"k\": -1}}], \"traits\"",
         "fixes k outside its domain"},
        {"\"traits\"", "\"submodels\": [{\"name\": \"x\", \"fixed\": {\"q\": 1}}], \"traits\"", "no parameter \"q\""},
        {"\"traits\"",
         "\"submodels\": [{\"name\": \"x\", \"define\": \"a\"}, {\"name\": \"x\", \"define\": \"b\"}], \"traits\"",
         "submodel \"x\" stands twice"},
        {"\"reciprocal\": true", "\"reciprocal\": \"yes\"", "true or false"},
        {"\"traits\"", "\"charts\": [{\"kind\": \"polar\", \"parameters\": [\"k\"]}], \"traits\"", "complex_index"},
        {"\"traits\"", "\"special_cases\": [{\"name\": \"x\", \"fixed\": {\"q\": 1}}], \"traits\"",
         "no parameter \"q\""},
    };
    for (const auto& mistake : mistakes)
        EXPECT_THAT(refusal(replaced(kHeader, mistake.from, mistake.to) + kBody),
                    AllOf(HasSubstr("folder/minnaert.cl"), HasSubstr(mistake.reason)))
            << mistake.from << " -> " << mistake.to;
    EXPECT_THAT(refusal(kHeader + kBody, "Minnaert"), HasSubstr("lower-case identifier"));
    EXPECT_THAT(refusal("", "empty"), HasSubstr("folder/empty.cl"));
}

TEST(Header, OfTheWrongShapeIsRefusedRatherThanCrashing) {
    // Arrays where objects should be and the like: whatever it is, it is a ModelFileError.
    for (const char* text :
         {"/*{}*/",
          "/*{\"title\": \"t\", \"source\": \"s\", \"formula\": \"f\", \"parameters\": [], \"terms\": [{\"name\": "
          "\"a\"}]}*/",
          "/*{\"title\": \"t\", \"source\": \"s\", \"formula\": \"f\", \"parameters\": 3, \"terms\": []}*/",
          "/*{\"title\": \"t\", \"source\": \"s\", \"formula\": \"f\", \"parameters\": [3], \"terms\": []}*/",
          "/*{\"title\": \"t\", \"source\": \"s\", \"formula\": \"f\", \"parameters\": [], \"terms\": [[]]}*/",
          "/*{\"title\": \"t\", \"source\": \"s\", \"formula\": \"f\", \"parameters\": [], \"terms\": [{\"name\": "
          "\"a\"}], "
          "\"traits\": 3}*/",
          "/*{\"title\": \"t\", \"source\": \"s\", \"formula\": \"f\", \"parameters\": [], \"terms\": [{\"name\": "
          "\"a\"}], "
          "\"special_cases\": [{\"name\": \"x\", \"fixed\": [1]}]}*/"})
        EXPECT_THROW((void)kernels::parse_family("odd", "odd.cl", text), ModelFileError) << text;
}

TEST(ModelFolder, AFileIsAllAModelNeeds) {
    const Folder folder;
    folder.write("minnaert.cl", kHeader + kBody);
    folder.write("notes.txt", "not a model");
    const Catalogue with({folder.path()});
    EXPECT_EQ(with.families().size(), 6U);
    const Family* family = with.find("minnaert");
    ASSERT_NE(family, nullptr);
    const Model& model = family->variant();

    // It evaluates, with its slopes,
    const std::vector<kernels::Direction> directions = scan_directions({15, 45, 75}, 5);
    const kernels::Values values =
        kernels::evaluate(engine(), model, engine().best_precision(), {0.4, 1.7}, directions, true);
    for (std::size_t j = 0; j < directions.size(); ++j) {
        const double product =
            std::cos(directions[j].theta_i_deg * M_PI / 180) * std::cos(directions[j].theta_r_deg * M_PI / 180);
        const double f = 0.4 * 2.7 / (2 * M_PI) * std::pow(product, 0.7);
        EXPECT_NEAR(values.f[j], f, 1e-13 * f);
        EXPECT_NEAR(values.by_parameter[j], f / 0.4, 1e-12 * f);
        EXPECT_NEAR(values.by_parameter[directions.size() + j], f * (1 / 2.7 + std::log(product)), 1e-12);
    }
    // and fits.
    optim::Fitter fitter(engine(), 1);
    const optim::Dataset dataset{"moon", optim::Unit::per_steradian, {make_channel(directions, values.f)}};
    optim::ModelRequest request;
    request.family = family;
    const optim::Report report = fitter.fit(dataset, {request}, {});
    ASSERT_EQ(report.channels[0].fits.size(), 1U);
    EXPECT_NEAR(report.channels[0].fits[0].parameters[0].value, 0.4, 1e-6);
    EXPECT_NEAR(report.channels[0].fits[0].parameters[1].value, 1.7, 1e-6);
}

TEST(ModelFolder, ABuildErrorNamesTheFileAndTheLine) {
    const Folder folder;
    const std::string text = kHeader + replaced(kBody, "log(s.ci * s.cr)", "log(s.ci * s.moonshine)");
    folder.write("minnaert.cl", text);
    const Catalogue with({folder.path()});
    const auto at = text.find("moonshine");
    const auto line = 1 + std::count(text.begin(), text.begin() + static_cast<std::ptrdiff_t>(at), '\n');
    try {
        engine().prepare(with.find("minnaert")->variant(), engine().best_precision());
        FAIL() << "built";
    } catch (const kernels::BuildError& error) {
        EXPECT_THAT(error.what(), AllOf(HasSubstr("minnaert.cl:" + std::to_string(line)), HasSubstr("moonshine")));
    }
    // In a request it is a failure beside the models that work.
    optim::Fitter fitter(engine(), 1);
    optim::ModelRequest broken, lambert;
    broken.family = with.find("minnaert");
    lambert.family = with.find("lambert");
    const auto directions = scan_directions({30}, 10);
    const optim::Report report = fitter.fit(
        {"x", optim::Unit::per_steradian, {make_channel(directions, std::vector<double>(directions.size(), 0.1))}},
        {broken, lambert}, {});
    EXPECT_EQ(report.channels[0].fits.size(), 1U);
    ASSERT_EQ(report.channels[0].failures.size(), 1U);
    EXPECT_THAT(report.channels[0].failures[0].reason, HasSubstr("does not build"));
    EXPECT_THAT(report.channels[0].failures[0].detail, HasSubstr("minnaert.cl"));
}

TEST(ModelFolder, ANameTwiceOrAFolderThatIsNotThereIsRefused) {
    const Folder folder;
    folder.write("ward.cl", kHeader + kBody);
    EXPECT_THROW(Catalogue({folder.path()}), ModelFileError);
    EXPECT_THROW(Catalogue({folder.path() / "nowhere"}), ModelFileError);
}

}  // namespace
}  // namespace brdfit::tests
