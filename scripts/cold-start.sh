#!/usr/bin/env bash
# How long a server takes from its start to the answer of a first fit over HTTP, with empty and with filled caches.
# Usage: scripts/cold-start.sh [REPETITIONS [SERVE-OPTION...]]. BRDFIT names the program (build/brdfit).
set -u
export LC_ALL=C
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
program=${BRDFIT:-build/brdfit}
repetitions=${1:-5}
shift
work=$(mktemp -d)
server=
trap '[[ -z $server ]] || kill "$server" 2>/dev/null; rm -rf "$work"' EXIT

# start_once: prints seconds to the line "listens", to the first fit's answer, and of processor time, of all processes.
start_once() {
    local begin=$EPOCHREALTIME listens answered url='' status
    "$program" serve --port 0 --store "$work/brdfit.db" "$@" >"$work/log" 2>&1 &
    server=$!
    until [[ $url ]]; do
        kill -0 "$server" 2>/dev/null || { cat "$work/log" >&2; exit 1; }
        sleep 0.005
        url=$(sed -n 's|.* listens on \(http://[^, ]*\).*|\1|p' "$work/log")
    done
    listens=$EPOCHREALTIME
    status=$(curl -sS -m 60 -o "$work/answer" -w '%{http_code}' -H 'Content-Type: text/csv' \
        --data-binary @samples/white_plastic.csv "$url/v1/fits?models=ward")
    answered=$EPOCHREALTIME
    [[ $status == 200 ]] || { cat "$work/answer" >&2; exit 1; }
    # utime, stime and those of the children that have ended, in ticks of 10 ms
    awk -v b="$begin" -v l="$listens" -v a="$answered" '{ sub(/.*\) /, "")
        print l - b, a - b, ($12 + $13 + $14 + $15) / 100 }' "/proc/$server/stat"
    kill "$server"
    wait "$server"
    server=
}

# The medians of the columns of standard input.
medians() {
    local rows column
    rows=$(cat)
    for column in 1 2 3; do
        awk -v c=$column '{ print $c }' <<<"$rows" | sort -g | awk '{ v[NR] = $1 } END { printf " %8.2f", v[int((NR + 1) / 2)] }'
    done
    echo
}

# case NAME EMPTIED...: starts again and again, with these folders emptied before each start.
measure() {
    local name=$1
    shift
    printf '%-34s' "$name"
    for ((i = 0; i < repetitions; ++i)); do
        for folder; do rm -rf "${work:?}/$folder"; done
        start_once "${options[@]}"
    done | medians
}

options=("$@")
export XDG_CACHE_HOME=$work/cache TMPDIR=$work
unset POCL_CACHE_DIR
printf '%-34s %8s %8s %8s\n' "medians of $repetitions, seconds" listens answered cpu
measure "no cache" cache
measure "warm"
