#include "kernels/engine.h"

#include <algorithm>
#include <cctype>
#include <cstdlib>

#include "kernels/embedded.h"
#include "kernels/engine_impl.h"
#include "kernels/geometry.h"

namespace brdfit::kernels {
namespace {

std::string lower(std::string text) {
    std::transform(text.begin(), text.end(), text.begin(), [](unsigned char c) { return std::tolower(c); });
    return text;
}

DeviceInfo describe(const cl::Device& device) {
    DeviceInfo info;
    info.name = device.getInfo<CL_DEVICE_NAME>();
    info.platform = cl::Platform(device.getInfo<CL_DEVICE_PLATFORM>()).getInfo<CL_PLATFORM_NAME>();
    info.version = device.getInfo<CL_DRIVER_VERSION>();
    const auto type = device.getInfo<CL_DEVICE_TYPE>();
    info.type = (type & CL_DEVICE_TYPE_GPU) ? "gpu" : (type & CL_DEVICE_TYPE_CPU) ? "cpu" : "accelerator";
    info.has_double = device.getInfo<CL_DEVICE_DOUBLE_FP_CONFIG>() != 0;
    info.compute_units = device.getInfo<CL_DEVICE_MAX_COMPUTE_UNITS>();
    info.runs_inline = info.platform == "Portable Computing Language" && info.name.starts_with("basic");
    return info;
}

/// Lower is better.
int preference(const DeviceInfo& info) {
    if (info.type == "gpu" && info.has_double) return 0;
    if (info.type == "cpu" && info.has_double) return 1;
    return info.type == "gpu" ? 2 : 3;
}

std::vector<cl::Device> all_devices() {
    // PoCL's "basic" device runs a launch in the calling thread (0.6 us instead of 15-20 us of its thread pool); brdfit
    // brings its own threads, one search each. A user's own setting wins.
    ::setenv("POCL_DEVICES", "basic", 0);
    // One compilation of a kernel serves every width of grid, and is the one that a binary holds; as fast as PoCL's own
    // choice, one compilation a width.
    ::setenv("POCL_WORK_GROUP_SPECIALIZATION", "0", 0);
    std::vector<cl::Platform> platforms;
    try {
        cl::Platform::get(&platforms);
    } catch (const cl::Error&) {
        return {};  // the loader reports "no platform" as an error
    }
    std::vector<cl::Device> devices;
    for (const cl::Platform& platform : platforms) {
        std::vector<cl::Device> found;
        try {
            platform.getDevices(CL_DEVICE_TYPE_ALL, &found);
        } catch (const cl::Error&) {
            continue;  // a platform without devices
        }
        for (const cl::Device& device : found)
            if (device.getInfo<CL_DEVICE_AVAILABLE>() && device.getInfo<CL_DEVICE_COMPILER_AVAILABLE>())
                devices.push_back(device);
    }
    std::stable_sort(devices.begin(), devices.end(), [](const cl::Device& a, const cl::Device& b) {
        return preference(describe(a)) < preference(describe(b));
    });
    return devices;
}

}  // namespace

cl::Device choose_device(const std::string& wanted) {
    const std::vector<cl::Device> devices = all_devices();
    if (devices.empty()) throw DeviceError("no OpenCL device: install pocl-opencl-icd or a GPU's driver");
    if (wanted.empty() || wanted == "auto") return devices.front();
    std::string names;
    for (const cl::Device& device : devices) {
        const DeviceInfo info = describe(device);
        if (info.type == wanted || lower(info.name).find(lower(wanted)) != std::string::npos) return device;
        names += (names.empty() ? "" : "; ") + info.name + " (" + info.type + ")";
    }
    throw DeviceError("no OpenCL device matches \"" + wanted + "\"; there are: " + names);
}

DeviceError device_error(const cl::Error& error) {
    return DeviceError(std::string(error.what()) + " failed with OpenCL code " + std::to_string(error.err()));
}

namespace {

std::string part(std::string_view file, std::string_view text) {
    return "#line 1 \"" + std::string(file) + "\"\n" + std::string(text) + "\n";
}

/// Everything up to the kernels: vocabulary and model.
std::string model_text(const Model& model, Precision precision, unsigned lanes, Accuracy accuracy, bool sliced) {
    return "#define REAL_IS_DOUBLE " + std::string(precision == Precision::double_precision ? "1" : "0") +
           "\n#define SEARCH_ACCURACY " + (accuracy == Accuracy::search ? "1" : "0") + "\n#define SLICED " +
           (sliced ? "1" : "0") + "\n#define LANES " + std::to_string(lanes) + "\n" + part("prelude.cl", kPreludeText) +
           part("geometry", geometry_prelude()) + part("special.cl", kSpecialText) +
           part(model.file + " header", model.prelude) + part(model.file, model.text) +
           part("parameters.cl", kParametersText);
}

}  // namespace

std::string program_text(const Model& model, Precision precision, unsigned lanes, Accuracy accuracy, bool sliced) {
    return model_text(model, precision, lanes, accuracy, sliced) + part("residual.cl", kResidualText);
}

std::string hemisphere_text(const Model& model, Precision precision, unsigned lanes) {
    return model_text(model, precision, lanes, Accuracy::full, false) + part("hemisphere.cl", kHemisphereText);
}

unsigned Engine::Impl::native_lanes(Precision precision) const {
    if (info.type != "cpu") return 1;
    const unsigned native = precision == Precision::double_precision
                                ? device.getInfo<CL_DEVICE_NATIVE_VECTOR_WIDTH_DOUBLE>()
                                : device.getInfo<CL_DEVICE_NATIVE_VECTOR_WIDTH_FLOAT>();
    for (const unsigned lanes : {16U, 8U, 4U, 2U})
        if (native >= lanes) return lanes;
    return 1;
}

std::optional<std::string> Engine::Impl::refusal(Precision precision) const {
    if (precision == Precision::double_precision && !info.has_double)
        return "the device computes in single precision only";
    const std::lock_guard lock(withdrawn_mutex);
    const auto it = withdrawn.find(precision);
    return it == withdrawn.end() ? std::nullopt : std::optional(it->second);
}

std::string Engine::Impl::flags(Precision precision) const {
    std::string flags = "-cl-std=CL1.2";
    if (precision == Precision::single_precision) {
        flags += " -cl-single-precision-constant";
        if (device.getInfo<CL_DEVICE_SINGLE_FP_CONFIG>() & CL_FP_CORRECTLY_ROUNDED_DIVIDE_SQRT)
            flags += " -cl-fp32-correctly-rounded-divide-sqrt";
    }
    if (!options.build_options.empty()) flags += " " + options.build_options;
    return flags;
}

ProgramSource Engine::Impl::source(const Model& model, Precision precision, Accuracy accuracy) const {
    return {program_text(model, precision, lanes(precision), accuracy, sliced()), flags(precision)};
}

ProgramSource Engine::Impl::hemisphere_source(const Model& model, Precision precision) const {
    return {hemisphere_text(model, precision, lanes(precision)), flags(precision)};
}

cl::Program Engine::Impl::program(const Model& model, Precision precision, Accuracy accuracy) {
    return program(model, precision, accuracy == Accuracy::search ? Purpose::search_accuracy : Purpose::full_accuracy);
}

cl::Program Engine::Impl::hemisphere_program(const Model& model, Precision precision) {
    return program(model, precision, Purpose::hemisphere);
}

cl::Program Engine::Impl::program(const Model& model, Precision precision, Purpose purpose) {
    if (const auto reason = refusal(precision)) throw PrecisionError(*reason);
    const std::tuple key(precision, purpose, model.prelude, model.text);
    {
        const std::lock_guard lock(mutex);
        if (const auto it = programs.find(key); it != programs.end()) return it->second;
    }
    try {
        const Accuracy accuracy = purpose == Purpose::search_accuracy ? Accuracy::search : Accuracy::full;
        const cl::Program program = builder->program(
            purpose == Purpose::hemisphere ? hemisphere_source(model, precision) : source(model, precision, accuracy));
        const std::lock_guard lock(mutex);
        return programs.emplace(key, program).first->second;
    } catch (const CompilerRefusal& refusal) {
        throw BuildError(model.file + " does not build for " + info.name + ":\n" + refusal.what());
    } catch (const cl::Error& error) {
        throw device_error(error);
    }
}

Engine::Engine(const EngineOptions& options) : impl_(std::make_unique<Impl>()) {
    try {
        if (options.cache) set_up_private_driver_cache();
        impl_->device = choose_device(options.device);
        impl_->info = describe(impl_->device);
        impl_->context = cl::Context(impl_->device);
        impl_->options = options;
        impl_->builder.emplace(impl_->context, impl_->device, options);
        for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
            unsigned& lanes = impl_->lanes_chosen[precision];
            lanes = options.lanes.value_or(impl_->native_lanes(precision));
            if (options.lanes || impl_->info.type != "cpu") continue;
            lanes = kept_lanes(*impl_->builder, precision).value_or(lanes);
        }
    } catch (const cl::Error& error) {
        throw device_error(error);
    }
}

Engine::~Engine() = default;

const DeviceInfo& Engine::device() const { return impl_->info; }

bool Engine::overlaps() const { return !impl_->info.runs_inline && !impl_->options.one_by_one; }

Precision Engine::best_precision() const {
    const auto no_double = refusal(Precision::double_precision);
    if (!no_double) return Precision::double_precision;
    if (const auto no_single = refusal(Precision::single_precision))
        throw PrecisionError(*no_double + "; " + *no_single);
    return Precision::single_precision;
}

Precision Engine::quickest_precision() const {
    return supports(Precision::single_precision) ? Precision::single_precision : best_precision();
}

bool Engine::supports(Precision precision) const { return !refusal(precision); }

bool Engine::usable() const { return supports(Precision::double_precision) || supports(Precision::single_precision); }

std::optional<std::string> Engine::refusal(Precision precision) const { return impl_->refusal(precision); }

void Engine::withdraw(Precision precision, std::string reason) {
    const std::lock_guard lock(impl_->withdrawn_mutex);
    impl_->withdrawn[precision] = std::move(reason);
}

void Engine::prepare(const Model& model, Precision precision, Accuracy accuracy) {
    (void)impl_->program(model, precision, accuracy);
}

void Engine::build_ahead(std::span<const Family> families, std::span<const Precision> precisions) {
    std::vector<ProgramSource> sources;
    for (const Family& family : families)
        for (const Model& model : family.variants)
            for (const Precision precision : precisions) {
                sources.push_back(impl_->source(model, precision, Accuracy::full));
                sources.push_back(impl_->hemisphere_source(model, precision));
                if (model.begins_quickly() && usable() && precision == best_precision()) {
                    sources.push_back(impl_->source(model, quickest_precision(), model.first_accuracy()));
                    if (model.sums_series()) sources.push_back(impl_->hemisphere_source(model, quickest_precision()));
                }
            }
    impl_->builder->build_ahead(sources);
}

void Engine::stop_building() { impl_->builder->stop(); }

unsigned Engine::lanes(Precision precision) const { return impl_->lanes(precision); }

std::vector<DeviceInfo> list_devices() {
    std::vector<DeviceInfo> list;
    for (const cl::Device& device : all_devices()) list.push_back(describe(device));
    return list;
}

}  // namespace brdfit::kernels
