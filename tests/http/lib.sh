# What the curl tests share: a server of their own on a free port, and checks that name themselves when they fail.
# A test sources this, starts a server, checks, and ends with finish. BRDFIT names the program to test.
# shellcheck shell=bash
set -u
export LC_ALL=C
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
BRDFIT=${BRDFIT:-$repository/build/brdfit}
samples=$repository/samples
work=$(mktemp -d)
export XDG_DATA_HOME=$work/data # where a store is unless a test says otherwise
servers=()
passed=0
failed=0
trap stop_servers EXIT

# Ends every server that is left; one that does not heed SIGTERM within 5 s is killed.
stop_servers() {
    local pid
    ((${#servers[@]} == 0)) || kill "${servers[@]}" 2>/dev/null
    for pid in "${servers[@]+"${servers[@]}"}"; do
        wait_for_end "$pid" 5 || kill -KILL "$pid" 2>/dev/null
    done
    rm -rf "$work"
}

pass() { passed=$((passed + 1)); }

# fail NAME [what was found]
fail() {
    failed=$((failed + 1))
    printf 'FAILED: %s\n' "$1"
    [[ -z ${2-} ]] || printf '        %.600s\n' "$2"
    return 1
}

# check NAME COMMAND...: passes if the command does.
check() {
    local name=$1 output
    shift
    if output=$("$@" 2>&1); then pass; else fail "$name" "$output"; fi
}

# check_equal NAME ACTUAL EXPECTED
check_equal() {
    if [[ $2 == "$3" ]]; then pass; else fail "$1" "is \"$2\", not \"$3\""; fi
}

finish() {
    printf '%d passed, %d failed\n' "$passed" "$failed"
    exit $((failed > 0))
}

# start_server [option...]: sets url, server (its process), store and log; false if it ends or does not answer in five minutes,
# which a busy machine may need that has not yet compiled the kernels.
start_server() {
    log=$work/server.${#servers[@]}.log
    store=${store_of_all:-$work/store.${#servers[@]}.db} # its own, unless a test says otherwise
    : >"$log"
    "$BRDFIT" serve --store "$store" --port 0 "$@" >"$log" 2>&1 &
    server=$!
    servers+=("$server")
    local end=$((SECONDS + 300))
    while ((SECONDS < end)); do
        url=$(sed -n 's|.* listens on \(http://127\.0\.0\.1:[0-9]*\).*|\1|p' "$log")
        [[ -z $url ]] || return 0
        kill -0 "$server" 2>/dev/null || break
        sleep 0.05
    done
    return 1
}

# The server most tests need.
require_server() {
    start_server "$@" || { fail "the server starts" "$(tail -n 5 "$log")"; finish; }
}

# until_true SECONDS COMMAND...
until_true() {
    local end=$((SECONDS + $1))
    shift
    until "$@"; do
        ((SECONDS < end)) || return 1
        sleep 0.05
    done
}

# wait_for_end PID SECONDS: sets status to its exit status; false if it is still there then.
wait_for_end() {
    local end=$((SECONDS + $2))
    while kill -0 "$1" 2>/dev/null; do
        ((SECONDS < end)) || return 1
        sleep 0.05
    done
    wait "$1" 2>/dev/null # it may have been waited for
    status=$?
}

# request METHOD PATH [curl option...]: sets status; the answer is in $work/body, its headers in $work/headers.
request() {
    local method=(-X "$1") path=$2
    [[ $1 != HEAD ]] || method=(--head)
    shift 2
    : >"$work/body"
    : >"$work/headers"
    status=$(curl -sS -m 60 "${method[@]}" -o "$work/body" -D "$work/headers" -w '%{http_code}' "$@" "$url$path" \
        2>"$work/curl")
}
get() { request GET "$@"; }

# What a test does not say otherwise: this machine may be slow.
patient='Prefer: wait=60'
# post_json PATH_QUERY BODY [curl option...], the body from standard input where it is "-".
post_json() {
    local path=$1 body=$2
    shift 2
    [[ $* == *Prefer:* ]] || set -- "$@" -H "$patient"
    if [[ $body == - ]]; then cat >"$work/posted"; else printf '%s' "$body" >"$work/posted"; fi
    request POST "$path" -H 'Content-Type: application/json' --data-binary "@$work/posted" "$@"
}
# post_csv QUERY FILE [curl option...]
post_csv() {
    local query=$1 file=$2
    shift 2
    [[ $* == *Prefer:* ]] || set -- "$@" -H "$patient"
    request POST "/v1/fits${query:+?$query}" -H 'Content-Type: text/csv' --data-binary "@$file" "$@"
}

# The value of a header of the last answer.
header() {
    local name value
    shopt -s nocasematch
    while IFS=': ' read -r name value; do [[ $name == "$1" ]] && printf '%s' "${value%$'\r'}" && break; done <"$work/headers"
    shopt -u nocasematch
}

# answered NAME STATUS: checks the last answer's.
answered() { if [[ $status == "$2" ]]; then pass; else fail "$1" "status $status, not $2: $(head -c 400 "$work/body")"; fi; }

# holds NAME FILTER [jq option...]: the last answer's body makes the filter true.
holds() {
    local name=$1 filter=$2
    shift 2
    if jq -e "$@" "$filter" "$work/body" >/dev/null 2>"$work/jq"; then pass
    else fail "$name" "not so: $filter $(head -c 200 "$work/jq") in $(head -c 400 "$work/body")"; fi
}

# refused NAME STATUS [FILTER]: the last answer is a problem of that status in the form of RFC 9457, and one of its
# errors (. in the filter) is as the filter says.
refused() {
    answered "$1" "$2" || return
    [[ $(header Content-Type) == application/problem+json ]] || { fail "$1" "is $(header Content-Type)"; return; }
    holds "$1" '
        (.type | startswith("/problems/")) and (.title | length > 0) and .status == $status and (.detail | test("^[^:]"))
        and (.instance | type == "string") and .request_id == $id
        and ((.errors // []) | length <= 50 and all(.code and .detail and (.pointer | type == "string")))
        and any(.errors[]?, (if has("errors") then empty else {} end); '"${3-true}"')' \
        --argjson status "$2" --arg id "$(header X-Request-Id)"
}

# An answer without what differs from run to run: ids and times.
normalised() {
    jq -S 'def plain: sub("/v1/fits/[^/]*"; "");
           del(.id, .links) | del(.channels[] | (.fits[] | .search.time_s, .cost), .pareto, .recommended) | .channels[].fits[].links.plot |= plain' "$1"
}
