// Prints what compiling costs, in ms of processor time with the linker's: a program from its text, its kernels, the
// same from its binary. docs/performance.md has the figures.

#include <sys/resource.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>

#include "kernels/engine_impl.h"
#include "tests/support.h"

namespace {

double processor_time_ms() {
    double sum = 0;
    for (const auto who : {RUSAGE_SELF, RUSAGE_CHILDREN}) {
        rusage usage{};
        ::getrusage(who, &usage);
        for (const timeval& time : {usage.ru_utime, usage.ru_stime})
            sum += 1e3 * static_cast<double>(time.tv_sec) + 1e-3 * static_cast<double>(time.tv_usec);
    }
    return sum;
}

template <class Work>
double cost_ms(Work work) {
    const double begin = processor_time_ms();
    work();
    return processor_time_ms() - begin;
}

}  // namespace

int main() {
    using namespace brdfit;
    kernels::EngineOptions options;
    options.cache = "";  // an empty folder for PoCL, and none of ours
    std::optional<kernels::Engine> engine;
    std::printf("%-14s %s %8.0f\n", "OpenCL", "init  ", cost_ms([&] { engine.emplace(options); }));
    std::printf("%-14s %-6s %8s %8s %8s\n", "model", "", "program", "kernels", "binary");
    const kernels::Engine::Impl& impl = engine->impl();
    for (const auto precision : {kernels::Precision::double_precision, kernels::Precision::single_precision})
        for (const kernels::Model* model : tests::variants()) {
            if (!engine->supports(precision)) continue;
            const kernels::ProgramSource source = impl.source(*model, precision, kernels::Accuracy::full);
            cl::Program program(impl.context, source.text);
            std::vector<std::vector<unsigned char>> binaries;
            const double built = cost_ms([&] { program.build({impl.device}, source.flags.c_str()); });
            const double kernels = cost_ms([&] { binaries = program.getInfo<CL_PROGRAM_BINARIES>(); });
            const double loaded = cost_ms(
                [&] { cl::Program(impl.context, {impl.device}, binaries).build({impl.device}, source.flags.c_str()); });
            std::printf("%-14s %-6s %8.0f %8.0f %8.1f\n", tests::label(*model).c_str(),
                        precision == kernels::Precision::double_precision ? "double" : "single", built, kernels,
                        loaded);
        }
}
