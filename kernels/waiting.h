/// Waiting for a device without holding a thread up.
#pragma once

namespace brdfit::kernels {

/// Work that a device has been given.
class Underway {
public:
    Underway() = default;
    virtual ~Underway() = default;
    Underway(const Underway&) = delete;
    Underway& operator=(const Underway&) = delete;

    /// Calls done(context) once, when the work is over or has failed: perhaps before this returns, perhaps in a thread
    /// of the driver's, where it must neither throw nor wait. Throws where it will not be called.
    virtual void when_over(void (*done)(void*), void* context) = 0;
};

/// Whoever has something else to do with a thread while a device works for it.
class Waiter {
public:
    Waiter() = default;
    virtual ~Waiter() = default;
    Waiter(const Waiter&) = delete;
    Waiter& operator=(const Waiter&) = delete;

    /// Returns when the work is over. Throws what when_over() throws, and then at once.
    virtual void wait(Underway& work) = 0;
};

/// The calling thread's; none: it blocks in the driver.
Waiter* waiter_of_thread();

/// Makes a waiter the calling thread's for a while. Not while another is.
class WaiterScope {
public:
    explicit WaiterScope(Waiter& waiter);
    ~WaiterScope();
    WaiterScope(const WaiterScope&) = delete;
    WaiterScope& operator=(const WaiterScope&) = delete;
};

}  // namespace brdfit::kernels
