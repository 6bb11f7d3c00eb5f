#include "kernels/scratch.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <cstdint>
#include <cstdlib>
#include <initializer_list>
#include <string>
#include <system_error>

namespace brdfit::kernels {
namespace {

namespace fs = std::filesystem;

constexpr std::string_view kPrefix = "brdfit-scratch-";
constexpr std::uintmax_t kNeeded = std::uintmax_t{32} << 20;

/// A descriptor of the file that says whether the folder's process lives: it holds a lock on it. -1 if there is none.
int lock(const fs::path& folder, int flags) {
    const int file = ::open((folder / "lock").c_str(), flags | O_RDWR | O_CLOEXEC | O_NOFOLLOW, S_IRUSR | S_IWUSR);
    if (file < 0 || ::flock(file, LOCK_EX | LOCK_NB) == 0) return file;
    ::close(file);
    return -1;
}

/// Removes what processes of this user left here that were killed.
void sweep(const fs::path& place) {
    std::error_code error;
    for (fs::directory_iterator it(place, error), end; !error && it != end; it.increment(error)) {
        struct stat status {};
        if (!it->path().filename().string().starts_with(kPrefix) || ::lstat(it->path().c_str(), &status) != 0 ||
            !S_ISDIR(status.st_mode) || status.st_uid != ::geteuid())
            continue;
        const int file = lock(it->path(), 0);
        if (file < 0) continue;  // it lives, or is just being made
        std::error_code gone;
        fs::remove_all(it->path(), gone);
        ::close(file);
    }
}

bool is_fit(const fs::path& place) {
    struct statvfs status {};
    return ::statvfs(place.c_str(), &status) == 0 && (status.f_flag & (ST_RDONLY | ST_NOEXEC)) == 0 &&
           std::uintmax_t{status.f_bavail} * status.f_frsize >= kNeeded;
}

class Scratch {
public:
    Scratch() {
        for (const char* place :
             std::initializer_list<const char*>{std::getenv("POCL_CACHE_DIR"), std::getenv("TMPDIR"), "/tmp",
                                                "/var/tmp", std::getenv("XDG_RUNTIME_DIR"), "/dev/shm"}) {
            if (place == nullptr || !fs::path(place).is_absolute() || !is_fit(place)) continue;
            sweep(place);
            std::string folder = (fs::path(place) / kPrefix).string() + "XXXXXX";
            if (::mkdtemp(folder.data()) == nullptr) continue;
            lock_ = lock(folder, O_CREAT | O_EXCL);
            if (lock_ >= 0) {
                folder_ = folder;
                return;
            }
            ::rmdir(folder.c_str());
        }
    }
    ~Scratch() {
        if (folder_.empty()) return;
        std::error_code error;
        fs::remove_all(folder_, error);
        ::close(lock_);
    }
    Scratch(const Scratch&) = delete;
    Scratch& operator=(const Scratch&) = delete;

    [[nodiscard]] const fs::path& folder() const { return folder_; }

private:
    fs::path folder_;
    int lock_ = -1;
};

}  // namespace

const fs::path& scratch_folder() {
    static const Scratch scratch;
    return scratch.folder();
}

}  // namespace brdfit::kernels
