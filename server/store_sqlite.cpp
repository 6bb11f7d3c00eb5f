#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <charconv>
#include <condition_variable>
#include <filesystem>
#include <limits>
#include <map>
#include <mutex>
#include <system_error>
#include <thread>
#include <utility>

#include <SQLiteCpp/SQLiteCpp.h>
#include <sqlite3.h>

#include "server/store.h"

namespace brdfit::server {
namespace {

namespace fs = std::filesystem;
using Kind = StoreError::Kind;
using Milliseconds = std::chrono::milliseconds;
using Int = std::int64_t;

constexpr Int kApplication = 0x42524446;  // "BRDF"
constexpr Int kVersion = 1;               ///< of the tables
constexpr const char* kTables = R"(
    CREATE TABLE dataset(id TEXT PRIMARY KEY, meta TEXT NOT NULL, bytes INT NOT NULL, created INT NOT NULL, body BLOB);
    CREATE INDEX dataset_age ON dataset(created, id);

    CREATE TABLE job(
        id TEXT PRIMARY KEY, tenant TEXT NOT NULL, priority INT NOT NULL, state INT NOT NULL, dataset TEXT,
        result_key TEXT NOT NULL, turn INT NOT NULL, run_at INT NOT NULL, attempt INT NOT NULL,
        owner TEXT NOT NULL, token INT NOT NULL, lease_until INT NOT NULL, lease INT NOT NULL, cancel_at INT,
        created INT NOT NULL, started INT, ended INT, last_event INT NOT NULL, progress TEXT NOT NULL,
        error TEXT NOT NULL) WITHOUT ROWID;
    CREATE INDEX job_queue ON job(priority, turn, id) WHERE state = 0;
    CREATE INDEX job_turn ON job(tenant, priority, turn) WHERE state = 0;
    CREATE INDEX job_lease ON job(lease_until) WHERE state IN (1, 2);
    CREATE INDEX job_end ON job(ended) WHERE ended IS NOT NULL;
    CREATE INDEX job_state ON job(state, id);
    CREATE INDEX job_tenant ON job(tenant, id);
    CREATE INDEX job_dataset ON job(dataset, id) WHERE dataset IS NOT NULL;
    CREATE INDEX job_result ON job(result_key, ended) WHERE state = 3 AND result_key != '';
    -- Apart from the job, whose row is written at every heartbeat.
    CREATE TABLE request(job TEXT PRIMARY KEY, body BLOB NOT NULL);
    CREATE TABLE result(job TEXT PRIMARY KEY, body BLOB NOT NULL);
    CREATE TABLE figures(job TEXT PRIMARY KEY, body BLOB NOT NULL);
    CREATE TABLE event(job TEXT NOT NULL, number INT NOT NULL, kind INT NOT NULL, at INT NOT NULL, body TEXT NOT NULL,
        PRIMARY KEY(job, number)) WITHOUT ROWID;
    CREATE TABLE idempotency(tenant TEXT NOT NULL, key TEXT NOT NULL, body_sha256 TEXT NOT NULL, job TEXT NOT NULL,
        expires INT NOT NULL, PRIMARY KEY(tenant, key)) WITHOUT ROWID;
    CREATE INDEX idempotency_age ON idempotency(expires);
    CREATE INDEX idempotency_job ON idempotency(job);
    CREATE TABLE removed(job TEXT PRIMARY KEY, at INT NOT NULL) WITHOUT ROWID;
    CREATE INDEX removed_age ON removed(at);
    -- turn: of the last job begun. streak: interactive jobs begun since the last of batch.
    CREATE TABLE schedule(priority INT PRIMARY KEY, turn INT NOT NULL, streak INT NOT NULL);
    INSERT INTO schedule VALUES(0, 0, 0), (1, 0, 0);
)";

constexpr Int kAged_ms = 10'000;  ///< a batch job that waited so long has its share
constexpr Int kStreak = 4;        ///< ... after so many interactive ones
constexpr Int kBackoff_ms = 250;  ///< after the first failure; four times as long after each further one
constexpr Int kLongestBackoff_ms = 60'000;
constexpr Int kRemembered_ms = 30LL * 24 * 3600 * 1000;        ///< that a job was removed
constexpr int kCheckpointed = 10'000;                          ///< pages of the log at which a writer has to take part
constexpr std::uintmax_t kChecked = std::uintmax_t{64} << 20;  ///< files up to this size are read through at the start
constexpr Milliseconds kTenderPatience{100};  ///< for others to let the log be emptied; they wait meanwhile
constexpr int kPruned = 64;                   ///< removed in one transaction

[[noreturn]] void unusable(const std::string& path, const std::string& reason) {
    throw StoreError(Kind::unusable, "the store " + path + " cannot be used: " + reason);
}

/// What the caller can do about it, by SQLite's code.
StoreError store_error(sqlite3* handle, const SQLite::Exception& error) {
    const int code = error.getErrorCode();
    const int detail = handle == nullptr ? error.getExtendedErrorCode() : sqlite3_extended_errcode(handle);
    // A quota or a limit for files is no SQLITE_FULL.
    const bool full =
        code == SQLITE_FULL || code == SQLITE_TOOBIG || detail == SQLITE_IOERR_WRITE || detail == SQLITE_IOERR_SHMSIZE;
    return {full ? Kind::full : Kind::unavailable,
            std::string("SQLite: ") + error.what() + " (" + std::to_string(detail) + ")"};
}

/// A connection with its prepared statements. For one thread at a time.
class Connection {
public:
    Connection(const std::string& path, Milliseconds patience)
        : database_(path, SQLite::OPEN_READWRITE | SQLite::OPEN_NOMUTEX, static_cast<int>(patience.count())) {
        sqlite3_extended_result_codes(database_.getHandle(), 1);
        database_.exec("PRAGMA synchronous = NORMAL; PRAGMA cache_size = -8000; PRAGMA temp_store = MEMORY");
    }
    SQLite::Statement& statement(std::string_view sql) {
        const auto found = statements_.find(sql);
        if (found != statements_.end()) return found->second;
        return statements_.try_emplace(std::string(sql), database_, std::string(sql)).first->second;
    }
    SQLite::Database& database() { return database_; }
    sqlite3* handle() { return database_.getHandle(); }

private:
    SQLite::Database database_;
    std::map<std::string, SQLite::Statement, std::less<>> statements_;
};

struct Blob {
    std::string_view bytes;
};

/// A statement that runs: its parameters are bound, and it is reset at the end.
class Query {
public:
    template <class... Values>
    Query(Connection& connection, std::string_view sql, const Values&... values)
        : statement_(connection.statement(sql)) {
        int place = 0;
        (bind(++place, values), ...);
    }
    ~Query() {
        statement_.tryReset();
        try {
            statement_.clearBindings();
        } catch (const SQLite::Exception&) {  // then the next user's own call reports it
        }
    }
    Query(const Query&) = delete;
    Query& operator=(const Query&) = delete;

    bool next() { return statement_.executeStep(); }
    /// Runs it; the rows that it changed.
    int run() { return statement_.exec(); }
    [[nodiscard]] Int number(int column) { return statement_.getColumn(column).getInt64(); }
    [[nodiscard]] std::string text(int column) { return statement_.getColumn(column).getString(); }
    [[nodiscard]] bool is_null(int column) { return statement_.getColumn(column).isNull(); }
    [[nodiscard]] StoreTime time(int column) { return StoreTime(Milliseconds(number(column))); }
    [[nodiscard]] std::optional<StoreTime> optional_time(int column) {
        if (is_null(column)) return std::nullopt;
        return time(column);
    }
    [[nodiscard]] std::optional<std::string> optional_text(int column) {
        if (is_null(column)) return std::nullopt;
        return text(column);
    }

private:
    void bind(int place, Int value) { statement_.bind(place, value); }
    void bind(int place, std::string_view value) { statement_.bind(place, std::string(value)); }
    void bind(int place, Blob value) {
        // An empty blob of no address would be NULL.
        statement_.bindNoCopy(place, value.bytes.empty() ? "" : static_cast<const void*>(value.bytes.data()),
                              static_cast<int>(value.bytes.size()));
    }
    template <class Value>
    void bind(int place, const std::optional<Value>& value) {
        if (value) bind(place, *value);
        else statement_.bind(place);
    }

    SQLite::Statement& statement_;
};

Int code(JobState state) { return static_cast<Int>(state); }
Int code(Priority priority) { return static_cast<Int>(priority); }
Int code(EventKind kind) { return static_cast<Int>(kind); }

constexpr std::string_view kJobColumns =
    "id, tenant, priority, state, dataset, attempt, progress, error, created, started, ended, last_event";

Job job_of(Query& row) {
    return {row.text(0),
            row.text(1),
            static_cast<Priority>(row.number(2)),
            static_cast<JobState>(row.number(3)),
            row.optional_text(4),
            static_cast<unsigned>(row.number(5)),
            row.text(6),
            row.text(7),
            row.time(8),
            row.optional_time(9),
            row.optional_time(10),
            static_cast<std::uint64_t>(row.number(11))};
}

class SqliteStore final : public JobStore {
public:
    explicit SqliteStore(SqliteOptions options);

    void sync() override;

    PutDataset put_dataset(std::string_view body, std::string_view meta) override;
    std::optional<Dataset> find_dataset(const std::string& id) override;
    Page<DatasetInfo> list_datasets(const PageRequest& page) override;
    RemoveDataset remove_dataset(const std::string& id) override;

    Submitted submit(const NewJob& job) override;
    std::optional<Job> find(const std::string& id) override;
    Presence presence(const std::string& id) override;
    Page<Job> list(const JobFilter& filter, const PageRequest& page) override;
    std::optional<std::size_t> queue_position(const std::string& id) override;
    std::optional<JobState> request_cancel(const std::string& id) override;
    Presence remove(const std::string& id) override;
    std::vector<Event> events(const std::string& id, std::uint64_t after, std::size_t most) override;
    std::optional<std::string> result(const std::string& id) override;
    std::optional<std::string> figures(const std::string& id) override;
    std::optional<std::string> find_result(const std::string& key) override;

    std::optional<Claimed> claim(const std::string& owner, const ClaimOptions& options) override;
    Beat heartbeat(const Lease& lease, Milliseconds renewed, std::string_view progress) override;
    bool add_event(const Lease& lease, EventKind kind, std::string_view body) override;
    bool finish(const Lease& lease, const Ending& ending) override;
    bool retry(const Lease& lease, std::string_view error) override;
    bool release(const Lease& lease) override;

    void bury(const std::string& owner) override;
    std::vector<Stuck> stuck(Milliseconds patience) override;
    void tend() override;
    void prune(const Retention& retention) override;
    Counts counts() override;
    void probe() override;
    void shift_clock(Milliseconds by) override { shift_ms_ += by.count(); }

private:
    /// Makes the file and its tables, or refuses what is there.
    void prepare();

    /// Runs `work` in a write transaction; all of it or nothing is done. Then tells of the jobs that it changed.
    template <class Work>
    auto write(const Work& work) {
        std::vector<std::string> changed;
        auto done = [&] {
            const std::lock_guard lock(writing_);
            try {
                SQLite::Transaction transaction(writer_->database(), SQLite::TransactionBehavior::IMMEDIATE);
                changed_ = &changed;
                try {
                    auto result = work(*writer_);
                    transaction.commit();
                    return result;
                } catch (const SQLite::Exception& error) {
                    throw store_error(writer_->handle(), error);  // before undoing it makes another error the last
                }
            } catch (const SQLite::Exception& error) {
                throw store_error(writer_->handle(), error);
            }
        }();
        for (const std::string& id : changed) changes().tell(id);
        return done;
    }
    /// Runs `work` on one of the connections for readers, in one view of the store.
    template <class Work>
    auto read(const Work& work) {
        std::unique_ptr<Connection> connection = take_reader();
        try {
            SQLite::Transaction transaction(connection->database());
            auto result = work(*connection);
            transaction.commit();
            give_back(std::move(connection));
            return result;
        } catch (const SQLite::Exception& error) {
            const StoreError told = store_error(connection->handle(), error);
            give_back(nullptr);
            throw told;
        } catch (...) {
            give_back(nullptr);
            throw;
        }
    }
    std::unique_ptr<Connection> take_reader();
    void give_back(std::unique_ptr<Connection> connection);
    /// Moves the log into the file.
    void checkpoint(int mode);

    Int now(Connection& c) {
        Query query(c, "SELECT CAST(round((julianday('now') - 2440587.5) * 86400000) AS INTEGER)");
        query.next();
        return query.number(0) + shift_ms_;
    }
    static Int live_bytes(Connection& c);
    void require_room(Connection& c) const;
    std::optional<std::string> body_of(std::string_view sql, const std::string& id);
    static std::optional<std::string> latest_of(Connection& c, const std::string& key);
    /// Numbers the job's next event, and notes that it changed.
    Int next_event(Connection& c, const std::string& id);
    void add_event(Connection& c, const std::string& id, EventKind kind, std::string_view body, Int at);
    /// Whether the lease still holds.
    static bool holds(Connection& c, const Lease& lease);
    /// From a running state to an ended one, without a result.
    void end(Connection& c, const std::string& id, JobState state, std::string_view error, Int at);
    /// An attempt failed: queues the job again, or ends it.
    void fail_attempt(Connection& c, const std::string& id, std::string_view error, Int at);
    /// Fails the attempt of every job that the query names.
    void fail_attempts(Connection& c, Query& ids, Int at);
    void erase(Connection& c, const std::string& id, Int at);
    struct Head {
        std::string id;
        Int turn;
        Int created;
    };
    static std::optional<Head> head(Connection& c, Priority priority, bool fresh_only, Int at);

    SqliteOptions options_;
    std::atomic<Int> shift_ms_ = 0;
    std::mutex writing_;
    std::unique_ptr<Connection> writer_;
    std::vector<std::string>* changed_ = nullptr;  ///< of the transaction under way
    std::mutex tending_;
    std::unique_ptr<Connection> tender_;  ///< moves the log into the file while others go on
    Int probed_ms_ = 0;

    static constexpr std::size_t kReaders = 8;
    std::mutex reading_;
    std::condition_variable reader_back_;
    std::vector<std::unique_ptr<Connection>> readers_;  ///< idle
    std::size_t readers_out_ = 0;

    std::mutex syncing_;
    std::condition_variable synced_;
    std::unique_ptr<Connection> syncer_;
    std::uint64_t sync_begun_ = 0;  ///< number of the latest write to the disk that has begun
    std::uint64_t sync_done_ = 0;
    bool sync_failed_ = false;  ///< the one done last
};

// ---- opening ----

SqliteStore::SqliteStore(SqliteOptions options) : options_(std::move(options)) {
    try {
        prepare();
        writer_ = std::make_unique<Connection>(options_.path, options_.patience);
        writer_->database().exec("PRAGMA wal_autocheckpoint = " + std::to_string(kCheckpointed));
        tender_ = std::make_unique<Connection>(options_.path, kTenderPatience);
        syncer_ = std::make_unique<Connection>(options_.path, options_.patience);
        // Opens the log, which the connection then holds.
        Query opened(*syncer_, "SELECT turn FROM schedule");
        opened.next();
    } catch (const SQLite::Exception& error) {
        unusable(options_.path, error.what());
    } catch (const fs::filesystem_error& error) {
        unusable(options_.path, error.code().message());
    }
}

void SqliteStore::prepare() {
    const fs::path path(options_.path);
    if (path.has_parent_path()) fs::create_directories(path.parent_path());
    // Measurements are their owner's alone; SQLite gives its other files the same rights.
    const int made = ::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, S_IRUSR | S_IWUSR);
    if (made < 0) unusable(options_.path, std::system_category().message(errno));
    ::close(made);

    SQLite::Database database(options_.path, SQLite::OPEN_READWRITE, static_cast<int>(options_.patience.count()));
    const auto pragma = [&](const std::string& name) { return database.execAndGet("PRAGMA " + name).getInt64(); };
    if (sqlite3_db_readonly(database.getHandle(), "main") == 1) unusable(options_.path, "it is read-only");
    bool fresh = false;
    {
        SQLite::Transaction view(database);  // another process may be making the tables
        fresh = pragma("application_id") != kApplication;
        if (fresh && database.execAndGet("SELECT count(*) FROM sqlite_schema").getInt64() > 0)
            unusable(options_.path, "it is another program's file");
        if (!fresh && pragma("user_version") > kVersion) unusable(options_.path, "a newer version of brdfit wrote it");
        view.commit();
    }
    if (fresh) {
        database.exec("PRAGMA auto_vacuum = INCREMENTAL");
        const auto until = std::chrono::steady_clock::now() + options_.patience;
        // Others that open it have it for a moment, and SQLite does not wait for them here.
        while (database.tryExec("PRAGMA journal_mode = WAL") == SQLITE_BUSY && std::chrono::steady_clock::now() < until)
            std::this_thread::sleep_for(Milliseconds(5));
        SQLite::Transaction transaction(database, SQLite::TransactionBehavior::EXCLUSIVE);
        if (pragma("application_id") != kApplication) {
            database.exec(kTables);
            database.exec("PRAGMA application_id = " + std::to_string(kApplication) +
                          "; PRAGMA user_version = " + std::to_string(kVersion));
        }
        transaction.commit();
    }
    if (fs::file_size(path) <= kChecked) {
        const std::string found = database.execAndGet("PRAGMA quick_check(1)").getString();
        if (found != "ok") unusable(options_.path, "it is damaged: " + found);
    }
    if (database.execAndGet("PRAGMA journal_mode").getString() != "wal")
        unusable(options_.path, "its folder does not allow a log that processes share");
}

std::unique_ptr<Connection> SqliteStore::take_reader() {
    std::unique_lock lock(reading_);
    reader_back_.wait(lock, [this] { return readers_out_ < kReaders; });
    ++readers_out_;
    if (!readers_.empty()) {
        auto connection = std::move(readers_.back());
        readers_.pop_back();
        return connection;
    }
    lock.unlock();
    try {
        return std::make_unique<Connection>(options_.path, options_.patience);
    } catch (const SQLite::Exception& error) {
        give_back(nullptr);
        throw store_error(nullptr, error);
    }
}

void SqliteStore::give_back(std::unique_ptr<Connection> connection) {
    const std::lock_guard lock(reading_);
    --readers_out_;
    if (connection) readers_.push_back(std::move(connection));
    reader_back_.notify_one();
}

// Commits write the log without waiting for the disk (synchronous = NORMAL), so that a job can begin at once. Here the
// log is brought to the disk: all that was committed before, as it is written in order, or is in the file already,
// which SQLite moves there only when the log is on the disk.
void SqliteStore::sync() {
    std::unique_lock lock(syncing_);
    const std::uint64_t wanted = sync_begun_ + 1;  // one that is under way may have begun before our commit
    while (sync_done_ < wanted) {
        if (sync_begun_ != sync_done_) {
            synced_.wait(lock);
            continue;
        }
        ++sync_begun_;
        lock.unlock();
        sqlite3_file* log = nullptr;
        const int found = sqlite3_file_control(syncer_->handle(), "main", SQLITE_FCNTL_JOURNAL_POINTER, &log);
        const bool failed = found != SQLITE_OK || log == nullptr || log->pMethods == nullptr ||
                            log->pMethods->xSync(log, SQLITE_SYNC_NORMAL | SQLITE_SYNC_DATAONLY) != SQLITE_OK;
        lock.lock();
        sync_failed_ = failed;
        sync_done_ = sync_begun_;
        synced_.notify_all();
    }
    if (sync_failed_) throw StoreError(Kind::unavailable, "the log of the store cannot be written to the disk");
}

// ---- parts of transactions ----

Int SqliteStore::live_bytes(Connection& c) {
    Query query(c,
                "SELECT (page_count - freelist_count) * page_size FROM pragma_page_count, pragma_freelist_count, "
                "pragma_page_size");
    query.next();
    return query.number(0);
}

void SqliteStore::require_room(Connection& c) const {
    if (options_.most_bytes && live_bytes(c) > static_cast<Int>(*options_.most_bytes))
        throw StoreError(Kind::full, "the store holds as much as it may");
}

std::optional<std::string> SqliteStore::body_of(std::string_view sql, const std::string& id) {
    return read([&](Connection& c) -> std::optional<std::string> {
        Query query(c, sql, id);
        if (!query.next()) return std::nullopt;
        return query.text(0);
    });
}

std::optional<std::string> SqliteStore::latest_of(Connection& c, const std::string& key) {
    if (key.empty()) return std::nullopt;
    Query query(
        c, "SELECT id FROM job WHERE result_key = ? AND state = 3 AND result_key != '' ORDER BY ended DESC LIMIT 1",
        key);
    if (!query.next()) return std::nullopt;
    return query.text(0);
}

Int SqliteStore::next_event(Connection& c, const std::string& id) {
    changed_->push_back(id);
    Query query(c, "UPDATE job SET last_event = last_event + 1 WHERE id = ? RETURNING last_event", id);
    query.next();
    return query.number(0);
}

void SqliteStore::add_event(Connection& c, const std::string& id, EventKind kind, std::string_view body, Int at) {
    const Int number = next_event(c, id);
    Query(c, "INSERT INTO event(job, number, kind, at, body) VALUES(?, ?, ?, ?, ?)", id, number, code(kind), at, body)
        .run();
}

bool SqliteStore::holds(Connection& c, const Lease& lease) {
    return Query(c, "SELECT 1 FROM job WHERE id = ? AND token = ? AND state IN (1, 2)", lease.job, lease.token).next();
}

void SqliteStore::end(Connection& c, const std::string& id, JobState state, std::string_view error, Int at) {
    Query(c, "UPDATE job SET state = ?, error = ?, ended = ?, owner = '', cancel_at = NULL WHERE id = ?", code(state),
          error, at, id)
        .run();
    Query(c, "DELETE FROM request WHERE job = ?", id).run();
    Query(c, "DELETE FROM event WHERE job = ? AND kind = ?", id, code(EventKind::progress)).run();
    add_event(c, id, EventKind::done, name_of(state), at);
}

void SqliteStore::fail_attempt(Connection& c, const std::string& id, std::string_view error, Int at) {
    Int attempt = 0;
    {
        Query query(c, "SELECT attempt, state FROM job WHERE id = ?", id);
        if (!query.next()) return;
        attempt = query.number(0);
        if (query.number(1) == code(JobState::cancelling)) attempt = -1;
    }
    if (attempt < 0) return end(c, id, JobState::cancelled, "", at);
    if (attempt >= kMostAttempts) return end(c, id, JobState::failed, error, at);
    Int backoff = kBackoff_ms;
    for (Int i = 1; i < attempt; ++i) backoff = std::min(4 * backoff, kLongestBackoff_ms);
    Query(c, "UPDATE job SET state = 0, owner = '', run_at = ? WHERE id = ?", at + backoff, id).run();
    add_event(c, id, EventKind::state, name_of(JobState::queued), at);
}

void SqliteStore::fail_attempts(Connection& c, Query& ids, Int at) {
    std::vector<std::string> failed;
    while (ids.next()) failed.push_back(ids.text(0));
    for (const std::string& id : failed) fail_attempt(c, id, poison_job_error(), at);
}

void SqliteStore::erase(Connection& c, const std::string& id, Int at) {
    for (const std::string_view sql : {"DELETE FROM job WHERE id = ?", "DELETE FROM request WHERE job = ?",
                                       "DELETE FROM result WHERE job = ?", "DELETE FROM figures WHERE job = ?",
                                       "DELETE FROM event WHERE job = ?", "DELETE FROM idempotency WHERE job = ?"})
        Query(c, sql, id).run();
    Query(c, "INSERT OR REPLACE INTO removed(job, at) VALUES(?, ?)", id, at).run();
    changed_->push_back(id);
}

// ---- datasets ----

JobStore::PutDataset SqliteStore::put_dataset(std::string_view body, std::string_view meta) {
    PutDataset put{sha256(body), false};
    return write([&](Connection& c) {
        if (Query(c, "SELECT 1 FROM dataset WHERE id = ?", put.id).next()) return put;
        require_room(c);
        Query(c, "INSERT INTO dataset(id, meta, bytes, created, body) VALUES(?, ?, ?, ?, ?)", put.id, meta,
              static_cast<Int>(body.size()), now(c), Blob{body})
            .run();
        put.created = true;
        return put;
    });
}

std::optional<Dataset> SqliteStore::find_dataset(const std::string& id) {
    return read([&](Connection& c) -> std::optional<Dataset> {
        Query query(c, "SELECT id, meta, bytes, created, body FROM dataset WHERE id = ?", id);
        if (!query.next()) return std::nullopt;
        return Dataset{{query.text(0), query.text(1), static_cast<std::size_t>(query.number(2)), query.time(3)},
                       query.text(4)};
    });
}

Page<DatasetInfo> SqliteStore::list_datasets(const PageRequest& page) {
    Int created = std::numeric_limits<Int>::max();
    std::string id;
    if (page.cursor) {  // created.id
        const char* const last = page.cursor->data() + page.cursor->size();
        const auto [point, error] = std::from_chars(page.cursor->data(), last, created);
        if (error != std::errc{} || point == last || *point != '.') throw std::invalid_argument("cursor");
        id.assign(point + 1, last);
    }
    return read([&](Connection& c) {
        Page<DatasetInfo> found;
        Query query(c,
                    "SELECT id, meta, bytes, created FROM dataset WHERE (created, id) < (?, ?) "
                    "ORDER BY created DESC, id DESC LIMIT ?",
                    created, id, static_cast<Int>(page.limit + 1));
        while (query.next()) {
            if (found.items.size() == page.limit) {
                const DatasetInfo& last = found.items.back();
                found.next = std::to_string(last.created.time_since_epoch().count()) + "." + last.id;
                break;
            }
            found.items.push_back(
                {query.text(0), query.text(1), static_cast<std::size_t>(query.number(2)), query.time(3)});
        }
        return found;
    });
}

JobStore::RemoveDataset SqliteStore::remove_dataset(const std::string& id) {
    return write([&](Connection& c) {
        if (Query(c, "SELECT 1 FROM job WHERE dataset = ? AND ended IS NULL", id).next()) return RemoveDataset::in_use;
        return Query(c, "DELETE FROM dataset WHERE id = ?", id).run() > 0 ? RemoveDataset::removed
                                                                          : RemoveDataset::unknown;
    });
}

// ---- jobs, for front ends ----

Submitted SqliteStore::submit(const NewJob& job) {
    using Outcome = Submitted::Outcome;
    return write([&](Connection& c) -> Submitted {
        const Int at = now(c);
        if (job.idempotency) {
            Query used(c,
                       "SELECT i.body_sha256, i.job, j.ended FROM idempotency i LEFT JOIN job j ON j.id = i.job "
                       "WHERE i.tenant = ? AND i.key = ? AND i.expires > ?",
                       job.tenant, job.idempotency->key, at);
            if (used.next()) {
                if (used.text(0) != job.idempotency->body_sha256) return {Outcome::other_body, used.text(1)};
                return {used.is_null(2) ? Outcome::in_flight : Outcome::replayed, used.text(1)};
            }
        }
        Submitted submitted{Outcome::created, job.id};
        if (job.reuse)
            if (auto earlier = latest_of(c, job.result_key)) submitted = {Outcome::reused, std::move(*earlier)};
        if (submitted.outcome == Outcome::created) {
            if (job.dataset && !Query(c, "SELECT 1 FROM dataset WHERE id = ?", *job.dataset).next())
                return {Outcome::unknown_dataset, ""};
            require_room(c);
            // Start-time fair queueing: a tenant's jobs follow each other, those of several tenants alternate.
            Query(c,
                  "INSERT INTO job(id, tenant, priority, state, dataset, result_key, turn, run_at, attempt, owner, "
                  "token, "
                  "lease_until, lease, created, last_event, progress, error) VALUES(?1, ?2, ?3, 0, ?4, ?5, 1 + max("
                  "(SELECT turn FROM schedule WHERE priority = ?3), ifnull((SELECT max(turn) FROM job "
                  "WHERE state = 0 AND tenant = ?2 AND priority = ?3), 0)), ?6, 0, '', 0, 0, 0, ?6, 0, '', '')",
                  job.id, job.tenant, code(job.priority), job.dataset, job.result_key, at)
                .run();
            Query(c, "INSERT INTO request(job, body) VALUES(?, ?)", job.id, Blob{job.request}).run();
            add_event(c, job.id, EventKind::state, name_of(JobState::queued), at);
            changed_->push_back(kQueue);
        }
        if (job.idempotency)
            Query(c, "INSERT OR REPLACE INTO idempotency(tenant, key, body_sha256, job, expires) VALUES(?, ?, ?, ?, ?)",
                  job.tenant, job.idempotency->key, job.idempotency->body_sha256, submitted.id,
                  at + static_cast<Int>(job.idempotency->kept.count()))
                .run();
        return submitted;
    });
}

std::optional<Job> SqliteStore::find(const std::string& id) {
    return read([&](Connection& c) -> std::optional<Job> {
        static const std::string sql = "SELECT " + std::string(kJobColumns) + " FROM job WHERE id = ?";
        Query query(c, sql, id);
        if (!query.next()) return std::nullopt;
        return job_of(query);
    });
}

Presence SqliteStore::presence(const std::string& id) {
    return read([&](Connection& c) {
        if (Query(c, "SELECT 1 FROM job WHERE id = ?", id).next()) return Presence::present;
        return Query(c, "SELECT 1 FROM removed WHERE job = ?", id).next() ? Presence::removed : Presence::unknown;
    });
}

Page<Job> SqliteStore::list(const JobFilter& filter, const PageRequest& page) {
    std::string sql = "SELECT " + std::string(kJobColumns) + " FROM job WHERE id < ?1";
    if (filter.tenant) sql += " AND tenant = ?2";
    if (filter.state) sql += " AND state = ?3";
    if (filter.dataset) sql += " AND dataset = ?4";
    sql += " ORDER BY id DESC LIMIT ?5";
    std::optional<Int> state;
    if (filter.state) state = code(*filter.state);
    return read([&](Connection& c) {
        Page<Job> found;
        // Ids are of hexadecimal digits: the tilde stands after all of them. Parameters that the text lacks are bound
        // all the same, as the last one's number counts them.
        Query query(c, sql, page.cursor.value_or("~"), filter.tenant, state, filter.dataset,
                    static_cast<Int>(page.limit + 1));
        while (query.next()) {
            if (found.items.size() == page.limit) {
                found.next = found.items.back().id;
                break;
            }
            found.items.push_back(job_of(query));
        }
        return found;
    });
}

std::optional<std::size_t> SqliteStore::queue_position(const std::string& id) {
    return read([&](Connection& c) -> std::optional<std::size_t> {
        Query job(c, "SELECT priority, turn FROM job WHERE id = ? AND state = 0", id);
        if (!job.next()) return std::nullopt;
        Query before(c,
                     "SELECT (SELECT count(*) FROM job WHERE state = 0 AND priority = ?1 AND (turn, id) < (?2, ?3)) + "
                     "(SELECT count(*) FROM job WHERE state = 0 AND priority < ?1)",
                     job.number(0), job.number(1), id);
        before.next();
        return static_cast<std::size_t>(before.number(0));
    });
}

std::optional<JobState> SqliteStore::request_cancel(const std::string& id) {
    return write([&](Connection& c) -> std::optional<JobState> {
        JobState state{};
        {
            Query query(c, "SELECT state FROM job WHERE id = ?", id);
            if (!query.next()) return std::nullopt;
            state = static_cast<JobState>(query.number(0));
        }
        const Int at = now(c);
        if (state == JobState::queued) {
            state = JobState::cancelled;
            end(c, id, state, "", at);
        } else if (state == JobState::running) {
            state = JobState::cancelling;
            Query(c, "UPDATE job SET state = ?, cancel_at = ? WHERE id = ?", code(state), at, id).run();
            add_event(c, id, EventKind::state, name_of(state), at);
            changed_->push_back(kQueue);
        }
        return state;
    });
}

Presence SqliteStore::remove(const std::string& id) {
    return write([&](Connection& c) {
        if (Query(c, "SELECT 1 FROM job WHERE id = ?", id).next()) {
            erase(c, id, now(c));
            return Presence::present;
        }
        return Query(c, "SELECT 1 FROM removed WHERE job = ?", id).next() ? Presence::removed : Presence::unknown;
    });
}

std::vector<Event> SqliteStore::events(const std::string& id, std::uint64_t after, std::size_t most) {
    return read([&](Connection& c) {
        std::vector<Event> found;
        Query query(c, "SELECT number, kind, body, at FROM event WHERE job = ? AND number > ? ORDER BY number LIMIT ?",
                    id, static_cast<Int>(std::min<std::uint64_t>(after, std::numeric_limits<Int>::max())),
                    static_cast<Int>(most));
        while (query.next())
            found.push_back({static_cast<std::uint64_t>(query.number(0)), static_cast<EventKind>(query.number(1)),
                             query.text(2), query.time(3)});
        return found;
    });
}

std::optional<std::string> SqliteStore::result(const std::string& id) {
    return body_of("SELECT body FROM result WHERE job = ?", id);
}

std::optional<std::string> SqliteStore::figures(const std::string& id) {
    return body_of("SELECT body FROM figures WHERE job = ?", id);
}

std::optional<std::string> SqliteStore::find_result(const std::string& key) {
    return read([&](Connection& c) { return latest_of(c, key); });
}

// ---- jobs, for workers ----

std::optional<SqliteStore::Head> SqliteStore::head(Connection& c, Priority priority, bool fresh_only, Int at) {
    // A time too far ahead is one of a clock that was set back since.
    Query query(c,
                "SELECT id, turn, created FROM job WHERE state = 0 AND priority = ?1 AND (run_at <= ?2 OR run_at > ?3) "
                "AND (?4 = 0 OR attempt = 0) ORDER BY turn, id LIMIT 1",
                code(priority), at, at + kLongestBackoff_ms, static_cast<Int>(fresh_only));
    if (!query.next()) return std::nullopt;
    return Head{query.text(0), query.number(1), query.number(2)};
}

std::optional<Claimed> SqliteStore::claim(const std::string& owner, const ClaimOptions& options) {
    // Mostly there is nothing to do, and that is seen without a lock.
    const bool any = read([&](Connection& c) {
        const Int at = now(c);
        return (options.interactive && head(c, Priority::interactive, options.fresh_only, at)) ||
               (options.batch && head(c, Priority::batch, options.fresh_only, at));
    });
    if (!any) return std::nullopt;
    return write([&](Connection& c) -> std::optional<Claimed> {
        const Int at = now(c);
        std::optional<Head> interactive, batch;
        if (options.interactive) interactive = head(c, Priority::interactive, options.fresh_only, at);
        if (options.batch) batch = head(c, Priority::batch, options.fresh_only, at);
        if (!interactive && !batch) return std::nullopt;
        Priority priority = interactive ? Priority::interactive : Priority::batch;
        if (interactive && batch && at - batch->created >= kAged_ms) {
            Query streak(c, "SELECT streak FROM schedule WHERE priority = 0");
            if (streak.next() && streak.number(0) >= kStreak) priority = Priority::batch;
        }
        const Head& job = priority == Priority::interactive ? *interactive : *batch;
        Query(c, "UPDATE schedule SET streak = CASE ?1 WHEN 0 THEN streak + 1 ELSE 0 END WHERE priority = 0",
              code(priority))
            .run();
        Query(c, "UPDATE schedule SET turn = max(turn, ?2) WHERE priority = ?1", code(priority), job.turn).run();
        Claimed claimed;
        claimed.priority = priority;
        {
            Query update(
                c,
                "UPDATE job SET state = 1, attempt = attempt + 1, owner = ?2, token = token + 1, "
                "lease_until = ?3 + ?4, lease = ?4, started = ?3 WHERE id = ?1 RETURNING token, attempt, dataset",
                job.id, owner, at, static_cast<Int>(options.lease.count()));
            update.next();
            claimed.lease = {job.id, update.number(0)};
            claimed.attempt = static_cast<unsigned>(update.number(1));
            if (const auto dataset = update.optional_text(2)) {
                Query body(c, "SELECT body FROM dataset WHERE id = ?", *dataset);
                if (body.next()) claimed.dataset = body.text(0);
            }
        }
        Query request(c, "SELECT body FROM request WHERE job = ?", job.id);
        if (request.next()) claimed.request = request.text(0);
        add_event(c, job.id, EventKind::state, name_of(JobState::running), at);
        return claimed;
    });
}

Beat SqliteStore::heartbeat(const Lease& lease, Milliseconds renewed, std::string_view progress) {
    return write([&](Connection& c) -> Beat {
        const Int at = now(c);
        Beat beat;
        {
            Query update(c,
                         "UPDATE job SET lease_until = ?3 + ?4, lease = ?4, progress = CASE ?5 WHEN '' THEN progress "
                         "ELSE ?5 END WHERE id = ?1 AND token = ?2 AND state IN (1, 2) RETURNING state",
                         lease.job, lease.token, at, static_cast<Int>(renewed.count()), progress);
            beat.mine = update.next();
            if (!beat.mine) return beat;
            beat.cancel_requested = update.number(0) == code(JobState::cancelling);
        }
        if (!progress.empty()) {
            Query(c, "DELETE FROM event WHERE job = ? AND kind = ?", lease.job, code(EventKind::progress)).run();
            add_event(c, lease.job, EventKind::progress, progress, at);
        }
        return beat;
    });
}

bool SqliteStore::add_event(const Lease& lease, EventKind kind, std::string_view body) {
    return write([&](Connection& c) {
        if (!holds(c, lease)) return false;
        add_event(c, lease.job, kind, body, now(c));
        return true;
    });
}

bool SqliteStore::finish(const Lease& lease, const Ending& ending) {
    return write([&](Connection& c) {
        if (!holds(c, lease)) return false;
        const auto insert = [&](std::string_view sql, const std::string& body) {
            if (!body.empty()) Query(c, sql, lease.job, Blob{body}).run();
        };
        insert("INSERT INTO result(job, body) VALUES(?, ?)", ending.result);
        insert("INSERT INTO figures(job, body) VALUES(?, ?)", ending.figures);
        for (const std::string& model : ending.models_done)
            add_event(c, lease.job, EventKind::model_done, model, now(c));
        end(c, lease.job, ending.state, ending.error, now(c));
        return true;
    });
}

bool SqliteStore::retry(const Lease& lease, std::string_view error) {
    return write([&](Connection& c) {
        if (!holds(c, lease)) return false;
        fail_attempt(c, lease.job, error, now(c));
        return true;
    });
}

bool SqliteStore::release(const Lease& lease) {
    return write([&](Connection& c) {
        const Int at = now(c);
        Query state(c, "SELECT state FROM job WHERE id = ? AND token = ? AND state IN (1, 2)", lease.job, lease.token);
        if (!state.next()) return false;
        if (state.number(0) == code(JobState::cancelling)) {
            end(c, lease.job, JobState::cancelled, "", at);
            return true;
        }
        Query(c, "UPDATE job SET state = 0, owner = '', attempt = attempt - 1, run_at = ? WHERE id = ?", at, lease.job)
            .run();
        add_event(c, lease.job, EventKind::state, name_of(JobState::queued), at);
        return true;
    });
}

// ---- looking after it ----

void SqliteStore::bury(const std::string& owner) {
    write([&](Connection& c) {
        Query jobs(c, "SELECT id FROM job WHERE owner = ? AND state IN (1, 2)", owner);
        fail_attempts(c, jobs, now(c));
        return true;
    });
}

std::vector<JobStore::Stuck> SqliteStore::stuck(Milliseconds patience) {
    return read([&](Connection& c) {
        std::vector<Stuck> found;
        Query query(c, "SELECT id, owner FROM job WHERE state = 2 AND cancel_at <= ?",
                    now(c) - static_cast<Int>(patience.count()));
        while (query.next()) found.push_back({query.text(0), query.text(1)});
        return found;
    });
}

void SqliteStore::tend() {
    // A lease beyond its own length is one of a clock that was set back since.
    constexpr std::string_view expired =
        "SELECT id FROM job WHERE state IN (1, 2) AND (lease_until <= ?1 OR lease_until > ?1 + 2 * lease)";
    const bool any = read([&](Connection& c) {
        const Int at = now(c);
        return Query(c, expired, at).next() || Query(c, "SELECT 1 FROM idempotency WHERE expires <= ?", at).next() ||
               Query(c, "SELECT 1 FROM removed WHERE at <= ?", at - kRemembered_ms).next();
    });
    if (any)
        write([&](Connection& c) {
            const Int at = now(c);
            Query jobs(c, expired, at);
            fail_attempts(c, jobs, at);
            Query(c, "DELETE FROM idempotency WHERE expires <= ?", at).run();
            Query(c, "DELETE FROM removed WHERE at <= ?", at - kRemembered_ms).run();
            return true;
        });
    checkpoint(SQLITE_CHECKPOINT_PASSIVE);
}

void SqliteStore::checkpoint(int mode) {
    const std::lock_guard lock(tending_);
    // What others keep it from doing it does the next time.
    sqlite3_wal_checkpoint_v2(tender_->handle(), nullptr, mode, nullptr, nullptr);
}

void SqliteStore::prune(const Retention& retention) {
    // In small transactions, so that nobody waits for long.
    const auto remove_some = [&](std::string_view sql, Int before, bool datasets) {
        return write([&](Connection& c) {
            std::vector<std::string> ids;
            {
                Query query(c, sql, before, Int{kPruned});
                while (query.next()) ids.push_back(query.text(0));
            }
            const Int at = now(c);
            for (const std::string& id : ids) {
                if (datasets) Query(c, "DELETE FROM dataset WHERE id = ?", id).run();
                else erase(c, id, at);
            }
            return ids.size();
        });
    };
    constexpr std::string_view jobs =
        "SELECT id FROM job WHERE ended IS NOT NULL AND ended <= ? ORDER BY ended LIMIT ?";
    constexpr std::string_view datasets =
        "SELECT id FROM dataset WHERE created <= ? AND NOT EXISTS (SELECT 1 FROM job WHERE job.dataset = dataset.id) "
        "ORDER BY created LIMIT ?";
    if (retention.keep) {
        const Int before = read([&](Connection& c) { return now(c); }) - static_cast<Int>(retention.keep->count());
        while (remove_some(jobs, before, false) > 0) {
        }
        while (remove_some(datasets, before, true) > 0) {
        }
    }
    if (retention.most_bytes) {
        constexpr Int ever = std::numeric_limits<Int>::max();
        const auto too_large = [&] {
            return read([&](Connection& c) { return live_bytes(c); }) > static_cast<Int>(*retention.most_bytes);
        };
        while (too_large() && (remove_some(jobs, ever, false) > 0 || remove_some(datasets, ever, true) > 0)) {
        }
    }
    {
        const std::lock_guard lock(writing_);
        try {
            writer_->database().exec("PRAGMA incremental_vacuum");
        } catch (const SQLite::Exception& error) {
            throw store_error(writer_->handle(), error);
        }
    }
    checkpoint(SQLITE_CHECKPOINT_TRUNCATE);
}

Counts SqliteStore::counts() {
    Counts counts = read([&](Connection& c) {
        Counts found;
        Query states(c, "SELECT state, count(*) FROM job GROUP BY state");
        while (states.next()) {
            const auto count = static_cast<std::size_t>(states.number(1));
            switch (static_cast<JobState>(states.number(0))) {
                case JobState::queued: found.queued_batch = count; break;
                case JobState::running:
                case JobState::cancelling: found.running += count; break;
                case JobState::succeeded: found.succeeded = count; break;
                case JobState::failed: found.failed = count; break;
                case JobState::cancelled: found.cancelled = count; break;
            }
        }
        Query interactive(c, "SELECT count(*) FROM job WHERE state = 0 AND priority = 0");
        interactive.next();
        found.queued_interactive = static_cast<std::size_t>(interactive.number(0));
        found.queued_batch -= found.queued_interactive;
        Query datasets(c, "SELECT count(*) FROM dataset");
        datasets.next();
        found.datasets = static_cast<std::size_t>(datasets.number(0));
        // Ids rise with time.
        Query oldest(c, "SELECT created FROM job WHERE state = 0 ORDER BY id LIMIT 1");
        if (oldest.next()) found.oldest_queued = Milliseconds(std::max<Int>(0, now(c) - oldest.number(0)));
        return found;
    });
    for (const char* suffix : {"", "-wal"}) {
        std::error_code none;
        const auto size = fs::file_size(options_.path + suffix, none);
        if (!none) counts.bytes += size;
    }
    return counts;
}

void SqliteStore::probe() {
    write([&](Connection& c) {
        constexpr Int kOften_ms = 1000;  // health checks may come thick and fast
        const Int at = now(c);
        if (at - probed_ms_ >= kOften_ms || at < probed_ms_)
            Query(c, "UPDATE schedule SET streak = streak WHERE priority = 1").run();
        probed_ms_ = at;
        return true;
    });
}

}  // namespace

std::unique_ptr<JobStore> open_sqlite(const SqliteOptions& options) { return std::make_unique<SqliteStore>(options); }

}  // namespace brdfit::server
