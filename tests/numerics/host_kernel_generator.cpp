// Writes the kernel texts of all built-in models as one C++ source.
// Call: host_kernel_generator double|single LANES OUTPUT, or host_kernel_generator counted 1 OUTPUT

#include <fstream>
#include <iostream>
#include <set>
#include <sstream>
#include <string>

#include "kernels/engine.h"
#include "kernels/model.h"
#include "tests/support.h"

namespace {

using namespace brdfit;

/// Macros that the text defines.
std::set<std::string> macros_of(const std::string& text) {
    std::set<std::string> macros;
    std::istringstream lines(text);
    for (std::string line, word; std::getline(lines, line);) {
        std::istringstream words(line);
        // Those with arguments are the shim's own vocabulary, or the device's.
        if (words >> word && word == "#define" && words >> word && word.find('(') == std::string::npos)
            macros.insert(word);
    }
    return macros;
}

/// The model's text in a namespace; macros are undefined behind it.
void write_model(std::ostream& out, const kernels::Model& model, bool is_double, unsigned lanes) {
    const auto precision = is_double ? kernels::Precision::double_precision : kernels::Precision::single_precision;
    const std::string text = kernels::program_text(model, precision, lanes);
    const std::set<std::string> macros = macros_of(text);
    out << "namespace " << tests::label(model) << " {\n"
        << text << R"(
std::vector<double> run_terms(std::span<const double> columns, int samples, std::span<const double> parameters) {
    const auto c = narrowed<scalar>(columns), p = narrowed<scalar>(parameters);
    const int candidates = (int)p.size() / PARAMETERS;
    std::vector<scalar> out((std::size_t)(candidates * TERM_VALUES * samples));
    terms(c.data(), samples, candidates, p.data(), out.data());
    return {out.begin(), out.end()};
}
void run_project_in_place(bool gradient, const void* columns, const void* y, const void* w, int samples, int candidates,
                          const void* in, void* scratch, void* out) {
    (gradient ? project : project_value)((const scalar*)columns, (const scalar*)y, (const scalar*)w, samples, candidates,
                                         (const scalar*)in, (scalar*)scratch, (scalar*)out);
}
std::vector<double> run_project(std::span<const double> columns, std::span<const double> y, std::span<const double> w,
                                std::span<const double> parameters, std::span<const double> lower,
                                std::span<const double> upper) {
    const auto c = narrowed<scalar>(columns), ys = narrowed<scalar>(y), ws = narrowed<scalar>(w);
    const int candidates = (int)parameters.size() / PARAMETERS;
    std::vector<scalar> in;
    for (int i = 0; i < candidates; ++i) {
        in.insert(in.end(), parameters.begin() + i * PARAMETERS, parameters.begin() + (i + 1) * PARAMETERS);
        in.insert(in.end(), lower.begin() + i * TERMS, lower.begin() + (i + 1) * TERMS);
        in.insert(in.end(), upper.begin() + i * TERMS, upper.begin() + (i + 1) * TERMS);
    }
    std::vector<scalar> scratch(y.size() * TERM_VALUES);
    std::vector<scalar> out((std::size_t)(candidates * OUT_STRIDE));
    run_project_in_place(true, c.data(), ys.data(), ws.data(), (int)y.size(), candidates, in.data(), scratch.data(),
                         out.data());
    return {out.begin(), out.end()};
}
}
)";
    for (const std::string& macro : macros) out << "#undef " << macro << '\n';
}

/// The model's value with what it takes, in a namespace.
void write_counted(std::ostream& out, const kernels::Model& model) {
    const std::string text = kernels::hemisphere_text(model, kernels::Precision::double_precision, 1);
    out << "namespace " << tests::label(model) << " {\n"
        << text << R"(
double counted_value(std::span<const double> parameters, std::span<const double> coefficients,
                     std::span<const double> vectors, double* counts) {
    tape.entries.clear();
    const auto given = [](double value) { return Counted(value, 0); };
    Params p;
    for (int i = 0; i < PARAMETERS; ++i) ((real *)&p)[i] = given(parameters[i]);
    real c[TERMS];
    for (int i = 0; i < TERMS; ++i) c[i] = given(coefficients[i]);
    const real si = given(vectors[0]), ci = given(vectors[1]);
    const real x = given(vectors[2]), y = given(vectors[3]), z = given(vectors[4]);
    Terms terms;
    brdf(p, plain_geometry_of(si, ci, x, y, z), &terms);
    const real f = combined((const real *)&terms, c);
    tape.count(f.place, counts);
    return f.value;
}
}
)";
    for (const std::string& macro : macros_of(text)) out << "#undef " << macro << '\n';
}

void write_all_counted(std::ostream& out) {
    out << "#define BRDFIT_COUNTED_KERNEL\n#define REAL_IS_DOUBLE 1\n#define LANES 1\n"
           "#include \"tests/numerics/counted.h\"\nnamespace {\n";
    for (const kernels::Model* model : tests::variants()) write_counted(out, *model);
    out << "}\nnamespace brdfit::tests {\nstd::span<const CountedKernel> counted_kernels() {\n"
           "    static const CountedKernel all[] = {\n";
    for (const kernels::Model* model : tests::variants())
        out << "        {\"" << tests::label(*model) << "\", " << tests::label(*model) << "::counted_value},\n";
    out << "    };\n    return all;\n}\n}\n";
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 4) {
        std::cerr << "usage: host_kernel_generator double|single|counted LANES OUTPUT\n";
        return 2;
    }
    const std::string precision = argv[1];
    const auto lanes = static_cast<unsigned>(std::stoul(argv[2]));
    std::ofstream out(argv[3]);
    if (precision == "counted") {
        write_all_counted(out);
        return out.good() ? 0 : 1;
    }
    out << "#define BRDFIT_HOST_KERNEL\n#define REAL_IS_DOUBLE " << (precision == "double" ? 1 : 0)
        << "\n#define LANES " << lanes << "\n#include \"tests/numerics/host_kernel.h\"\nnamespace {\n";
    for (const kernels::Model* model : tests::variants()) write_model(out, *model, precision == "double", lanes);
    out << "}\nnamespace brdfit::tests {\nstd::span<const HostKernel> host_kernels_" << precision
        << "() {\n    static const HostKernel all[] = {\n";
    for (const kernels::Model* model : tests::variants()) {
        const std::string name = tests::label(*model);
        out << "        {\"" << name << "\", kernels::Precision::" << precision << "_precision, " << name
            << "::run_terms, " << name << "::run_project, " << name << "::run_project_in_place},\n";
    }
    out << "    };\n    return all;\n}\n}\n";
    return out.good() ? 0 : 1;
}
