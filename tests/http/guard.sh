#!/usr/bin/env bash
# Connections as attackers and careless clients make them: framing, sizes, slowness, numbers.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server --max-body 32MB
count() {
    tee "$work/counted" | grep -v ' passed, '
    read -r good _ bad _ <<<"$(tail -n 1 "$work/counted")"
    passed=$((passed + ${good:-0}))
    failed=$((failed + ${bad:-1}))
}
count < <(timeout 240 python3 "$repository/tests/http/guard.py" "${url##*:}" "$server")
check_equal "the server lives" "$(kill -0 "$server" && echo yes)" yes

# ---- a server with few file descriptors ----
cat >"$work/few_files" <<SCRIPT
#!/bin/sh
ulimit -n 96 && exec "$BRDFIT" "\$@"
SCRIPT
chmod +x "$work/few_files"
BRDFIT=$work/few_files start_server --max-body 2KB || { fail "a server with 96 descriptors starts" "$(cat "$log")"; finish; }
count < <(timeout 60 python3 "$repository/tests/http/guard.py" "${url##*:}" "$server" few_files)
head -c 2049 /dev/zero >"$work/large"
request POST /v1/evaluate -H 'Content-Type: application/json' --data-binary "@$work/large"
refused "--max-body" 413 
get /v1
holds "... is told" '.limits.body_bytes == 2048 or .limits.max_body_bytes == 2048 or ([.limits[]?] | index(2048) != null)'

# ---- API keys ----
key=0123456789abcdef0123456789abcdef
printf '# of the lab\nlab:%s\n\nother:%s\n' "$(printf %s $key | sha256sum | cut -c -64)" "$(printf %s x$key | sha256sum | cut -c -64)" >"$work/keys"
chmod 600 "$work/keys"
start_server --api-keys "$work/keys" --log-format json --rate 50 || { fail "a server with keys starts" "$(cat "$log")"; finish; }
bearer="Authorization: Bearer"
get /health/live
answered "health needs no key" 200
for header in 'X: y' "$bearer" "$bearer wrong" "$bearer ${key}0" "Authorization: Basic $key" "Authorization: $key"; do
    get /v1/models -H "$header"
    refused "a request with \"$header\"" 401
    check_equal "\"$header\": what is asked for" "$(header WWW-Authenticate)" Bearer
done
get /metrics
refused "metrics need a key" 401
request POST /v1/fits -H 'Content-Type: text/csv' -H 'Expect:' --data-binary "@$samples/white_plastic.csv"
refused "a fit without a key" 401
get /v1/models -H "$bearer $key"
answered "a request with a key" 200
get /v1/models -H "$bearer x$key"
answered "... with another" 200
get /v1/models -H "authorization: bearer $key"
answered "... in small letters" 200
get /metrics -H "$bearer $key"
answered "metrics" 200
check "metrics: refusals are counted" grep -q '^brdfit_http_requests_total{.*status="401".*} [0-9]' "$work/body"
tail -n 1 "$log" >"$work/body"
holds "a line of the log" '.message == "request" and .method == "GET" and .path == "/metrics" and .status == 200
    and .tenant == "lab" and .remote == "127.0.0.1" and .bytes > 1000 and .ms >= 0 and (.request_id | length == 36)
    and (.time | test("^20[0-9-]*T[0-9:.]*Z$"))'
check "every line of the log is JSON" jq -es 'all(.level and .time)' <(grep -v ' listens on ' "$log")
check "no key is logged" test -z "$(grep "$key" "$log")"
for _ in {1..150}; do printf 'url = "%s/v1"\noutput = /dev/null\n' "$url"; done >"$work/burst"
curl -sS -m 60 -K "$work/burst" -H "$bearer $key" -D "$work/headers" -w '%{http_code}\n' >"$work/statuses" 2>/dev/null
check "--rate: who is refused is told when to come again" grep -qi '^Retry-After: [0-9]' "$work/headers"
check "--rate: more than its burst of 100 is refused" grep -q 429 "$work/statuses"
check "--rate: the burst is served" test "$(grep -c 200 "$work/statuses")" -ge 90
get /v1 -H "$bearer x$key"
answered "--rate: another client is served" 200
ended() {
    local name=$1 text=$2
    shift 2
    timeout 60 "$BRDFIT" serve --port 0 "$@" >"$work/ended" 2>&1
    check_equal "$name: status" $? 1
    check "$name: says so" grep -q -- "$text" "$work/ended"
}
ended "no key file" 'cannot be read' --api-keys "$work/nowhere"
ended "a folder of keys" 'cannot be read' --api-keys "$work"
chmod 620 "$work/keys"
ended "keys that others may write" 'may write' --api-keys "$work/keys"
echo 'lab:123' >"$work/bad" && chmod 600 "$work/bad"
ended "a line that is no key" 'bad:1 is not' --api-keys "$work/bad"
: >"$work/none" && chmod 600 "$work/none"
ended "no key in the file" 'holds no key' --api-keys "$work/none"
ended "an address that others reach" 'without --api-keys' --host 0.0.0.0
ended "a name that begins like one of this machine" 'without --api-keys' --host 127.example.com
chmod 644 "$work/keys"
start_server --api-keys "$work/keys" || { fail "a server with readable keys starts" "$(cat "$log")"; finish; }
check "keys that everyone may read: a warning" grep -q 'everyone may read' "$log"
finish
