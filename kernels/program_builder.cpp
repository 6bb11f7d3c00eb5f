#include "kernels/program_builder.h"

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iterator>
#include <thread>

#include "kernels/engine_impl.h"
#include "kernels/scratch.h"

namespace brdfit::kernels {
namespace {

namespace fs = std::filesystem;

/// Counts up where entries of old would be read wrongly.
constexpr std::string_view kFormat = "1";
/// Each takes about 150 MB.
constexpr std::size_t kMostProcesses = 8;

constexpr std::string_view kSourceSuffix = ".source";
constexpr std::string_view kLogSuffix = ".log";  // of a text that the compiler refused

/// What the host's compiler may look at in the processor; a device's name does not tell a virtual machine's features.
std::string processor() {
    std::ifstream in("/proc/cpuinfo");
    std::string features;
    for (std::string line; std::getline(in, line) && !line.empty();)
        for (const std::string_view name : {"vendor_id", "cpu family", "model", "flags", "Features", "CPU part"})
            if (line.starts_with(name)) features += line + "\n";
    return features;
}

/// Settings of PoCL's that may change what it builds.
std::string driver_settings() {
    std::vector<std::string> settings;
    for (char** variable = environ; *variable != nullptr; ++variable) {
        const std::string_view setting = *variable;
        if (setting.starts_with("POCL_") && !setting.starts_with("POCL_CACHE_DIR=") &&
            !setting.starts_with("POCL_DEBUG"))
            settings.emplace_back(setting);
    }
    std::sort(settings.begin(), settings.end());
    std::string text;
    for (const std::string& setting : settings) text += setting + "\n";
    return text;
}

/// Whether a file of that size can be written there.
bool has_room(const fs::path& folder, std::size_t bytes) {
    const std::string file = (folder / "room").string();
    const int descriptor = ::open(file.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC, S_IRUSR | S_IWUSR);
    if (descriptor < 0) return false;
    const bool room = ::posix_fallocate(descriptor, 0, static_cast<off_t>(bytes)) == 0;
    ::close(descriptor);
    ::unlink(file.c_str());
    return room;
}

std::string read(const fs::path& path) {
    std::ifstream in(path, std::ios::binary);
    return {std::istreambuf_iterator<char>(in), {}};
}

std::string last_line(const std::string& text) {
    const auto end = text.find_last_not_of("\n ");
    if (end == std::string::npos) return "";
    const auto begin = text.find_last_of('\n', end);
    return text.substr(begin + 1, end - begin);
}

std::vector<unsigned char> binary_of(const cl::Program& program) {
    const auto binaries = program.getInfo<CL_PROGRAM_BINARIES>();
    return binaries.empty() ? std::vector<unsigned char>{} : binaries.front();
}

cl::Program compile(const cl::Context& context, const cl::Device& device, const ProgramSource& source) {
    cl::Program program(context, source.text);
    try {
        program.build({device}, source.flags.c_str());
    } catch (const cl::BuildError& error) {
        std::string log;
        for (const auto& [device_, text] : error.getBuildLog()) log += text;
        throw CompilerRefusal(log);
    }
    return program;
}

/// A process that builds: `builder build-programs DEVICE FOLDER`, its messages in a file. Waits for it when destroyed.
class BuildProcess {
public:
    BuildProcess(const std::string& builder, const std::string& device, const fs::path& folder, std::size_t number)
        : driver_cache_(folder / ("driver" + std::to_string(number))), log_(folder / ("log" + std::to_string(number))) {
        const std::string command = "build-programs";
        const std::string where = folder.string();
        std::vector<std::string> words{builder, command, device, where};
        std::vector<std::string> variables{"POCL_CACHE_DIR=" + driver_cache_.string()};
        for (char** variable = environ; *variable != nullptr; ++variable)
            if (!std::string_view(*variable).starts_with("POCL_CACHE_DIR=")) variables.emplace_back(*variable);
        posix_spawn_file_actions_t files;
        posix_spawn_file_actions_init(&files);
        posix_spawn_file_actions_addopen(&files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
        posix_spawn_file_actions_addopen(&files, STDOUT_FILENO, log_.c_str(), O_WRONLY | O_CREAT | O_TRUNC,
                                         S_IRUSR | S_IWUSR);
        posix_spawn_file_actions_adddup2(&files, STDOUT_FILENO, STDERR_FILENO);
        posix_spawn_file_actions_addclosefrom_np(&files, STDERR_FILENO + 1);
        // The server blocks the signals that end it; a compiler shall end with them.
        posix_spawnattr_t attributes;
        posix_spawnattr_init(&attributes);
        sigset_t none;
        sigemptyset(&none);
        posix_spawnattr_setsigmask(&attributes, &none);
        posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK);
        const int error =
            posix_spawn(&id_, builder.c_str(), &files, &attributes, pointers(words).data(), pointers(variables).data());
        if (error != 0) id_ = -1;
        posix_spawnattr_destroy(&attributes);
        posix_spawn_file_actions_destroy(&files);
    }
    ~BuildProcess() {
        (void)collect();
        std::error_code error;
        fs::remove_all(driver_cache_, error);
    }
    BuildProcess(const BuildProcess&) = delete;
    BuildProcess& operator=(const BuildProcess&) = delete;

    /// -1 where it could not be started, or has been collected.
    [[nodiscard]] pid_t id() const { return id_; }
    void wait_for_end() const {
        siginfo_t ignored{};
        while (id_ > 0 && ::waitid(P_PID, static_cast<id_t>(id_), &ignored, WEXITED | WNOWAIT) < 0 && errno == EINTR) {
        }
    }
    /// Lets go of it, and tells how it ended, in words; nothing if it did all it could.
    std::string collect() {
        if (id_ < 0) return "could not be started";
        int status = 0;
        while (::waitpid(id_, &status, 0) < 0 && errno == EINTR) {
        }
        id_ = -1;
        if (WIFEXITED(status) && WEXITSTATUS(status) == 0) return "";
        std::string ending = WIFSIGNALED(status) ? "was ended by signal " + std::to_string(WTERMSIG(status))
                                                 : "ended with status " + std::to_string(WEXITSTATUS(status));
        if (const std::string said = last_line(read(log_)); !said.empty()) ending += ": " + said;
        return ending;
    }

private:
    static std::vector<char*> pointers(std::vector<std::string>& texts) {
        std::vector<char*> list;
        for (std::string& text : texts) list.push_back(text.data());
        list.push_back(nullptr);
        return list;
    }

    fs::path driver_cache_, log_;
    pid_t id_ = -1;
};

}  // namespace

void set_up_private_driver_cache() {
    if (const fs::path& scratch = scratch_folder(); !scratch.empty())
        ::setenv("POCL_CACHE_DIR", (scratch / "driver").c_str(), 1);
}

ProgramBuilder::ProgramBuilder(const cl::Context& context, const cl::Device& device, const EngineOptions& options)
    : context_(context),
      device_(device),
      cache_(options.cache.value_or("")),
      builder_(options.builder),
      wanted_device_(options.device) {
    const cl::Platform platform(device.getInfo<CL_DEVICE_PLATFORM>());
    const std::string name = platform.getInfo<CL_PLATFORM_NAME>();
    identity_ = name + "\n" + platform.getInfo<CL_PLATFORM_VERSION>() + "\n" + device.getInfo<CL_DEVICE_NAME>() + "\n" +
                device.getInfo<CL_DEVICE_VERSION>() + "\n" + device.getInfo<CL_DRIVER_VERSION>() + "\n" + processor();
    const bool is_pocl = name == "Portable Computing Language";
    if (is_pocl) identity_ += driver_settings();
    if (is_pocl && options.cache && scratch_folder().empty())
        throw DeviceError("no folder has room for the OpenCL compiler's files (32 MB): set TMPDIR to one that has");
    private_driver_cache_ = is_pocl && options.cache;
    compiles_apart_ = private_driver_cache_ && !builder_.empty();
}

CacheKey ProgramBuilder::key(std::string_view kind, std::string_view text, std::string_view flags) const {
    return CacheKey::of({kFormat, kind, identity_, text, flags});
}

cl::Program ProgramBuilder::load(const std::vector<unsigned char>& binary, const std::string& flags) const {
    // PoCL unpacks it, and ends the process at the first launch where it could not.
    if (private_driver_cache_ && !has_room(scratch_folder(), 2 * binary.size()))
        throw DeviceError("there is no room for the OpenCL driver's files in " + scratch_folder().string());
    cl::Program program(context_, {device_}, {binary});
    program.build({device_}, flags.c_str());
    return program;
}

cl::Program ProgramBuilder::program(const ProgramSource& source) {
    const CacheKey key = this->key("program", source.text, source.flags);
    const std::lock_guard lock(mutex_);
    {
        const std::lock_guard stop_lock(stop_mutex_);
        if (stopped_) throw DeviceError("building programs was stopped");  // loading one takes long, too
    }
    if (const auto binary = cache_.load(key)) try {
            return load(*binary, source.flags);
        } catch (const cl::Error&) {
            // A driver that takes its own binary no longer: built anew, it is replaced.
        }
    if (compiles_apart_) {
        build_apart({&source, 1});
        if (const auto it = built_.find(key.text()); it != built_.end()) return load(it->second, source.flags);
        std::rethrow_exception(failed_.at(key.text()));
    }
    cl::Program program = compile(context_, device_, source);
    if (!cache_.folder().empty()) (void)cache_.store(key, binary_of(program));
    return program;
}

void ProgramBuilder::build_ahead(std::span<const ProgramSource> sources) {
    if (!compiles_apart_) return;
    std::vector<ProgramSource> missing;
    for (const ProgramSource& source : sources)
        if (!cache_.load(key("program", source.text, source.flags))) missing.push_back(source);
    const std::lock_guard lock(mutex_);
    build_apart(missing);
}

void ProgramBuilder::stop() {
    const std::lock_guard lock(stop_mutex_);
    stopped_ = true;
    for (const pid_t process : processes_) ::kill(process, SIGKILL);
}

/// Leaves each in built_ or, with why, in failed_, unless it is there already.
void ProgramBuilder::build_apart(std::span<const ProgramSource> sources) {
    std::vector<ProgramSource> missing;
    for (const ProgramSource& source : sources) {
        const std::string key = this->key("program", source.text, source.flags).text();
        if (!built_.contains(key) && !failed_.contains(key)) missing.push_back(source);
    }
    run_processes(missing, std::min<std::size_t>(
                               {missing.size(), std::max(1U, std::thread::hardware_concurrency()), kMostProcesses}));
    // Once more where a process ended before its time, which may have had too little memory: one by one.
    for (const ProgramSource& source : missing) {
        const auto failure = failed_.find(this->key("program", source.text, source.flags).text());
        if (failure == failed_.end()) continue;
        try {
            std::rethrow_exception(failure->second);
        } catch (const CompilerRefusal&) {
            continue;
        } catch (const DeviceError&) {
            run_processes({&source, 1}, 1);
        }
    }
}

void ProgramBuilder::run_processes(std::span<const ProgramSource> sources, std::size_t count) {
    const fs::path folder = scratch_folder() / "builds";
    std::error_code error;
    fs::create_directories(folder, error);
    for (const ProgramSource& source : sources) {
        const std::string name = key("program", source.text, source.flags).text() + std::string(kSourceSuffix);
        std::ofstream(folder / name, std::ios::binary) << source.flags << '\n' << source.text;
    }
    std::string ending = "left no program";
    std::vector<std::unique_ptr<BuildProcess>> processes;
    {
        const std::lock_guard lock(stop_mutex_);
        for (std::size_t i = 0; i < count && !stopped_; ++i) {
            processes.push_back(std::make_unique<BuildProcess>(builder_, wanted_device_, folder, i));
            if (processes.back()->id() > 0) processes_.push_back(processes.back()->id());
        }
        if (stopped_) ending = "was stopped";
    }
    for (const auto& process : processes) {
        process->wait_for_end();
        const std::lock_guard lock(stop_mutex_);  // its number may be another's once it is collected
        std::erase(processes_, process->id());
        if (const std::string how = process->collect(); !how.empty()) ending = how;
    }
    processes.clear();
    const ProgramCache results(folder);
    for (const ProgramSource& source : sources) {
        const CacheKey key = this->key("program", source.text, source.flags);
        const fs::path log = folder / (key.text() + std::string(kLogSuffix));
        if (auto binary = results.load(key)) {
            (void)cache_.store(key, *binary);
            built_[key.text()] = std::move(*binary);
            failed_.erase(key.text());
        } else {
            failed_[key.text()] = fs::exists(log, error)
                                      ? std::make_exception_ptr(CompilerRefusal(read(log)))
                                      : std::make_exception_ptr(DeviceError("the OpenCL compiler " + ending));
        }
    }
    fs::remove_all(folder, error);
}

void build_programs(const std::string& device_name, const fs::path& folder) try {
    ::prctl(PR_SET_PDEATHSIG, SIGKILL);  // nobody waits for the programs then
    const cl::Device device = choose_device(device_name);
    const cl::Context context(device);
    const ProgramCache results(folder);
    std::vector<std::pair<std::uintmax_t, fs::path>> sources;
    for (const fs::directory_entry& entry : fs::directory_iterator(folder))
        if (entry.path().extension() == kSourceSuffix) sources.emplace_back(entry.file_size(), entry.path());
    std::sort(sources.rbegin(), sources.rend());  // the longest first: the last ones are then soon done
    for (const auto& [size, path] : sources) {
        // Whoever renames it builds it.
        const fs::path taken = fs::path(path).replace_extension(".taken");
        std::error_code error;
        fs::rename(path, taken, error);
        if (error) continue;
        const std::string source = read(taken);
        const std::size_t flags = source.find('\n');
        const auto key = CacheKey::parse(path.stem().string());
        bool written = false;
        try {
            const cl::Program program = compile(context, device, {source.substr(flags + 1), source.substr(0, flags)});
            written = key && results.store(*key, binary_of(program));
        } catch (const CompilerRefusal& refusal) {
            const fs::path log = fs::path(path).replace_extension(kLogSuffix);
            written = static_cast<bool>(std::ofstream(log, std::ios::binary) << refusal.what() << std::flush);
        }
        if (!written) throw DeviceError("could not write what it built");
    }
} catch (const cl::Error& error) {
    throw device_error(error);
}

}  // namespace brdfit::kernels
