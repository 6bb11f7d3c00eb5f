#!/usr/bin/env bash
# Requests a second of a server of its own, over 16 kept connections: probes and stored results. Needs wrk.
# usage: scripts/http-load.sh [SECONDS]; the best of five runs of so many seconds (3) each.
set -u
export LC_ALL=C.UTF-8
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
. scripts/setup.sh
work=$(mktemp -d)
build/brdfit serve --port 0 >"$work/log" 2>&1 </dev/null &
server=$!
trap 'stop_server "$server"; rm -rf "$work"' EXIT
url=$(wait_for_server "$server" "$work/log" 300) || die "the server did not start"
id=$(curl -sS -H 'Content-Type: text/csv' --data-binary @samples/white_plastic.csv "$url/v1/fits" | jq -r .id)
best() {
    local _ best=0 now
    for _ in 1 2 3 4 5; do
        now=$(wrk -t 1 -c 16 -d "${2-3}s" "$url$1" | awk '/^Requests\/sec/ { print int($2) } /Non-2xx/ { print 0; exit }' | tail -n 1)
        ((now > best)) && best=$now
    done
    printf '%s %d requests/s\n' "$1" "$best"
}
best /health/live "$@"
best "/v1/fits/$id/result" "$@"
printf '%d kB of memory\n' "$(awk '/^VmRSS/ { print $2 }' "/proc/$server/status")"
