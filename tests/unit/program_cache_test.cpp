// What is kept on disk comes back as it was, or not at all.

#include "kernels/program_cache.h"

#include <gmock/gmock.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace brdfit::tests {
namespace {

namespace fs = std::filesystem;
using kernels::CacheKey;
using kernels::ProgramCache;
using Bytes = std::vector<unsigned char>;

/// A folder that is gone after the test.
class ProgramCacheTest : public testing::Test {
protected:
    ProgramCacheTest() {
        std::string name = (fs::temp_directory_path() / "brdfit-cache-test-XXXXXX").string();
        if (::mkdtemp(name.data()) == nullptr) throw std::runtime_error("no temporary folder");
        folder_ = name;
    }
    ~ProgramCacheTest() override {
        std::error_code error;
        fs::permissions(folder_, fs::perms::owner_all, error);
        fs::remove_all(folder_, error);
    }

    static Bytes read(const fs::path& path) {
        std::ifstream in(path, std::ios::binary);
        return {std::istreambuf_iterator<char>(in), {}};
    }
    static void write(const fs::path& path, const Bytes& bytes) {
        std::ofstream out(path, std::ios::binary);
        out.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
    }
    [[nodiscard]] std::size_t files() const {
        return static_cast<std::size_t>(std::distance(fs::directory_iterator(folder_), fs::directory_iterator()));
    }

    fs::path folder_;
    const CacheKey key_ = CacheKey::of({"a", "b"});
    const CacheKey other_ = CacheKey::of({"ab"});
    const Bytes bytes_{'p', 'r', 'o', 'g', 'r', 'a', 'm', 0, 255};
};

TEST_F(ProgramCacheTest, KeysTellPartsApart) {
    EXPECT_NE(key_, other_);
    EXPECT_NE(key_, CacheKey::of({"b", "a"}));
    EXPECT_NE(CacheKey::of({"", "x"}), CacheKey::of({"x", ""}));
    EXPECT_EQ(key_, CacheKey::of({"a", "b"}));
    EXPECT_EQ(CacheKey::parse(key_.text()), key_);
    // "1:a1:b" by sha256sum
    EXPECT_EQ(key_.text(), "facdde7abf1eac5b301273ab2e282f79bab0100f058833a7b8bdf9f80741e149");
    EXPECT_EQ(CacheKey::parse("0123"), std::nullopt);
    EXPECT_EQ(CacheKey::parse(std::string(64, 'x')), std::nullopt);
}

TEST_F(ProgramCacheTest, GivesBackWhatWasStored) {
    const ProgramCache cache(folder_ / "made" / "on demand");
    EXPECT_EQ(cache.load(key_), std::nullopt);
    ASSERT_TRUE(cache.store(key_, bytes_));
    EXPECT_EQ(cache.load(key_), bytes_);
    EXPECT_EQ(cache.load(other_), std::nullopt);
    ASSERT_TRUE(cache.store(other_, {}));
    EXPECT_EQ(cache.load(other_), Bytes{});
    ASSERT_TRUE(cache.store(key_, Bytes{1}));
    EXPECT_EQ(ProgramCache(cache.folder()).load(key_), Bytes{1}) << "replaced, and for another run";
}

TEST_F(ProgramCacheTest, NoticesEachByteThatChanged) {
    const ProgramCache cache(folder_);
    ASSERT_TRUE(cache.store(key_, bytes_));
    const Bytes good = read(cache.file(key_));
    ASSERT_GT(good.size(), bytes_.size());
    for (std::size_t i = 0; i < good.size(); ++i) {
        Bytes bad = good;
        bad[i] ^= 0x40;
        write(cache.file(key_), bad);
        ASSERT_EQ(cache.load(key_), std::nullopt) << "byte " << i;
    }
    ASSERT_TRUE(cache.store(key_, bytes_));
    EXPECT_EQ(cache.load(key_), bytes_) << "replaced";
}

TEST_F(ProgramCacheTest, NoticesEveryLength) {
    const ProgramCache cache(folder_);
    ASSERT_TRUE(cache.store(key_, bytes_));
    const Bytes good = read(cache.file(key_));
    for (std::size_t size = 0; size < good.size(); ++size) {
        write(cache.file(key_), Bytes(good.begin(), good.begin() + static_cast<std::ptrdiff_t>(size)));
        ASSERT_EQ(cache.load(key_), std::nullopt) << size << " bytes";
    }
    Bytes longer = good;
    longer.push_back(0);
    write(cache.file(key_), longer);
    EXPECT_EQ(cache.load(key_), std::nullopt);
    write(cache.file(key_), good);
    EXPECT_EQ(cache.load(key_), bytes_);
}

TEST_F(ProgramCacheTest, PassesOverWhatIsNotItsOwn) {
    const ProgramCache cache(folder_);
    ASSERT_TRUE(cache.store(other_, bytes_));
    fs::rename(cache.file(other_), cache.file(key_));
    EXPECT_EQ(cache.load(key_), std::nullopt) << "another key's";

    ASSERT_TRUE(cache.store(key_, bytes_));
    ASSERT_EQ(::chmod(cache.file(key_).c_str(), 0666), 0);
    EXPECT_EQ(cache.load(key_), std::nullopt) << "anybody may have written it";
    ASSERT_TRUE(cache.store(key_, bytes_));
    EXPECT_EQ(cache.load(key_), bytes_);

    fs::rename(cache.file(key_), folder_ / "elsewhere");
    fs::create_symlink(folder_ / "elsewhere", cache.file(key_));
    EXPECT_EQ(cache.load(key_), std::nullopt) << "a link";
    fs::remove(cache.file(key_));
    fs::create_directory(cache.file(key_));
    EXPECT_EQ(cache.load(key_), std::nullopt) << "a folder";
    EXPECT_FALSE(cache.store(key_, bytes_));
    fs::remove(cache.file(key_));
    ASSERT_EQ(::mkfifo(cache.file(key_).c_str(), 0600), 0);
    EXPECT_EQ(cache.load(key_), std::nullopt) << "a pipe, without waiting for a writer";
}

TEST_F(ProgramCacheTest, KeepsNothingWhereItCannot) {
    write(folder_ / "file", bytes_);
    for (const fs::path& folder :
         {fs::path(), folder_ / "file", folder_ / "file" / "below", fs::path("/proc/brdfit")}) {
        const ProgramCache cache(folder);
        EXPECT_FALSE(cache.store(key_, bytes_)) << folder;
        EXPECT_EQ(cache.load(key_), std::nullopt) << folder;
    }
    EXPECT_EQ(read(folder_ / "file"), bytes_);
}

TEST_F(ProgramCacheTest, ReadsFromAFolderThatItMayNotWrite) {
    const ProgramCache cache(folder_);
    ASSERT_TRUE(cache.store(key_, bytes_));
    fs::permissions(folder_, fs::perms::owner_read | fs::perms::owner_exec);
    if (::access(folder_.c_str(), W_OK) == 0) GTEST_SKIP() << "root may write to any folder";
    EXPECT_FALSE(cache.store(other_, bytes_));
    EXPECT_EQ(cache.load(key_), bytes_) << "it reads all the same";
}

TEST_F(ProgramCacheTest, LeavesNothingUnfinished) {
    // A limit for files stands for a disk that fills up while it writes.
    const pid_t child = ::fork();
    if (child == 0) {
        ::signal(SIGXFSZ, SIG_IGN);
        const rlimit limit{4096, 4096};
        ::setrlimit(RLIMIT_FSIZE, &limit);
        ::_exit(ProgramCache(folder_).store(key_, Bytes(10000)) ? 1 : 0);
    }
    int status = -1;
    ASSERT_EQ(::waitpid(child, &status, 0), child);
    EXPECT_EQ(status, 0) << "it tells that it was not stored";
    EXPECT_EQ(files(), 0);
    EXPECT_EQ(ProgramCache(folder_).load(key_), std::nullopt);
}

TEST_F(ProgramCacheTest, ProcessesMayWriteAndReadAtOnce) {
    const auto content = [](unsigned char fill) { return Bytes(100000, fill); };
    std::vector<pid_t> children;
    for (unsigned char fill = 1; fill <= 4; ++fill) {
        const pid_t child = ::fork();
        if (child == 0) {
            const ProgramCache cache(folder_);
            bool good = true;
            for (int i = 0; i < 100 && good; ++i) {
                good = cache.store(key_, content(fill));
                const auto read = cache.load(key_);  // whole, whoever wrote it
                good = good && read && read->size() == 100000 && *read == content(read->front());
            }
            ::_exit(good ? 0 : 1);
        }
        children.push_back(child);
    }
    for (const pid_t child : children) {
        int status = -1;
        ASSERT_EQ(::waitpid(child, &status, 0), child);
        EXPECT_EQ(status, 0);
    }
    EXPECT_EQ(files(), 1);
}

TEST_F(ProgramCacheTest, RemovesWhatWasUsedTheLongestAgo) {
    const ProgramCache cache(folder_, 4096);
    const auto key = [](int i) { return CacheKey::of({std::to_string(i)}); };
    const auto age = [&](int i, int minutes) {
        fs::last_write_time(cache.file(key(i)), fs::file_time_type::clock::now() - std::chrono::minutes(minutes));
    };
    for (int i = 0; i < 3; ++i) ASSERT_TRUE(cache.store(key(i), Bytes(1000)));
    age(0, 30);
    age(1, 20);
    age(2, 10);
    EXPECT_TRUE(cache.load(key(0))) << "read: the youngest now";
    ASSERT_TRUE(cache.store(key(3), Bytes(1000)));
    EXPECT_FALSE(cache.load(key(1)));
    for (const int i : {0, 2, 3}) EXPECT_TRUE(cache.load(key(i))) << i;
    EXPECT_FALSE(cache.store(key(4), Bytes(5000))) << "more than all may take";
    EXPECT_EQ(files(), 3);

    write(folder_ / "abandoned.tmp", bytes_);
    write(folder_ / "being written.tmp", bytes_);
    write(folder_ / "somebody's", bytes_);
    for (const char* name : {"abandoned.tmp", "somebody's"})
        fs::last_write_time(folder_ / name, fs::file_time_type::clock::now() - std::chrono::hours(48));
    ASSERT_TRUE(cache.store(key(5), Bytes(10)));
    EXPECT_FALSE(fs::exists(folder_ / "abandoned.tmp"));
    EXPECT_TRUE(fs::exists(folder_ / "being written.tmp"));
    EXPECT_TRUE(fs::exists(folder_ / "somebody's"));
}

TEST(DefaultCacheFolder, FollowsTheEnvironment) {
    const auto restore = [](const char* name) {
        const char* value = std::getenv(name);
        return value == nullptr ? std::optional<std::string>() : value;
    };
    const auto set = [](const char* name, const std::optional<std::string>& value) {
        if (value) ::setenv(name, value->c_str(), 1);
        else ::unsetenv(name);
    };
    const auto home = restore("HOME"), cache = restore("XDG_CACHE_HOME");
    set("HOME", "/home/somebody");
    set("XDG_CACHE_HOME", "/var/cache");
    EXPECT_EQ(kernels::default_cache_folder(), "/var/cache/brdfit");
    for (const auto& unfit :
         {std::optional<std::string>(), std::optional<std::string>(""), std::optional<std::string>("a")}) {
        set("XDG_CACHE_HOME", unfit);
        EXPECT_EQ(kernels::default_cache_folder(), "/home/somebody/.cache/brdfit");
    }
    set("HOME", std::nullopt);
    EXPECT_EQ(kernels::default_cache_folder(), "");
    set("HOME", home);
    set("XDG_CACHE_HOME", cache);
}

}  // namespace
}  // namespace brdfit::tests
