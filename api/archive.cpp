#include "api/archive.h"

#include <map>
#include <mutex>

namespace brdfit::api {
namespace {
std::mutex mutex;
std::map<std::string, optim::Report, std::less<>> reports;
}  // namespace

std::string archive(const optim::Report& report) {
    const std::lock_guard lock(mutex);
    const std::string key = std::to_string(reports.size());
    reports[key] = report;
    return key;
}

optim::Report read_archive(std::string_view text) {
    const std::lock_guard lock(mutex);
    return reports.find(text)->second;
}

}  // namespace brdfit::api
