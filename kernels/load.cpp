#include "kernels/load.h"

#include <algorithm>
#include <fstream>
#include <string>
#include <thread>

#include <unistd.h>

#include "kernels/stopwatch.h"

namespace brdfit::kernels {
namespace {

/// Processor time of everything on this machine so far, with what a virtual machine's host took [s]; below 0 where the
/// system does not tell.
double busy_s() {
    std::ifstream stat("/proc/stat");
    std::string name;
    double user = 0, nice = 0, system = 0, idle = 0, waiting = 0, interrupts = 0, soft_interrupts = 0, stolen = 0;
    if (!(stat >> name >> user >> nice >> system >> idle >> waiting >> interrupts >> soft_interrupts >> stolen))
        return -1;
    return (user + nice + system + interrupts + soft_interrupts + stolen) / static_cast<double>(::sysconf(_SC_CLK_TCK));
}

}  // namespace

LoadWatch::LoadWatch(const DeviceInfo& device)
    : device_(device), start_(std::chrono::steady_clock::now()), busy_s_(busy_s()), own_s_(stopwatch_s(device)) {}

double LoadWatch::others() const {
    if (device_.type != "cpu") return 0;
    const double wall_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
    const double own_s = stopwatch_s(device_) - own_s_;
    const double all_s = wall_s * std::max(1U, std::thread::hardware_concurrency());
    if (!(all_s > 0)) return 0;
    const double others_s = busy_s_ >= 0 ? busy_s() - busy_s_ - own_s : wall_s - own_s;
    return std::clamp(others_s / all_s, 0.0, 1.0);
}

}  // namespace brdfit::kernels
