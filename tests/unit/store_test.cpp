// What every back end of the job store promises; below, what SQLite's promises besides.
#include <poll.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include <SQLiteCpp/SQLiteCpp.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "server/store.h"

namespace brdfit::server {
namespace {

using namespace std::chrono_literals;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;
namespace fs = std::filesystem;

/// A folder that is gone at the end.
struct Folder {
    Folder() {
        std::string name = (fs::temp_directory_path() / "brdfit-store-XXXXXX").string();
        path = ::mkdtemp(name.data());
    }
    ~Folder() {
        std::error_code none;
        fs::remove_all(path, none);
    }
    fs::path path;
};

struct BackEnd {
    std::string name;
    std::function<std::unique_ptr<JobStore>(const fs::path& folder)> open;  ///< the same store for the same folder
};
void PrintTo(const BackEnd& back_end, std::ostream* out) { *out << back_end.name; }

class StoreTest : public testing::TestWithParam<BackEnd> {
protected:
    [[nodiscard]] std::unique_ptr<JobStore> another() const { return GetParam().open(folder.path); }
    static NewJob job(Priority priority = Priority::batch, const std::string& tenant = "") {
        NewJob made;
        made.id = make_job_id();
        made.tenant = tenant;
        made.priority = priority;
        made.request = "request of " + made.id;
        return made;
    }
    std::string submit(const NewJob& made) { return store->submit(made).id; }
    std::string submit() { return submit(job()); }
    std::optional<Claimed> claim(const ClaimOptions& options = {}) { return store->claim("a worker", options); }
    /// The lease of a job that is now running.
    Lease begin() {
        submit();
        return claim()->lease;
    }
    [[nodiscard]] JobState state(const std::string& id) const { return store->find(id)->state; }
    [[nodiscard]] std::vector<std::string> history(const std::string& id) const {
        std::vector<std::string> all;
        for (const Event& event : store->events(id, 0))
            all.push_back(std::string(name_of(event.kind)) + " " + event.body);
        return all;
    }

    Folder folder;
    std::unique_ptr<JobStore> store = another();
};

INSTANTIATE_TEST_SUITE_P(Sqlite, StoreTest,
                         testing::Values(BackEnd{"sqlite",
                                                 [](const fs::path& folder) {
                                                     return open_sqlite({(folder / "jobs.db").string(), 5s, {}});
                                                 }}),
                         [](const auto& test) { return test.param.name; });

const Ending kDone{JobState::succeeded, "the result", "the figures", ""};

// ---- from the queue to the result ----

TEST_P(StoreTest, AJobGoesFromTheQueueToItsResult) {
    const NewJob made = job();
    EXPECT_EQ(store->submit(made).outcome, Submitted::Outcome::created);
    EXPECT_EQ(state(made.id), JobState::queued);
    EXPECT_EQ(store->queue_position(made.id), 0U);
    const auto claimed = claim();
    ASSERT_TRUE(claimed);
    EXPECT_EQ(claimed->lease.job, made.id);
    EXPECT_EQ(claimed->request, made.request);
    EXPECT_EQ(claimed->attempt, 1U);
    EXPECT_EQ(state(made.id), JobState::running);
    EXPECT_EQ(store->queue_position(made.id), std::nullopt);
    EXPECT_FALSE(claim()) << "it is taken";
    EXPECT_FALSE(store->result(made.id));
    EXPECT_TRUE(store->finish(claimed->lease, kDone));
    const auto found = another()->find(made.id);
    EXPECT_EQ(found->state, JobState::succeeded);
    EXPECT_EQ(found->attempt, 1U);
    EXPECT_TRUE(found->started && found->ended && *found->started <= *found->ended &&
                found->created <= *found->started);
    EXPECT_EQ(store->result(made.id), "the result");
    EXPECT_EQ(store->figures(made.id), "the figures");
    EXPECT_THAT(history(made.id), ElementsAre("state queued", "state running", "done succeeded"));
    store->sync();
}

TEST_P(StoreTest, WhatDoesNotExistIsNotFound) {
    EXPECT_FALSE(store->find("nothing"));
    EXPECT_FALSE(store->result("nothing"));
    EXPECT_FALSE(store->figures("nothing"));
    EXPECT_FALSE(store->find_dataset("nothing"));
    EXPECT_FALSE(store->request_cancel("nothing"));
    EXPECT_FALSE(store->find_result(""));
    EXPECT_FALSE(claim());
    EXPECT_EQ(store->presence("nothing"), Presence::unknown);
    EXPECT_EQ(store->remove("nothing"), Presence::unknown);
    EXPECT_THAT(store->events("nothing", 0), IsEmpty());
    EXPECT_FALSE(store->heartbeat({"nothing", 1}, 30s, "").mine);
    EXPECT_FALSE(store->finish({"nothing", 1}, kDone));
}

TEST_P(StoreTest, BytesComeBackAsTheyWere) {
    std::string bytes("\0\xff'\"\n\x80", 6);
    bytes += std::string(300'000, 'x');
    NewJob made = job();
    made.request = bytes;
    made.tenant = "a'; DROP TABLE job; --";
    store->submit(made);
    const auto claimed = claim();
    EXPECT_EQ(claimed->request, bytes);
    store->finish(claimed->lease, {JobState::succeeded, bytes, bytes, ""});
    EXPECT_EQ(store->result(made.id), bytes);
    EXPECT_EQ(store->figures(made.id), bytes);
    EXPECT_EQ(store->find(made.id)->tenant, made.tenant);
}

TEST_P(StoreTest, AResultOutlastsTheObject) {
    const Lease lease = begin();
    store->finish(lease, kDone);
    const std::string waiting = submit();
    store.reset();
    store = another();
    EXPECT_EQ(store->result(lease.job), "the result");
    EXPECT_EQ(claim()->lease.job, waiting);
}

// ---- leases ----

TEST_P(StoreTest, ALeaseThatIsRenewedHolds) {
    const Lease lease = begin();
    for (int i = 0; i < 4; ++i) {
        store->shift_clock(20s);
        store->tend();
        EXPECT_TRUE(store->heartbeat(lease, 30s, "").mine);
    }
    EXPECT_EQ(store->find(lease.job)->attempt, 1U);
    EXPECT_TRUE(store->finish(lease, kDone));
}

TEST_P(StoreTest, AnExpiredLeaseGoesToAnotherAndTheFirstHasNoEffect) {
    const Lease first = begin();
    store->shift_clock(29s);
    store->tend();
    EXPECT_EQ(state(first.job), JobState::running);
    store->shift_clock(2s);
    store->tend();
    EXPECT_EQ(state(first.job), JobState::queued);
    EXPECT_FALSE(claim()) << "it waits before it is tried again";
    store->shift_clock(1s);
    const auto second = claim();
    ASSERT_TRUE(second);
    EXPECT_EQ(second->attempt, 2U);
    EXPECT_FALSE(store->heartbeat(first, 30s, "{}").mine);
    EXPECT_FALSE(store->add_event(first, EventKind::model_done, "{}"));
    EXPECT_FALSE(store->retry(first, ""));
    EXPECT_FALSE(store->release(first));
    EXPECT_FALSE(store->finish(first, {JobState::succeeded, "late", "", ""}));
    EXPECT_TRUE(store->finish(second->lease, kDone));
    EXPECT_FALSE(store->finish(second->lease, {JobState::succeeded, "twice", "", ""}));
    EXPECT_EQ(store->result(first.job), "the result");
}

TEST_P(StoreTest, AClockThatIsSetBackHoldsNobodyUp) {
    const Lease lease = begin();
    store->shift_clock(-24h);
    store->tend();
    EXPECT_EQ(state(lease.job), JobState::queued);
    store->shift_clock(-24h);
    EXPECT_TRUE(claim());
}

TEST_P(StoreTest, TheThirdFailureIsTheLast) {
    const std::string id = submit();
    for (unsigned attempt = 1; attempt <= kMostAttempts; ++attempt) {
        store->shift_clock(60s);
        const auto claimed = claim();
        ASSERT_TRUE(claimed) << attempt;
        EXPECT_EQ(claimed->attempt, attempt);
        store->shift_clock(31s);
        store->tend();
    }
    store->shift_clock(1h);
    EXPECT_FALSE(claim());
    EXPECT_EQ(state(id), JobState::failed);
    EXPECT_THAT(store->find(id)->error, HasSubstr("poison-job"));
    EXPECT_EQ(history(id).back(), "done failed");
}

TEST_P(StoreTest, AnErrorOfTheWorkersIsKeptAfterTheThirdTime) {
    const std::string id = submit();
    for (unsigned attempt = 1; attempt <= kMostAttempts; ++attempt) {
        store->shift_clock(60s);
        EXPECT_TRUE(store->retry(claim()->lease, "the device failed"));
    }
    EXPECT_EQ(state(id), JobState::failed);
    EXPECT_EQ(store->find(id)->error, "the device failed");
}

TEST_P(StoreTest, AJobThatIsGivenBackIsTakenAtOnceAndUnharmed) {
    Lease lease = begin();
    for (unsigned i = 0; i < 2 * kMostAttempts; ++i) {
        EXPECT_TRUE(store->release(lease));
        EXPECT_FALSE(store->finish(lease, kDone));
        const auto again = claim({30s, true, true, true});
        ASSERT_TRUE(again) << "it counts as never begun";
        EXPECT_EQ(again->attempt, 1U);
        lease = again->lease;
    }
}

TEST_P(StoreTest, AWorkerThatIsKnownToHaveEndedLosesItsLeasesAtOnce) {
    const std::string first = submit(), second = submit();
    const Lease lease = store->claim("dead", {})->lease;
    const auto other = store->claim("alive", {});
    store->bury("dead");
    EXPECT_EQ(state(first), JobState::queued);
    EXPECT_EQ(state(second), JobState::running);
    EXPECT_FALSE(store->heartbeat(lease, 30s, "").mine);
    EXPECT_TRUE(store->finish(other->lease, kDone));
}

TEST_P(StoreTest, AJobThatMayHaveEndedAWorkerIsNotForWhoComputesOthersToo) {
    const Lease lease = begin();
    store->retry(lease, "");
    store->shift_clock(1s);
    EXPECT_FALSE(claim({30s, true, true, true}));
    EXPECT_TRUE(claim());
}

// ---- cancelling, removing ----

TEST_P(StoreTest, AQueuedJobIsCancelledAtOnce) {
    const std::string id = submit();
    EXPECT_EQ(store->request_cancel(id), JobState::cancelled);
    EXPECT_EQ(store->request_cancel(id), JobState::cancelled);
    EXPECT_FALSE(claim());
    EXPECT_THAT(history(id), ElementsAre("state queued", "done cancelled"));
}

TEST_P(StoreTest, ARunningJobsWorkerIsToldToCancel) {
    const Lease lease = begin();
    EXPECT_EQ(store->request_cancel(lease.job), JobState::cancelling);
    EXPECT_EQ(store->request_cancel(lease.job), JobState::cancelling);
    const Beat beat = store->heartbeat(lease, 30s, "");
    EXPECT_TRUE(beat.mine);
    EXPECT_TRUE(beat.cancel_requested);
    EXPECT_THAT(store->stuck(5s), IsEmpty());
    store->shift_clock(6s);
    ASSERT_THAT(store->stuck(5s), SizeIs(1));
    EXPECT_EQ(store->stuck(5s)[0].owner, "a worker");
    EXPECT_TRUE(store->finish(lease, {JobState::cancelled, "", "", ""}));
    EXPECT_EQ(state(lease.job), JobState::cancelled);
    EXPECT_THAT(store->stuck(0s), IsEmpty());
    EXPECT_EQ(store->request_cancel(lease.job), JobState::cancelled);
}

TEST_P(StoreTest, ACancelledJobWhoseWorkerDiesIsNotTriedAgain) {
    const Lease lease = begin();
    store->request_cancel(lease.job);
    store->bury("a worker");
    EXPECT_EQ(state(lease.job), JobState::cancelled);
}

TEST_P(StoreTest, AResultThatComesBeforeTheWorkerHearsOfTheCancelCounts) {
    const Lease lease = begin();
    store->request_cancel(lease.job);
    EXPECT_TRUE(store->finish(lease, kDone));
    EXPECT_EQ(state(lease.job), JobState::succeeded);
}

TEST_P(StoreTest, ARemovedJobIsGoneWithAllThatBelongsToItAndIsRemembered) {
    const Lease lease = begin();
    store->finish(lease, kDone);
    EXPECT_EQ(store->remove(lease.job), Presence::present);
    EXPECT_EQ(store->presence(lease.job), Presence::removed);
    EXPECT_EQ(store->remove(lease.job), Presence::removed);
    EXPECT_FALSE(store->find(lease.job));
    EXPECT_FALSE(store->result(lease.job));
    EXPECT_FALSE(store->figures(lease.job));
    EXPECT_THAT(store->events(lease.job, 0), IsEmpty());
    store->shift_clock(24h * 31);
    store->tend();
    EXPECT_EQ(store->presence(lease.job), Presence::unknown);
}

TEST_P(StoreTest, ARunningJobThatIsRemovedIsNoLongerItsWorkers) {
    const Lease lease = begin();
    EXPECT_EQ(store->remove(lease.job), Presence::present);
    EXPECT_FALSE(store->heartbeat(lease, 30s, "{}").mine);
    EXPECT_FALSE(store->finish(lease, kDone));
    EXPECT_FALSE(store->result(lease.job));
}

// ---- who is next ----

TEST_P(StoreTest, InteractiveJobsGoFirstAndEachKindInItsOrder) {
    const std::string batch1 = submit(), batch2 = submit();
    const std::string now1 = submit(job(Priority::interactive)), now2 = submit(job(Priority::interactive));
    EXPECT_EQ(store->queue_position(now1), 0U);
    EXPECT_EQ(store->queue_position(now2), 1U);
    EXPECT_EQ(store->queue_position(batch1), 2U);
    EXPECT_EQ(store->queue_position(batch2), 3U);
    std::vector<std::string> order;
    while (const auto claimed = claim()) order.push_back(claimed->lease.job);
    EXPECT_THAT(order, ElementsAre(now1, now2, batch1, batch2));
}

TEST_P(StoreTest, AWorkerTakesOnlyTheKindItAsksFor) {
    const std::string batch = submit();
    EXPECT_FALSE(claim({30s, true, false, false}));
    const std::string now = submit(job(Priority::interactive));
    EXPECT_EQ(claim({30s, false, true, false})->lease.job, batch);
    EXPECT_FALSE(claim({30s, false, true, false}));
    EXPECT_EQ(claim({30s, true, false, false})->lease.job, now);
}

TEST_P(StoreTest, TenantsTakeTurnsHoweverMuchOneHasQueued) {
    for (int i = 0; i < 20; ++i) submit(job(Priority::batch, "many"));
    std::vector<std::string> order;
    const auto take = [&](int count) {
        for (int i = 0; i < count; ++i) order.push_back(store->find(claim()->lease.job)->tenant);
    };
    take(3);
    for (int i = 0; i < 3; ++i) submit(job(Priority::batch, "few"));
    take(6);
    EXPECT_EQ(std::count(order.begin() + 3, order.end(), "few"), 3) << "every second one of the six";
    take(14);
    EXPECT_FALSE(claim());
    // Who had nothing queued meanwhile has saved up nothing.
    for (int i = 0; i < 5; ++i) submit(job(Priority::batch, "many"));
    for (int i = 0; i < 5; ++i) submit(job(Priority::batch, "late"));
    order.clear();
    take(10);
    EXPECT_EQ(std::count(order.begin(), order.begin() + 6, "many"), 3);
}

TEST_P(StoreTest, ABatchJobThatHasWaitedLongHasItsShare) {
    const std::string waiting = submit();
    int before = 0;
    for (int i = 0; i < 20; ++i) {  // always somebody interactive
        submit(job(Priority::interactive));
        submit(job(Priority::interactive));
        if (claim()->lease.job == waiting) break;
        ++before;
    }
    EXPECT_EQ(before, 20) << "not while it is young";
    store->shift_clock(11s);
    const std::string second = submit();
    for (before = 0; before < 20 && claim()->lease.job != waiting; ++before) submit(job(Priority::interactive));
    EXPECT_LE(before, 4);
    store->shift_clock(11s);
    std::vector<bool> batch;
    for (int i = 0; i < 10; ++i) {
        submit();
        submit(job(Priority::interactive));
        store->shift_clock(11s);
        batch.push_back(claim()->priority == Priority::batch);
    }
    EXPECT_EQ(std::count(batch.begin(), batch.end(), true), 2) << "one of five, not more";
}

// ---- idempotency, results that are there ----

TEST_P(StoreTest, AnIdempotencyKeyMakesOneJob) {
    NewJob first = job();
    first.idempotency = IdempotencyKey{"key", "body"};
    EXPECT_EQ(store->submit(first).outcome, Submitted::Outcome::created);
    NewJob again = job();
    again.idempotency = first.idempotency;
    const auto in_flight = store->submit(again);
    EXPECT_EQ(in_flight.outcome, Submitted::Outcome::in_flight);
    EXPECT_EQ(in_flight.id, first.id);
    store->finish(claim()->lease, kDone);
    const auto replayed = store->submit(again);
    EXPECT_EQ(replayed.outcome, Submitted::Outcome::replayed);
    EXPECT_EQ(replayed.id, first.id);
    EXPECT_FALSE(store->find(again.id));
    NewJob other = job();
    other.idempotency = IdempotencyKey{"key", "another body"};
    EXPECT_EQ(store->submit(other).outcome, Submitted::Outcome::other_body);
    NewJob neighbour = job(Priority::batch, "another tenant");
    neighbour.idempotency = first.idempotency;
    EXPECT_EQ(store->submit(neighbour).outcome, Submitted::Outcome::created);
    store->shift_clock(25h);
    EXPECT_EQ(store->submit(other).outcome, Submitted::Outcome::created);
}

TEST_P(StoreTest, ARaceForAKeyHasOneWinner) {
    const auto neighbour = another();
    std::atomic<int> created = 0;
    std::mutex guard;
    std::set<std::string> ids;
    {
        std::vector<std::jthread> racers;
        for (int i = 0; i < 8; ++i)
            racers.emplace_back([&, i] {
                NewJob made = job();
                made.idempotency = IdempotencyKey{"key", "body"};
                const auto submitted = (i % 2 == 0 ? *store : *neighbour).submit(made);
                if (submitted.outcome == Submitted::Outcome::created) ++created;
                const std::lock_guard lock(guard);
                ids.insert(submitted.id);
            });
    }
    EXPECT_EQ(created, 1);
    EXPECT_THAT(ids, SizeIs(1));
    EXPECT_EQ(store->counts().queued_batch, 1U);
}

TEST_P(StoreTest, AJobIsClaimedOnce) {
    constexpr std::size_t kJobs = 60;
    for (std::size_t i = 0; i < kJobs; ++i) submit();
    const auto neighbour = another();
    std::mutex guard;
    std::vector<std::string> claimed;
    {
        std::vector<std::jthread> racers;
        for (int i = 0; i < 6; ++i)
            racers.emplace_back([&, i] {
                JobStore& mine = i % 2 == 0 ? *store : *neighbour;
                while (const auto job = mine.claim("worker " + std::to_string(i), {})) {
                    EXPECT_TRUE(mine.finish(job->lease, {JobState::succeeded, job->lease.job, "", ""}));
                    const std::lock_guard lock(guard);
                    claimed.push_back(job->lease.job);
                }
            });
    }
    EXPECT_THAT(claimed, SizeIs(kJobs));
    EXPECT_THAT(std::set<std::string>(claimed.begin(), claimed.end()), SizeIs(kJobs));
    EXPECT_EQ(store->counts().succeeded, kJobs);
}

TEST_P(StoreTest, TheSameRequestIsAnsweredFromTheResultThatIsThere) {
    NewJob first = job();
    first.result_key = result_key({"dataset", "models"});
    first.reuse = true;
    EXPECT_EQ(store->submit(first).outcome, Submitted::Outcome::created);
    EXPECT_FALSE(store->find_result(first.result_key)) << "not before it is done";
    store->finish(claim()->lease, kDone);
    EXPECT_EQ(store->find_result(first.result_key), first.id);
    NewJob again = job();
    again.result_key = first.result_key;
    again.reuse = true;
    again.idempotency = IdempotencyKey{"key", "body"};
    const auto reused = store->submit(again);
    EXPECT_EQ(reused.outcome, Submitted::Outcome::reused);
    EXPECT_EQ(reused.id, first.id);
    EXPECT_EQ(store->submit(again).outcome, Submitted::Outcome::replayed);
    again.idempotency.reset();
    again.reuse = false;
    EXPECT_EQ(store->submit(again).outcome, Submitted::Outcome::created) << "who wants it computed anew";
    store->remove(first.id);
    EXPECT_FALSE(store->find_result(first.result_key));
    EXPECT_NE(result_key({"ab", "c"}), result_key({"a", "bc"}));
}

TEST_P(StoreTest, AFailureIsNoResultToReuse) {
    NewJob made = job();
    made.result_key = result_key({"x"});
    store->submit(made);
    store->finish(claim()->lease, {JobState::failed, "", "", "{}"});
    EXPECT_FALSE(store->find_result(made.result_key));
    EXPECT_EQ(store->find(made.id)->error, "{}");
}

// ---- events ----

TEST_P(StoreTest, EventsAreReplayedInOrderAndOldProgressIsLeftOut) {
    const Lease lease = begin();
    store->heartbeat(lease, 30s, R"({"fraction":0.1})");
    store->add_event(lease, EventKind::model_done, R"({"model":"ward"})");
    store->heartbeat(lease, 30s, R"({"fraction":0.5})");
    EXPECT_THAT(history(lease.job), ElementsAre("state queued", "state running", R"(model_done {"model":"ward"})",
                                                R"(progress {"fraction":0.5})"));
    EXPECT_EQ(store->find(lease.job)->progress, R"({"fraction":0.5})");
    store->heartbeat(lease, 30s, "");
    EXPECT_EQ(store->find(lease.job)->progress, R"({"fraction":0.5})");
    const auto seen = store->events(lease.job, 0).back().number;
    store->finish(lease, kDone);
    const auto rest = store->events(lease.job, seen);
    ASSERT_THAT(rest, SizeIs(1));
    EXPECT_EQ(rest[0].kind, EventKind::done);
    EXPECT_GT(rest[0].number, seen);
    EXPECT_EQ(store->find(lease.job)->last_event, rest[0].number);
    EXPECT_THAT(history(lease.job),
                ElementsAre("state queued", "state running", R"(model_done {"model":"ward"})", "done succeeded"));
    EXPECT_THAT(store->events(lease.job, 1, 1), SizeIs(1));
    EXPECT_THAT(store->events(lease.job, ~0ULL), IsEmpty());
}

TEST_P(StoreTest, WhoWaitsForAJobIsWoken) {
    const Lease lease = begin();
    Changes::Watch watch(store->changes(), lease.job);
    EXPECT_FALSE(watch.wait(1ms));
    std::jthread worker([&] {
        std::this_thread::sleep_for(20ms);
        store->finish(lease, kDone);
    });
    EXPECT_TRUE(watch.wait(10s));
    EXPECT_EQ(state(lease.job), JobState::succeeded);
    Changes::Watch late(store->changes(), lease.job);
    store->remove(lease.job);
    EXPECT_TRUE(late.wait(10s)) << "a change before the wait is not missed";
    EXPECT_FALSE(late.wait(1ms));
    store->changes().close();
    EXPECT_FALSE(late.wait(10s)) << "at once";
}

// ---- lists ----

TEST_P(StoreTest, PagesHoldStillWhileJobsComeAndGo) {
    std::vector<std::string> ids;
    for (int i = 0; i < 25; ++i) {
        ids.push_back(submit());
        std::this_thread::sleep_for(2ms);  // ids are ordered by time
    }
    std::vector<std::string> seen;
    PageRequest page{10, {}};
    while (true) {
        const auto found = store->list({}, page);
        for (const Job& job : found.items) seen.push_back(job.id);
        if (!found.next) break;
        page.cursor = found.next;
        submit();                                      // newer than what was seen
        store->remove(seen.front());                   // seen already
        if (seen.size() == 10) store->remove(ids[3]);  // to come, but gone then
    }
    std::vector<std::string> expected(ids.rbegin(), ids.rend());
    std::erase(expected, ids[3]);
    EXPECT_EQ(seen, expected);
}

TEST_P(StoreTest, ListsAreFiltered) {
    const auto dataset = store->put_dataset("data", "").id;
    NewJob with = job(Priority::batch, "a");
    with.dataset = dataset;
    store->submit(with);
    const std::string other = submit(job(Priority::batch, "b"));
    store->request_cancel(other);
    const auto ids = [&](const JobFilter& filter) {
        std::vector<std::string> found;
        for (const Job& job : store->list(filter, {}).items) found.push_back(job.id);
        return found;
    };
    EXPECT_THAT(ids({"a", {}, {}}), ElementsAre(with.id));
    EXPECT_THAT(ids({{}, JobState::cancelled, {}}), ElementsAre(other));
    EXPECT_THAT(ids({{}, {}, dataset}), ElementsAre(with.id));
    EXPECT_THAT(ids({"b", JobState::queued, {}}), IsEmpty());
    EXPECT_THAT(ids({}), SizeIs(2));
}

// ---- datasets ----

TEST_P(StoreTest, ADatasetIsNamedByItsContent) {
    const auto put = store->put_dataset("the bytes", "meta");
    EXPECT_TRUE(put.created);
    EXPECT_EQ(put.id, "ed589341c9fd5da96aaff4c5efa008226282a716186608d5a032ac75895a9c2f");
    EXPECT_FALSE(store->put_dataset("the bytes", "other meta").created);
    const auto found = store->find_dataset(put.id);
    EXPECT_EQ(found->body, "the bytes");
    EXPECT_EQ(found->info.meta, "meta");
    EXPECT_EQ(found->info.bytes, 9U);
    EXPECT_NE(store->put_dataset("other bytes", "").id, put.id);
    EXPECT_EQ(sha256(""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
}

TEST_P(StoreTest, ADatasetStaysWhileAJobNeedsIt) {
    const auto id = store->put_dataset("the bytes", "").id;
    NewJob made = job();
    made.dataset = id;
    store->submit(made);
    EXPECT_EQ(store->remove_dataset(id), JobStore::RemoveDataset::in_use);
    const auto claimed = claim();
    EXPECT_EQ(claimed->dataset, "the bytes");
    EXPECT_EQ(store->remove_dataset(id), JobStore::RemoveDataset::in_use);
    store->finish(claimed->lease, kDone);
    EXPECT_EQ(store->remove_dataset(id), JobStore::RemoveDataset::removed);
    EXPECT_EQ(store->remove_dataset(id), JobStore::RemoveDataset::unknown);
    EXPECT_EQ(store->find(made.id)->dataset, id) << "what it was fitted to is still told";
    NewJob late = job();
    late.dataset = id;
    EXPECT_EQ(store->submit(late).outcome, Submitted::Outcome::unknown_dataset);
    EXPECT_FALSE(store->find(late.id));
}

TEST_P(StoreTest, DatasetsAreListedNewestFirst) {
    std::vector<std::string> ids;
    for (int i = 0; i < 7; ++i) {
        ids.push_back(store->put_dataset("bytes " + std::to_string(i), "").id);
        if (i % 2 == 1) std::this_thread::sleep_for(2ms);  // some of the same age
    }
    std::vector<std::string> seen;
    PageRequest page{3, {}};
    do {
        const auto found = store->list_datasets(page);
        for (const DatasetInfo& info : found.items) seen.push_back(info.id);
        page.cursor = found.next;
    } while (page.cursor);
    EXPECT_EQ(seen.front(), ids.back());
    EXPECT_THAT(seen, testing::UnorderedElementsAreArray(ids));
    EXPECT_THROW((void)store->list_datasets({3, "no cursor"}), std::invalid_argument);
}

// ---- retention ----

TEST_P(StoreTest, WhatIsOldIsRemovedUnlessItIsNotDone) {
    const auto dataset = store->put_dataset("the bytes", "").id;
    NewJob old = job();
    old.dataset = dataset;
    store->submit(old);
    store->finish(claim()->lease, kDone);
    const std::string waiting = submit();
    store->shift_clock(24h * 29);
    store->prune({24h * 30, {}});
    EXPECT_TRUE(store->find(old.id));
    store->shift_clock(24h * 2);
    store->prune({24h * 30, {}});
    EXPECT_EQ(store->presence(old.id), Presence::removed);
    EXPECT_FALSE(store->find_dataset(dataset));
    EXPECT_TRUE(store->find(waiting));
}

TEST_P(StoreTest, TheOldestGoWhenTheStoreIsTooLarge) {
    std::vector<std::string> ids;
    for (int i = 0; i < 200; ++i) {
        ids.push_back(submit());
        store->finish(claim()->lease, {JobState::succeeded, std::string(50'000, 'x'), "", ""});
        store->shift_clock(1s);
    }
    const std::size_t before = store->counts().bytes;
    store->prune({{}, std::size_t{5} << 20});
    EXPECT_EQ(store->presence(ids.front()), Presence::removed);
    EXPECT_TRUE(store->find(ids.back()));
    store->tend();
    EXPECT_LT(store->counts().bytes, before) << "the disk has its room back";
    const std::size_t left = store->counts().succeeded;
    store->prune({{}, std::size_t{5} << 20});
    EXPECT_EQ(store->counts().succeeded, left) << "no more than needed";
}

TEST_P(StoreTest, CountsAreTrue) {
    submit();
    submit(job(Priority::interactive));
    submit(job(Priority::interactive));
    store->finish(claim()->lease, kDone);
    (void)claim();
    store->request_cancel(submit());
    store->shift_clock(5s);
    const Counts counts = store->counts();
    EXPECT_EQ(counts.queued_batch, 1U);
    EXPECT_EQ(counts.queued_interactive, 0U);
    EXPECT_EQ(counts.running, 1U);
    EXPECT_EQ(counts.succeeded, 1U);
    EXPECT_EQ(counts.cancelled, 1U);
    EXPECT_GE(counts.oldest_queued, 5s);
    EXPECT_GT(counts.bytes, 0U);
    store->probe();
}

// ---- processes that are killed ----

/// A process that does the work, and its reports, a line each.
class Child {
public:
    Child(const BackEnd& back_end, const fs::path& folder, const std::function<void(JobStore&, int)>& work) {
        int ends[2];
        if (::pipe(ends) != 0) throw std::runtime_error("no pipe");
        id_ = ::fork();
        if (id_ == 0) {
            ::close(ends[0]);
            try {
                const auto store = back_end.open(folder);
                work(*store, ends[1]);
            } catch (const std::exception&) {
                ::_exit(1);
            }
            ::_exit(0);
        }
        ::close(ends[1]);
        from_ = ends[0];
    }
    /// Waits until it has written something; false if it does not in ten seconds.
    [[nodiscard]] bool has_begun() const {
        pollfd descriptor{from_, POLLIN, 0};
        return ::poll(&descriptor, 1, 10'000) == 1;
    }
    /// Kills it; the lines it wrote.
    std::vector<std::string> kill() {
        ::kill(id_, SIGKILL);
        std::string text;
        char buffer[4096];
        for (ssize_t got = 0; (got = ::read(from_, buffer, sizeof buffer)) > 0;)
            text.append(buffer, static_cast<std::size_t>(got));
        ::close(from_);
        ::waitpid(id_, nullptr, 0);
        std::vector<std::string> lines;
        for (std::size_t end = 0; (end = text.find('\n')) != std::string::npos; text.erase(0, end + 1))
            lines.push_back(text.substr(0, end));
        return lines;
    }

private:
    pid_t id_ = 0;
    int from_ = -1;
};

void report(int to, const std::string& line) {
    const std::string text = line + "\n";
    if (::write(to, text.data(), text.size()) < 0) ::_exit(1);
}

TEST_P(StoreTest, ProcessesThatAreKilledLoseNothingAndDoNothingTwice) {
    store.reset();  // a connection must not cross a fork
    const auto push = [](JobStore& mine, int to) {
        while (true) {
            NewJob made;
            made.id = make_job_id();
            made.request = "request";
            mine.submit(made);
            mine.sync();
            report(to, made.id);
        }
    };
    const auto work = [](JobStore& mine, int to) {
        const std::string owner = make_job_id();
        while (true) {
            const auto claimed = mine.claim(owner, {50ms, true, true, false});
            if (!claimed) {
                mine.tend();
                std::this_thread::sleep_for(5ms);
                continue;
            }
            if (claimed->request != "request") ::_exit(2);
            if (mine.finish(claimed->lease, {JobState::succeeded, claimed->lease.job, "", ""}))
                report(to, claimed->lease.job);
        }
    };
    std::set<std::string> acknowledged;
    std::multiset<std::string> finished;
    std::mt19937 random(1);
    const int cycles = std::getenv("BRDFIT_LONG") != nullptr ? 200 : 10;
    for (int cycle = 0; cycle < cycles; ++cycle) {
        Child pusher(GetParam(), folder.path, push), first(GetParam(), folder.path, work),
            second(GetParam(), folder.path, work);
        ASSERT_TRUE(pusher.has_begun());
        if (cycle % 2 == 0) {
            ASSERT_TRUE(first.has_begun());
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(random() % 60));
        for (Child* child : {&first, &pusher, &second}) {
            for (const std::string& line : child->kill()) {
                if (child == &pusher) acknowledged.insert(line);
                else finished.insert(line);
            }
        }
    }
    ASSERT_FALSE(acknowledged.empty());
    ASSERT_FALSE(finished.empty());
    for (const std::string& id : finished) EXPECT_EQ(finished.count(id), 1U) << "finished twice";
    store = another();
    store->shift_clock(10s);
    store->tend();
    store->shift_clock(2min);
    while (const auto claimed = claim())
        store->finish(claimed->lease, {JobState::succeeded, claimed->lease.job, "", ""});
    for (const std::string& id : acknowledged) {
        const auto job = store->find(id);
        ASSERT_TRUE(job) << "an acknowledged job is lost";
        // Whoever was killed three times over it has given it up; that is told.
        if (job->state == JobState::failed) {
            EXPECT_THAT(job->error, HasSubstr("poison-job"));
        } else {
            EXPECT_EQ(store->result(id), id);
        }
    }
    for (const std::string& id : finished) EXPECT_EQ(store->result(id), id);
}

// ---- SQLite's alone ----

class SqliteStoreTest : public testing::Test {
protected:
    [[nodiscard]] std::unique_ptr<JobStore> open(std::optional<std::size_t> most_bytes = {}) const {
        return open_sqlite({path.string(), 5s, most_bytes});
    }
    /// Why it does not open.
    [[nodiscard]] std::string refusal(const std::string& file) const {
        try {
            (void)open_sqlite({file, 100ms, {}});
        } catch (const StoreError& error) {
            EXPECT_EQ(error.kind, StoreError::Kind::unusable);
            return error.what();
        }
        return "";
    }
    static NewJob job(std::size_t bytes = 10) {
        NewJob made;
        made.id = make_job_id();
        made.request = std::string(bytes, 'x');
        return made;
    }
    static std::string bytes_of(const fs::path& file) {
        std::ifstream in(file, std::ios::binary);
        return {std::istreambuf_iterator<char>(in), {}};
    }
    void write_file(const std::string& bytes) const { std::ofstream(path, std::ios::binary) << bytes; }

    Folder folder;
    fs::path path = folder.path / "below" / "jobs.db";
};

TEST_F(SqliteStoreTest, TheFileIsItsOwnersAlone) {
    const auto store = open();
    store->submit(job());
    for (const auto& entry : fs::directory_iterator(path.parent_path()))
        EXPECT_EQ(entry.status().permissions(), fs::perms::owner_read | fs::perms::owner_write) << entry.path();
}

TEST_F(SqliteStoreTest, ADamagedFileIsRefusedAndLeftAsItIs) {
    fs::create_directories(path.parent_path());
    write_file(std::string(10'000, '?'));
    EXPECT_THAT(refusal(path.string()), HasSubstr("not a database"));
    EXPECT_EQ(bytes_of(path), std::string(10'000, '?'));
    fs::remove(path);
    {
        const auto store = open();
        for (int i = 0; i < 50; ++i) store->submit(job(5000));
    }
    std::string bytes = bytes_of(path);
    ASSERT_GT(bytes.size(), 100'000U);
    for (std::size_t at = 20'000; at < 90'000; ++at) bytes[at] = '#';
    write_file(bytes);
    EXPECT_THAT(refusal(path.string()), HasSubstr("damaged"));
    EXPECT_EQ(bytes_of(path), bytes);
    write_file(bytes.substr(0, 50'000));
    EXPECT_NE(refusal(path.string()), "");
}

TEST_F(SqliteStoreTest, AnotherProgramsFileOrANewerOneIsRefused) {
    fs::create_directories(path.parent_path());
    {
        SQLite::Database other(path.string(), SQLite::OPEN_READWRITE | SQLite::OPEN_CREATE);
        other.exec("CREATE TABLE mine(x)");
    }
    EXPECT_THAT(refusal(path.string()), HasSubstr("another program's"));
    fs::remove(path);
    (void)open();
    {
        SQLite::Database newer(path.string(), SQLite::OPEN_READWRITE);
        newer.exec("PRAGMA user_version = 1000");
    }
    EXPECT_THAT(refusal(path.string()), HasSubstr("newer version"));
}

TEST_F(SqliteStoreTest, APlaceWhereNothingCanBeWrittenIsRefused) {
    EXPECT_THAT(refusal("/proc/nowhere/jobs.db"), HasSubstr("/proc/nowhere/jobs.db"));
    EXPECT_THAT(refusal(folder.path.string()), HasSubstr("directory"));
    std::ofstream(folder.path / "file") << "x";
    EXPECT_NE(refusal((folder.path / "file" / "jobs.db").string()), "");
    if (::geteuid() == 0) return;  // who may write to a folder that is read-only
    fs::create_directories(path.parent_path());
    fs::permissions(path.parent_path(), fs::perms::owner_read | fs::perms::owner_exec);
    EXPECT_THAT(refusal(path.string()), HasSubstr("ermission"));
    fs::permissions(path.parent_path(), fs::perms::owner_all);
}

TEST_F(SqliteStoreTest, AFullDiskRefusesWhatIsNewAndKeepsWhatIsThere) {
    const auto store = open();
    const NewJob first = job();
    store->submit(first);
    store->tend();
    // A limit for files stands for a full disk.
    rlimit limit{};
    ::getrlimit(RLIMIT_FSIZE, &limit);
    const rlimit tight{200'000, limit.rlim_max};
    const auto previous = std::signal(SIGXFSZ, SIG_IGN);
    ::setrlimit(RLIMIT_FSIZE, &tight);
    std::optional<StoreError::Kind> kind;
    const NewJob large = job(400'000);
    try {
        store->submit(large);
    } catch (const StoreError& error) {
        kind = error.kind;
    }
    const bool is_there = store->find(first.id).has_value();
    const bool is_not = !store->find(large.id).has_value();
    ::setrlimit(RLIMIT_FSIZE, &limit);
    std::signal(SIGXFSZ, previous);
    EXPECT_EQ(kind, StoreError::Kind::full);
    EXPECT_TRUE(is_there);
    EXPECT_TRUE(is_not);
    EXPECT_EQ(store->submit(large).outcome, Submitted::Outcome::created) << "as soon as there is room";
}

TEST_F(SqliteStoreTest, NothingIsTakenBeyondTheSizeAllowed) {
    const auto store = open(std::size_t{1} << 20);
    const auto fill = [&] {
        for (int i = 0; i < 100; ++i) store->submit(job(50'000));
    };
    EXPECT_THROW(fill(), StoreError);
    EXPECT_THROW(store->put_dataset("data", ""), StoreError);
    const auto claimed = store->claim("worker", {});
    EXPECT_TRUE(store->finish(claimed->lease, kDone)) << "what was taken is done";
}

TEST_F(SqliteStoreTest, ManyThatOpenANewFileAtOnceShareIt) {
    std::vector<std::jthread> openers;
    std::atomic<int> created = 0;
    for (int i = 0; i < 6; ++i)
        openers.emplace_back([&] {
            try {
                if (open()->submit(job()).outcome == Submitted::Outcome::created) ++created;
            } catch (const StoreError& error) {
                ADD_FAILURE() << error.what();
            }
        });
    openers.clear();
    EXPECT_EQ(created, 6);
    EXPECT_EQ(open()->counts().queued_batch, 6U);
}

TEST_F(SqliteStoreTest, ManyThatSyncShareAWrite) {
    const auto store = open();
    std::vector<std::jthread> threads;
    for (int i = 0; i < 8; ++i)
        threads.emplace_back([&] {
            for (int n = 0; n < 10; ++n) {
                store->submit(job());
                store->sync();
            }
        });
    threads.clear();
    EXPECT_EQ(store->counts().queued_batch, 80U);
}

}  // namespace
}  // namespace brdfit::server
