#!/usr/bin/env bash
# How long somebody waits for a fit while a batch of 1000 thorough fits is queued, beside an idle server: medians and 99th percentiles
# of so many fits (200), each with a seed of its own. A server of its own; fails if the batch has ended before.
# usage: scripts/interactive-latency.sh [FITS]
set -u -o pipefail
export LC_ALL=C.UTF-8
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
. scripts/setup.sh
fits=${1-200}
work=$(mktemp -d)
"${BRDFIT-build/brdfit}" serve --port 0 --store "$work/fits.db" >"$work/log" 2>&1 </dev/null &
server=$!
trap 'stop_server "$server"; rm -rf "$work"' EXIT
url=$(wait_for_server "$server" "$work/log" 300) || die "the server did not start"
curl -fsS -o /dev/null "$url/health/ready" || die "the server is not ready"

# post SEED [curl option...]
post() {
    local seed=$1
    shift
    curl -fsS -H 'Content-Type: text/csv' --data-binary @samples/white_plastic.csv "$@" \
        "$url/v1/fits?models=phong,ward,lafortune,he_torrance&seed=$seed" || die "a fit was refused"
}
# waits FIRST: seconds of each fit, in rising order.
waits() {
    local seed
    for ((seed = $1; seed < $1 + fits; ++seed)); do post "$seed" -o /dev/null -w '%{time_total}\n'; done | sort -g
}
told() { awk -v name="$1" '{ t[NR] = $1 } END { printf "%s: median %.1f ms, 99 %% %.1f ms\n", name, 1e3 * t[int((NR + 1) / 2)], 1e3 * t[int(NR * 0.99 + 0.5)] }' "$2"; }
queued() { curl -fsS "$url/metrics" | awk '/^brdfit_jobs.*state="queued"/ { n += $2 } END { print n + 0 }'; }

waits 1000 >"$work/warm" || exit 1 # programs, costs and caches
waits 2000 >"$work/idle" || exit 1
for ((seed = 10000; seed < 11000; ++seed)); do post "$seed&effort=thorough" -o /dev/null -H 'Prefer: respond-async'; done
before=$(queued)
waits 3000 >"$work/beside" || exit 1
after=$(queued)
told "idle" "$work/idle"
told "beside a batch" "$work/beside"
printf 'queued before: %d, after: %d\n' "$before" "$after"
((after > 0)) || die "the batch has ended: ask for fewer fits"
