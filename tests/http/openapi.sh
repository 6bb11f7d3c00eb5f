#!/usr/bin/env bash
# The published contract: valid, and true of every operation.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
# Debian's python, which has python3-jsonschema.
/usr/bin/python3 "$(dirname "${BASH_SOURCE[0]}")/openapi.py" "$url" >"$work/openapi" 2>&1
tail -n 1 "$work/openapi" | grep -qE '^[0-9]+ passed, [0-9]+ failed$' || fail "the driver ends" "$(tail -n 5 "$work/openapi")"
sed '$d' "$work/openapi"
read -r good _ bad _ < <(tail -n 1 "$work/openapi")
passed=$((passed + ${good:-0}))
failed=$((failed + ${bad:-1}))

# ---- pages ----
get /docs -H 'Accept: text/html'
answered "/docs" 200
check_equal "/docs: its type" "$(header Content-Type)" "text/html; charset=utf-8"
check "/docs: nothing from outside, no script" \
    test "$(grep -cE '<script|<link|<img|<iframe|src=|https?://' "$work/body")" = 0
check "/docs: a strict policy" grep -q "^default-src 'none'" <<<"$(header Content-Security-Policy)"
for path in $(curl -sS "$url/openapi.json" | jq -r '.paths | keys[]'); do
    check "/docs tells of $path" grep -qF " $path</code>" "$work/body"
done
get / -H 'Accept: text/html,application/xhtml+xml;q=0.9,*/*;q=0.8'
check_equal "/ for a browser" "$(header Content-Type)" "text/html; charset=utf-8"
check "/ shows a command for this server" grep -qF "$url/v1/fits" "$work/body"
check "/: a strict policy" grep -q "^default-src 'none'" <<<"$(header Content-Security-Policy)"
get / -H 'Host: "><script>alert(1)</script>'
get / -H 'Accept: text/html' -H 'Host: "><script>'
check "/ repeats no markup" test "$(grep -c '<script>' "$work/body")" = 0
get /
check_equal "/ for curl" "$(header Content-Type)" application/json
for link in $(jq -r '.links[]' "$work/body"); do
    request OPTIONS "$link"
    check "the link $link leads somewhere" test "$status" = 405
done
get / -H 'Accept: image/png'
refused "/ as a picture" 406
get / -H 'Accept: text/html;q=0, */*'
check_equal "/ for who wants no page" "$(header Content-Type)" application/json
finish
