#include "kernels/transfers.h"

#include <algorithm>

#include "kernels/waiting.h"

namespace brdfit::kernels {
namespace {

/// Most work-items of a launch on a CPU; each has scratch of its own.
constexpr unsigned kMostCores = 8;

/// What an event of a queue stands for.
class UntilEvent : public Underway {
public:
    explicit UntilEvent(cl::Event event) : event_(std::move(event)) {}

    void when_over(void (*done)(void*), void* context) override {
        done_ = done;
        context_ = context;
        event_.setCallback(
            CL_COMPLETE,
            [](cl_event, cl_int, void* self) {
                const auto& until = *static_cast<const UntilEvent*>(self);
                until.done_(until.context_);
            },
            this);
    }

private:
    cl::Event event_;
    void (*done_)(void*) = nullptr;
    void* context_ = nullptr;
};

}  // namespace

std::size_t size_of(Precision precision) {
    return precision == Precision::double_precision ? sizeof(double) : sizeof(float);
}

cl::Buffer constant_buffer(const cl::Context& context, Precision precision, std::vector<double> values) {
    constexpr cl_mem_flags kFlags = CL_MEM_READ_ONLY | CL_MEM_COPY_HOST_PTR;
    if (values.empty()) return {context, CL_MEM_READ_ONLY, size_of(precision)};
    if (precision == Precision::double_precision)
        return {context, kFlags, values.size() * sizeof(double), values.data()};
    std::vector<float> single(values.begin(), values.end());
    return {context, kFlags, single.size() * sizeof(float), single.data()};
}

Transfers::Transfers(Engine& engine, Precision precision_in)
    : Transfers(engine, precision_in, cl::CommandQueue(engine.impl().context, engine.impl().device)) {}

Transfers::Transfers(Engine& engine, Precision precision_in, cl::CommandQueue queue_in)
    : shared(engine.impl()), precision(precision_in), queue(std::move(queue_in)) {}

void Transfers::reserve(cl::Buffer& buffer, std::size_t scalars) const {
    const std::size_t bytes = std::max<std::size_t>(scalars, 1) * size_of(precision);
    if (buffer() == nullptr || buffer.getInfo<CL_MEM_SIZE>() < bytes)
        buffer = cl::Buffer(shared.context, CL_MEM_READ_WRITE, bytes);
}

void Transfers::upload(cl::Buffer& buffer, std::span<const double> values) {
    reserve(buffer, values.size());
    if (values.empty()) return;
    const cl_bool blocking = waiter_of_thread() == nullptr ? CL_TRUE : CL_FALSE;
    if (precision == Precision::double_precision) {
        queue.enqueueWriteBuffer(buffer, blocking, 0, values.size_bytes(), values.data());
    } else {
        single_up.assign(values.begin(), values.end());
        queue.enqueueWriteBuffer(buffer, blocking, 0, single_up.size() * sizeof(float), single_up.data());
    }
}

void Transfers::download(const cl::Buffer& buffer, std::span<double> values) {
    if (precision == Precision::double_precision) {
        read(buffer, values.size_bytes(), values.data());
    } else {
        single_down.resize(values.size());
        read(buffer, single_down.size() * sizeof(float), single_down.data());
        std::copy(single_down.begin(), single_down.end(), values.begin());
    }
}

void Transfers::read(const cl::Buffer& buffer, std::size_t bytes, void* to) {
    Waiter* const waiter = waiter_of_thread();
    if (waiter == nullptr) {
        queue.enqueueReadBuffer(buffer, CL_TRUE, 0, bytes, to);
        return;
    }
    cl::Event event;
    queue.enqueueReadBuffer(buffer, CL_FALSE, 0, bytes, to, nullptr, &event);
    queue.flush();
    UntilEvent until(event);
    waiter->wait(until);
    if (const cl_int status = event.getInfo<CL_EVENT_COMMAND_EXECUTION_STATUS>(); status < 0)
        throw cl::Error(status, "a launch");
}

std::size_t Transfers::cpu_width() const {
    return shared.info.runs_inline ? 1 : std::min(shared.info.compute_units, kMostCores);
}

}  // namespace brdfit::kernels
