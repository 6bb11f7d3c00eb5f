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

# ---- a worker is killed in mid-fit ----
require_server
check "two workers compute" until_true 60 workers_are 2
check "the service itself uses no OpenCL" test -z "$(grep -aE 'pocl|libOpenCL.*nvidia' "/proc/$server/maps")"
# Seconds of work.
awk -F, '/^[0-9]/ { for (c = 0; c < 12; ++c) rows[c] = rows[c] $1 "," $2 "," $4 * (1 + c / 50) ",c" c "\n" }
    END { print "theta_i_deg,theta_r_deg,brdf_per_sr,channel"; for (c = 0; c < 12; ++c) printf "%s", rows[c] }' \
    "$file" >"$work/many.csv"
long=(effort=thorough "$work/many.csv")
fit long "${long[@]}"
check "a fit is under way" until_true 20 running
before=$(workers)
kill -KILL "$(sql 'SELECT owner FROM job WHERE state = 1' | xargs -I OWNER pgrep -P "$server" -f 'OWNER')"
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

# ---- a worker that stands still in mid-fit ----
if [[ -n ${BRDFIT_LONG-} ]]; then
    require_server
    check "two workers compute" until_true 60 workers_are 2
    awk -F, '/^[0-9]/ { for (c = 0; c < 200; ++c) rows[c] = rows[c] $1 "," $2 "," $4 * (1 + c / 50) ",c" c "\n" }
        END { print "theta_i_deg,theta_r_deg,brdf_per_sr,channel"; for (c = 0; c < 200; ++c) printf "%s", rows[c] }' \
        "$file" >"$work/very_many.csv"
    fit still effort=thorough "$work/very_many.csv"
    check "a fit is under way" until_true 20 running
    kill -STOP "$(sql 'SELECT owner FROM job WHERE state = 1' | xargs -I OWNER pgrep -P "$server" -f 'OWNER')"
    wait "${fits[-1]}"
    check_equal "a worker that stands still loses its fit when the lease ends" "$(cat "$work/still.status")" 200
    check_equal "... to a second attempt" "$(sql 'SELECT max(attempt) FROM job')" 2
    check "... and is killed" grep -q 'does not answer: it is killed' "$log"
fi

# ---- killed again and again, workers and servers, under a burst of fits ----
ids=$work/acknowledged
: >"$ids"
declare -A sums=()
RANDOM=1
for ((cycle = 0; cycle < cycles; ++cycle)); do
    fits=()
    for i in 1 2 3 4 5 6; do fit "burst.$i" "models=ward,phong&seed=$((cycle * 10 + i))"; done
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
check_equal "none ends twice" "$(sql 'SELECT count(*) FROM (SELECT 1 FROM event WHERE kind = 3 GROUP BY job HAVING count(*) > 1)')" 0
check_equal "what has no result was given up after three attempts" \
    "$(sql 'SELECT count(*) FROM job LEFT JOIN result ON job.id = result.job WHERE body IS NULL AND attempt < 3')" 0
check "the service is ready again" until_true 60 ready

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
