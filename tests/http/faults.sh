#!/usr/bin/env bash
# What goes wrong beside us: processes that are killed or stand still, disks that are full, stores that are damaged.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
file=$samples/white_plastic.csv
cycles=10
[[ -z ${BRDFIT_LONG-} ]] || cycles=200

workers() { pgrep -P "$server" | xargs; }
# sql QUERY: of the store of the last server.
sql() { sqlite3 -cmd '.timeout 5000' "file:$store?mode=ro" "$1"; }
anew='Cache-Control: no-cache' # a stored result would need no worker
# fit NAME [QUERY]: a fit in the background; its answer goes to $work/NAME, its status to $work/NAME.status.
fit() {
    curl -sS -m 120 -o "$work/$1" -w '%{http_code}' -H 'Content-Type: text/csv' -H "$patient" -H "$anew" \
        --data-binary "@${3-$file}" "$url/v1/fits?${2-models=ward,lambert}" >"$work/$1.status" 2>/dev/null &
    fits+=($!)
}
fits=()
running() { [[ $(sql "SELECT count(*) FROM job WHERE state = 1") -ge ${1-1} ]]; }
all_ended() { [[ $(sql "SELECT count(*) FROM job WHERE ended IS NULL") == 0 ]]; }
ready() { get /health/ready && [[ $status == 200 ]]; }
are_gone() { [[ -z $(ps -o pid= -p "${1// /,}") ]]; }
workers_are() { [[ $(workers | wc -w) == "$1" ]]; }

# of_owner: the process that computes the job under way.
of_owner() { sql 'SELECT owner FROM job WHERE state = 1' | xargs -I OWNER pgrep -P "$server" -f 'OWNER'; }
# Seconds of work.
awk -F, '/^[0-9]/ { for (c = 0; c < 12; ++c) rows[c] = rows[c] $1 "," $2 "," $4 * (1 + c / 50) ",c" c "\n" }
    END { print "theta_i_deg,theta_r_deg,brdf_per_sr,channel"; for (c = 0; c < 12; ++c) printf "%s", rows[c] }' \
    "$file" >"$work/many.csv"
long=(effort=thorough "$work/many.csv")

# ---- a worker that stands still in mid-fit: what becomes of it is seen below, half a minute later ----
require_server
check "two workers compute" until_true 60 workers_are 2
fit still 'effort=thorough&models=he_torrance' "$work/many.csv"
check "a fit is under way" until_true 20 running
kill -STOP "$(of_owner)"
still=(url="$url" server="$server" store="$store" log="$log")
still_fit=${fits[-1]}
fits=()
post_csv models=ward "$file"
answered "a worker stands still: the other fits" 200

# ---- a worker is killed in mid-fit ----
require_server
check "two workers compute" until_true 60 workers_are 2
check "the service itself uses no OpenCL" test -z "$(grep -aE 'pocl|libOpenCL.*nvidia' "/proc/$server/maps")"
fit long "${long[@]}"
check "a fit is under way" until_true 20 running
before=$(workers)
kill -KILL "$(of_owner)"
get /health/live
answered "a worker is killed: the service lives" 200
post_csv models=ward "$file" -H "$anew"
answered "... and fits" 200
wait "${fits[@]}"
check_equal "... and its fit is answered all the same" "$(cat "$work/long.status")" 200
check "... with every model" jq -e '.state == "succeeded" and all(.channels[]; .fits | length == 5)' "$work/long"
id=$(jq -r .id "$work/long")
check_equal "... by a second attempt" "$(sql "SELECT attempt FROM job WHERE id = '$id'")" 2
check_equal "... with one effect" "$(sql "SELECT count(*) FROM event WHERE job = '$id' AND kind = 3")" 1
check "another worker is started in its place" until_true 30 workers_are 2
check "... not the same" test "$before" != "$(workers)"
check "... which is logged" grep -q 'ended with signal 9' "$log"

# ---- all of them at once ----
kill -KILL $(workers)
post_json /v1/evaluate '{"model":"lambert","parameters":{"k_d":0.5},"geometry":{"theta_i_deg":[30],"theta_r_deg":[31]}}'
answered "all workers are killed: an evaluation waits for the next" 200
post_csv models=ward "$file" -H "$anew"
answered "... and so does a fit" 200
# metric NAME: the metric's value, labels being part of the name.
metric() { curl -sS "$url/metrics" | awk -v name="$1" '$1 == name { print $2 }'; }
check "metrics: workers that have ended" test "$(metric brdfit_workers_ended_total)" -ge 3
check "... are followed by others" until_true 30 eval '[[ $(metric brdfit_workers_ready) == 2 ]]'
check_equal "... succeeded fits" "$(metric 'brdfit_jobs{state="succeeded"}')" "$(sql 'SELECT count(*) FROM job WHERE state = 3')"
check_equal "... queued ones" "$(metric 'brdfit_jobs{priority="batch",state="queued"}')" 0

# ---- an end in mid-fit ----
fit last "${long[@]}"
check "a fit is under way" until_true 20 running
first_store=$store
kill -TERM "$server"
status=none
wait_for_end "$server" 20
check_equal "SIGTERM in mid-fit" "$status" 0
wait "${fits[@]}"
check "... which is answered: with its result, that it goes on later, or that the service stops" \
    grep -qE '^(200|202|503)$' "$work/last.status"
check_equal "no lease is left" "$(sql "SELECT count(*) FROM job WHERE state IN (1, 2)")" 0
check_equal "no attempt counts" "$(sql "SELECT count(*) FROM job WHERE state = 0 AND attempt > 0")" 0
store_of_all=$first_store
require_server
check "the next server goes on with it" until_true 60 all_ended
check_equal "... to its result" "$(sql "SELECT count(*) FROM job LEFT JOIN result ON job.id = result.job WHERE body IS NULL")" 0
get "/v1/fits/$id/result"
answered "results outlast the server" 200
check "... byte for byte" cmp "$work/body" "$work/long"
get "/v1/fits/$id/plots/brdf.svg"
answered "... and so do plots" 200

# ---- two servers on one store, and a worker of its own ----
first=$server
first_url=$url
require_server
post_csv models=ward "$file" -H "$anew"
answered "two servers on one store: the second fits" 200
cp "$work/body" "$work/answer"
url=$first_url
get "/v1/fits/$(jq -r .id "$work/answer")/result"
answered "... and the first has the result" 200
check "... the same" cmp "$work/body" "$work/answer"
kill -TERM "$server" "$first"
wait_for_end "$server" 20
wait_for_end "$first" 20
require_server --workers 1
only=$(workers)
kill -STOP "$only"
fit stranger models=ward
"$BRDFIT" worker --store "$store" >"$work/worker.log" 2>&1 &
stranger=$!
servers+=("$stranger")
wait "${fits[@]}"
check_equal "a worker that was started by hand computes for a server whose own stands still" \
    "$(cat "$work/stranger.status")" 200
kill -TERM "$stranger"
status=none
wait_for_end "$stranger" 20
check_equal "... and heeds SIGTERM" "$status" 0
kill -CONT "$only"

# ---- a worker that stands still within a transaction ----
if [[ -n ${BRDFIT_LONG-} ]]; then
    require_server --workers 1
    check "a worker computes" until_true 60 workers_are 1
    only=$(workers)
    fit held "${long[@]}"
    check "a fit is under way" until_true 20 running
    is_held() { sqlite3 "$store" 'BEGIN IMMEDIATE; ROLLBACK' 2>&1 | grep -q locked; }
    held=false
    for ((i = 0; i < 3000 && SECONDS < 200; ++i)); do
        kill -STOP "$only" || break
        is_held && held=true && break
        kill -CONT "$only"
        sleep "0.00$((RANDOM % 10))"
    done
    if $held; then
        start=$EPOCHREALTIME
        get /health/live
        answered "a worker stands still and keeps others from writing: the service lives" 200
        is_free() { ! is_held; }
        check "... and takes fits again" until_true 25 is_free
        check "... within 15 s" awk -v a="$start" -v b="$EPOCHREALTIME" 'BEGIN { exit !(b - a < 15) }'
        check "... as it is killed" grep -q 'stands still and keeps others from writing: it is killed' "$log"
    else echo "skipped: no moment within a transaction was met"
    fi
    wait "${fits[-1]}"
fi

# ---- no file descriptors are left ----
# limit PROCESS...: they have as many as they use.
limit() { for process; do prlimit --pid "$process" --nofile="$(find "/proc/$process/fd" -mindepth 1 | wc -l):"; done; }
require_server --workers 1
only=$(workers)
limit "$only"
# Programs that it has not loaded yet.
for query in 'models=he_torrance&precision=single' 'models=lafortune&loss=l2'; do
    post_csv "$query" "$file" -H "$anew"
    answered "a worker without file descriptors: $query" 200
done
limit "$server"
kill -KILL $(workers)
for path in /health/live /v1/models; do
    get $path
    check "a server without file descriptors, whose worker has ended, says so: $path" grep -qE '^(200|503)$' <<<"$status"
done
post_csv models=ward "$file" -H 'Prefer: respond-async' -H "$anew"
check "... takes a fit, or says that it cannot" grep -qE '^(202|503)$' <<<"$status"
prlimit --pid "$server" --nofile=512:
check "when it has some again it computes" until_true 60 ready
post_csv models=ward "$file" -H "$anew"
answered "... and fits" 200

# ---- killed again and again, workers and servers, under a burst of fits ----
# take NAME QUERY: posts a fit that nobody waits for; its answer goes to $work/NAME, its status to $work/NAME.status.
take() {
    curl -sS -m 60 -o "$work/$1" -w '%{http_code}' -H 'Content-Type: text/csv' -H 'Prefer: respond-async' -H "$anew" \
        --data-binary "@$file" "$url/v1/fits?$2" >"$work/$1.status" 2>/dev/null &
    fits+=($!)
}
ids=$work/acknowledged
: >"$ids"
declare -A sums=()
taken=()
RANDOM=1
for ((cycle = 0; cycle < cycles; ++cycle)); do
    fits=()
    for i in 1 2 3 4 5 6; do
        fit "burst.$i" "models=ward,phong&seed=$((cycle * 10 + i))"
        take "later.$i" "models=ward,phong&seed=$((100000 + cycle * 10 + i))"
    done
    sleep "0.0$((RANDOM % 10))"
    if ((cycle % 4 == 3)); then
        old=$(workers)
        kill -KILL "$server"
        wait "$server" 2>/dev/null
        wait "${fits[@]}"
        check "cycle $cycle: workers end with their server" until_true 10 are_gone "$old"
        require_server
    else
        kill -KILL $(workers) 2>/dev/null
        wait "${fits[@]}"
    fi
    for i in 1 2 3 4 5 6; do
        [[ $(cat "$work/later.$i.status") != 202 ]] || taken+=("$(jq -r .id "$work/later.$i")")
        [[ $(cat "$work/burst.$i.status") == 200 ]] || continue
        acknowledged=$(jq -r .id "$work/burst.$i")
        echo "$acknowledged" >>"$ids"
        sums[$acknowledged]=$(sha256sum <"$work/burst.$i")
    done
done
check "some were acknowledged" test -s "$ids"
check "all that was taken ends" until_true 120 all_ended
lost=0
for acknowledged in "${!sums[@]}"; do
    get "/v1/fits/$acknowledged/result"
    [[ $status == 200 && $(sha256sum <"$work/body") == "${sums[$acknowledged]}" ]] || lost=$((lost + 1))
done
check_equal "no acknowledged fit is lost, of ${#sums[@]}" "$lost" 0
lost=0
given_up=0
for id in "${taken[@]}"; do
    get "/v1/fits/$id"
    if jq -e '.state == "succeeded"' "$work/body" >/dev/null; then
        get "/v1/fits/$id/result"
        [[ $status == 200 && $(jq -r .id "$work/body") == "$id" ]] || lost=$((lost + 1))
    elif jq -e '.state == "failed" and (.error.type == "/problems/poison-job")' "$work/body" >/dev/null; then given_up=$((given_up + 1))
    else lost=$((lost + 1))
    fi
done
check "some were taken for later" test ${#taken[@]} -ge $cycles
check_equal "none of them is lost, of ${#taken[@]}, $given_up of them given up after three attempts" "$lost" 0
check "at most a tenth of them is given up" test $((10 * given_up)) -le ${#taken[@]}
check_equal "none ends twice" "$(sql 'SELECT count(*) FROM (SELECT 1 FROM event WHERE kind = 3 GROUP BY job HAVING count(*) > 1)')" 0
check_equal "what has no result was given up after three attempts" \
    "$(sql 'SELECT count(*) FROM job LEFT JOIN result ON job.id = result.job WHERE body IS NULL AND attempt < 3')" 0
check "the service is ready again" until_true 60 ready

# ---- what became of the worker that stood still ----
declare "${still[@]}"
wait "$still_fit"
check "a worker that stands still loses its fit when the lease ends" grep -qE '^20[02]$' "$work/still.status" # 202: a busy machine
id=$(jq -r .id "$work/still")
succeeded() { get "/v1/fits/$id" && [[ $(jq -r .state "$work/body") == succeeded ]]; }
check "... and it succeeds" until_true 60 succeeded
check_equal "... to a second attempt" "$(sql "SELECT attempt FROM job WHERE id = '$id'")" 2
check_equal "... with one effect" "$(sql "SELECT count(*) FROM event WHERE job = '$id' AND kind = 3")" 1
check "... and is killed" grep -q 'does not answer: it is killed' "$log"
check "... and another takes its place" until_true 30 workers_are 2

# ---- a store that cannot be used ----
unset store_of_all
# refused NAME TEXT FILE: a server does not start on that store, and leaves it as it is.
refused_store() {
    local before
    before=$(sha256sum "$3" 2>&1)
    timeout 60 "$BRDFIT" serve --port 0 --store "$3" >"$work/ended" 2>&1
    check_equal "$1: status" $? 1
    check "$1: says so" grep -q -- "$2" "$work/ended"
    check_equal "$1: it is left as it is" "$(sha256sum "$3" 2>&1)" "$before"
}
head -c 100000 /dev/urandom >"$work/damaged.db"
refused_store "a store that is none" 'damaged.db cannot be used: file is not a database' "$work/damaged.db"
refused_store "a folder where nothing can be written" 'nowhere/brdfit.db cannot be used' /proc/nowhere/brdfit.db

# ---- a full disk: a limit for files stands for it ----
export BRDFIT_WITHOUT_ROOM=$BRDFIT
cat >"$work/without_room" <<'SCRIPT'
#!/bin/sh
ulimit -f 8000 && exec "$BRDFIT_WITHOUT_ROOM" "$@"
SCRIPT
chmod +x "$work/without_room"
BRDFIT=$work/without_room
require_server
{
    cat "$file"
    for ((i = 0; i < 60000; ++i)); do echo "# a remark that takes room: one of many, all of them are kept, $i"; done
} >"$work/large.csv"
for i in 1 2; do
    post_csv models=ward "$work/large.csv" -H "$anew"
    [[ $status == 200 ]] || break
done
refused "a full disk: what needs room is refused" 503 'true'
get /health/live
answered "... and the service lives" 200
finish
