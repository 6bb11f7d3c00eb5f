/// Where datasets, jobs and results are kept, and what decides who computes what: the one thing that front ends and
/// workers share.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "server/changes.h"

namespace brdfit::server {

/// A point in time by the store's clock: milliseconds since 1970.
using StoreTime = std::chrono::sys_time<std::chrono::milliseconds>;

enum class JobState { queued, running, cancelling, succeeded, failed, cancelled };
inline bool has_ended(JobState state) { return state >= JobState::succeeded; }
/// "queued", ...: as on the wire.
std::string_view name_of(JobState state);
/// The state of that name, if there is one.
std::optional<JobState> job_state(std::string_view name);

/// Interactive jobs go first, as somebody waits for them.
enum class Priority { interactive, batch };

/// Something that the store cannot do. what() is for the log, never for a client.
class StoreError : public std::runtime_error {
public:
    enum class Kind {
        full,         ///< no room: on the disk, or what it may hold; nothing was changed
        unavailable,  ///< busy for too long, or an error of input or output; nothing was changed
        unusable,     ///< at the start: damaged, of a newer version, not ours, not writable; never overwritten
    };
    StoreError(Kind kind_in, const std::string& what) : std::runtime_error(what), kind(kind_in) {}
    Kind kind;
};

// ---- datasets ----

struct DatasetInfo {
    std::string id;    ///< SHA-256 of the body, 64 hexadecimal digits
    std::string meta;  ///< what a list shows; the store does not read it
    std::size_t bytes = 0;
    StoreTime created{};
};
struct Dataset {
    DatasetInfo info;
    std::string body;  ///< canonical bytes; the store does not read them
};

/// A page of a list, newest first. Entries that are added or removed meanwhile move no other one to another page.
template <class Item>
struct Page {
    std::vector<Item> items;
    std::optional<std::string> next{};  ///< cursor of the next page, opaque; none on the last
};
struct PageRequest {
    std::size_t limit = 50;               ///< 1..1000
    std::optional<std::string> cursor{};  ///< as Page::next gave it
};

// ---- jobs ----

/// A new job's name: UUID version 7, time-ordered and unguessable.
std::string make_job_id();

struct IdempotencyKey {
    std::string key;
    std::string body_sha256;
    std::chrono::milliseconds kept = std::chrono::hours(24);
};

struct NewJob {
    std::string id;      ///< of make_job_id()
    std::string tenant;  ///< whose it is; empty where there is only one
    Priority priority = Priority::batch;
    std::optional<std::string> dataset{};  ///< id of a stored one, if the request refers to it
    std::string request;                   ///< what the worker reads; the store does not
    std::string result_key;                ///< SHA-256 of all that decides the result (see result_key()), or empty
    /// An ended job of the same result_key answers instead of a new one.
    bool reuse = false;
    std::optional<IdempotencyKey> idempotency{};
};

struct Submitted {
    enum class Outcome {
        created,          ///< `id` is the new job's
        reused,           ///< `id` is that of an ended job with the same result
        replayed,         ///< the idempotency key was used for the same body: `id` is that job's, which has ended
        in_flight,        ///< the same, and it has not ended
        other_body,       ///< the idempotency key was used for another body: nothing was done
        unknown_dataset,  ///< there is no such dataset: nothing was done
    };
    Outcome outcome = Outcome::created;
    std::string id;
};

struct Job {
    std::string id;
    std::string tenant;
    Priority priority = Priority::batch;
    JobState state = JobState::queued;
    std::optional<std::string> dataset{};
    unsigned attempt = 0;  ///< how often it was begun
    std::string progress;  ///< JSON as the worker gave it; empty before
    std::string error;     ///< JSON of a problem as the worker gave it; the store's own are poison_job_error()
    StoreTime created{};
    std::optional<StoreTime> started{};  ///< the last attempt
    std::optional<StoreTime> ended{};
    std::uint64_t last_event = 0;  ///< number of its latest event
};

/// What Job::error holds of a job that failed three times without saying why.
std::string_view poison_job_error();

struct JobFilter {
    std::optional<std::string> tenant{};
    std::optional<JobState> state{};
    std::optional<std::string> dataset{};
};

/// What became of an id.
enum class Presence { present, removed, unknown };

enum class EventKind { state, progress, model_done, done };
std::string_view name_of(EventKind kind);

struct Event {
    std::uint64_t number = 0;  ///< from 1, rising within a job; progress that has become old is left out
    EventKind kind = EventKind::state;
    std::string body;  ///< of state and done: the state's name; else JSON as the worker gave it
    StoreTime at{};
};

// ---- the worker's side ----

/// What Changes are told when there is something new to claim or to cancel.
inline constexpr const char* kQueue = "";

/// After so many attempts a job is given up.
inline constexpr unsigned kMostAttempts = 3;

/// The right to compute a job until it runs out.
struct Lease {
    std::string job;
    std::int64_t token = 0;  ///< of this attempt alone: a later one has another, and this one's writes are refused
};

struct ClaimOptions {
    std::chrono::milliseconds lease = std::chrono::seconds(30);
    bool interactive = true;
    bool batch = true;
    /// Only jobs that were never begun: whoever computes several at once takes a job alone that may have ended a
    /// worker.
    bool fresh_only = false;
};

struct Claimed {
    Lease lease;
    Priority priority = Priority::batch;
    unsigned attempt = 1;
    std::string request;
    std::string dataset;  ///< body of the dataset that the job refers to, or empty
};

struct Beat {
    bool mine = false;              ///< false: the lease was lost, its work is for nothing
    bool cancel_requested = false;  ///< stop, and finish as cancelled
};

struct Ending {
    JobState state = JobState::succeeded;    ///< an ended one
    std::string result;                      ///< body of the answer; empty if there is none
    std::string figures;                     ///< what plots are drawn from (api/archive.h); empty if there is none
    std::string error;                       ///< JSON of a problem, for `failed`
    std::vector<std::string> models_done{};  ///< bodies of events that come before the last
};

// ---- looking after it ----

struct Retention {
    std::optional<std::chrono::milliseconds> keep{};  ///< how long after its end a job is kept
    std::optional<std::size_t> most_bytes{};          ///< beyond which the oldest ended jobs are removed
};

struct Counts {
    std::size_t queued_interactive = 0;
    std::size_t queued_batch = 0;
    std::size_t running = 0;  ///< and cancelling
    std::size_t succeeded = 0;
    std::size_t failed = 0;
    std::size_t cancelled = 0;
    std::size_t datasets = 0;
    std::size_t bytes = 0;                       ///< on disk
    std::chrono::milliseconds oldest_queued{0};  ///< its age
};

/// Jobs and what belongs to them. One interface, several back ends; tests/unit/store_test.cpp is the contract. Safe to
/// use from several threads, and the same store from several processes at once. Every member may throw StoreError, and
/// has then changed nothing. Only the store's clock decides leases.
///
/// A change is seen by all at once; it outlasts a loss of power once a later sync() has returned.
class JobStore {
public:
    JobStore() = default;
    virtual ~JobStore() = default;
    JobStore(const JobStore&) = delete;
    JobStore& operator=(const JobStore&) = delete;

    /// Returns when everything committed before, by anyone, outlasts a loss of power. Call it before an answer says
    /// that something was taken or removed; many callers share one write.
    virtual void sync() = 0;
    /// Who waits for a job's events waits here by its id, who waits for something to claim or to cancel by kQueue. See
    /// Changes.
    Changes& changes() { return changes_; }

    // ---- datasets ----
    struct PutDataset {
        std::string id;
        bool created = false;  ///< false: it was there
    };
    virtual PutDataset put_dataset(std::string_view body, std::string_view meta) = 0;
    virtual std::optional<Dataset> find_dataset(const std::string& id) = 0;
    virtual Page<DatasetInfo> list_datasets(const PageRequest& page) = 0;
    enum class RemoveDataset {
        removed,
        unknown,
        in_use,  ///< a job that has not ended refers to it
    };
    virtual RemoveDataset remove_dataset(const std::string& id) = 0;

    // ---- jobs, for front ends ----
    /// Job and idempotency key in one transaction.
    virtual Submitted submit(const NewJob& job) = 0;
    virtual std::optional<Job> find(const std::string& id) = 0;
    /// Tells a job that was removed from one that never was, for a month after.
    virtual Presence presence(const std::string& id) = 0;
    virtual Page<Job> list(const JobFilter& filter, const PageRequest& page) = 0;
    /// How many jobs are before it; none if it is not queued.
    virtual std::optional<std::size_t> queue_position(const std::string& id) = 0;
    /// A queued job is cancelled at once, a running one becomes `cancelling`. The state that it then has; none if there
    /// is no such job.
    virtual std::optional<JobState> request_cancel(const std::string& id) = 0;
    /// Removes a job with its result and events. A running one's lease is void from then on.
    virtual Presence remove(const std::string& id) = 0;
    /// Events with a number above `after`, at most `most`.
    virtual std::vector<Event> events(const std::string& id, std::uint64_t after, std::size_t most = 1000) = 0;
    virtual std::optional<std::string> result(const std::string& id) = 0;
    virtual std::optional<std::string> figures(const std::string& id) = 0;
    /// The latest succeeded job of that key, if its result is kept.
    virtual std::optional<std::string> find_result(const std::string& result_key) = 0;

    // ---- jobs, for workers ----
    /// The next job: interactive ones first, but every fifth time a batch job that has waited long; tenants in turn.
    /// `owner` is the worker's own name: no other process, nor a later one, has it.
    virtual std::optional<Claimed> claim(const std::string& owner, const ClaimOptions& options) = 0;
    /// Renews the lease, and records progress (JSON) unless it is empty.
    virtual Beat heartbeat(const Lease& lease, std::chrono::milliseconds renewed, std::string_view progress) = 0;
    /// False if the lease was lost.
    virtual bool add_event(const Lease& lease, EventKind kind, std::string_view body) = 0;
    /// Ends the job, with its result, in one transaction: false if the lease was lost, and then nothing is written.
    virtual bool finish(const Lease& lease, const Ending& ending) = 0;
    /// The attempt failed for a reason that another may not meet: the job is queued again after a while, or, the third
    /// time, failed with that error.
    virtual bool retry(const Lease& lease, std::string_view error) = 0;
    /// Gives the job back unharmed, for others to take at once: the attempt does not count.
    virtual bool release(const Lease& lease) = 0;

    // ---- looking after it ----
    /// A worker is known to have ended: its leases are void now. Jobs as after retry().
    virtual void bury(const std::string& owner) = 0;
    /// A job that was to be cancelled long ago and still runs: its worker does not heed.
    struct Stuck {
        std::string job;
        std::string owner;
    };
    /// Those of more than `patience` ago.
    virtual std::vector<Stuck> stuck(std::chrono::milliseconds patience) = 0;
    /// Voids leases that ran out, drops idempotency keys that have. To be called about once a second.
    virtual void tend() = 0;
    /// Removes what is kept no longer. To be called about once a minute.
    virtual void prune(const Retention& retention) = 0;
    virtual Counts counts() = 0;
    /// Throws StoreError if nothing can be written now: for health checks.
    virtual void probe() = 0;
    /// For tests: moves the store's clock, for this object, from now on.
    virtual void shift_clock(std::chrono::milliseconds by) = 0;

private:
    Changes changes_;
};

/// 64 hexadecimal digits.
std::string sha256(std::string_view bytes);

/// Key of a result: SHA-256 of the parts in their order, which cannot run into each other.
std::string result_key(const std::vector<std::string_view>& parts);

struct SqliteOptions {
    std::string path;                          ///< a file; it and its folder are made if need be
    std::chrono::milliseconds patience{5000};  ///< how long to wait for others that write
    std::optional<std::size_t> most_bytes{};   ///< submit and put_dataset refuse beyond: StoreError::Kind::full
};

/// A store in a file of SQLite's. Throws StoreError (unusable).
std::unique_ptr<JobStore> open_sqlite(const SqliteOptions& options);

}  // namespace brdfit::server
