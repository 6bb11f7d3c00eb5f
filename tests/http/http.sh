#!/usr/bin/env bash
# HTTP itself: methods, types, lengths, headers, connections.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
request_id=0-a_B.9
file=$samples/white_plastic.csv
json='Content-Type: application/json'

# ---- what is not there, or not for this ----
for path in /nothing /v1/nothing /v1/fits/x/plots /v1/models/ward/x /v1/ /v2/fits //v1/models /v1/fits/../models; do
    get "$path" --path-as-is
    refused "GET $path" 404
done
for path in /v1/fits/01930c1e-7b5e-7c3a-9d2e-0a4c5f1b2d3e{,/result,/plots/brdf.svg}; do
    get "$path"
    refused "GET $path" 404
done
for method in DELETE PUT PATCH OPTIONS; do
    request $method /v1/fits -H "$json" --data-binary '{}'
    refused "$method /v1/fits" 405
    check_equal "$method /v1/fits: what is allowed" "$(header Allow)" "POST, GET, HEAD"
done
for path in /v1/models /health/live; do
    for method in POST PUT DELETE; do
        request $method $path -H "$json" --data-binary '{}'
        refused "$method $path" 405
        check_equal "$method $path: what is allowed" "$(header Allow)" "GET, HEAD"
    done
done

# ---- types ----
for type in application/x-www-form-urlencoded 'multipart/form-data; boundary=x' text/plain application/jsonx ''; do
    request POST /v1/fits -H "Content-Type: $type" --data-binary "@$file"
    refused "type \"$type\"" 415
    check_equal "type \"$type\": what is accepted" "$(header Accept-Post)" "application/json, text/csv"
done
request POST /v1/fits --data-urlencode "x@$file"
refused "curl -d, as people write it" 415
request POST /v1/fits -F "file=@$file"
refused "curl -F, as people write it" 415
request POST /v1/fits -H "$json" -H 'Content-Encoding: gzip' --data-binary '{}'
refused "a compressed body" 415

# ---- lengths ----
trap '' PIPE  # the server may close first
# raw TEXT...: sends each text as it stands ("\r\n" and so on), a while apart, on one connection, and prints what comes
# back until the server closes it, at most 8 s.
raw() {
    local text
    exec 3<>"/dev/tcp/127.0.0.1/${url##*:}"
    for text; do
        printf '%b' "$text" >&3 2>/dev/null
        sleep 0.2
    done
    timeout 8 cat <&3 2>/dev/null | tr -d '\r'
    exec 3>&-
}
answers() { grep -ac '^HTTP/1\.1 '; }
post='POST /v1/fits HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n'
hidden='GET /health/live HTTP/1.1\r\nHost: hidden\r\n\r\n'
# unread NAME STATUS HEADER: refused at once, and the body that nobody read is not taken for the next request.
unread() {
    raw "$post$3\r\n" "$hidden" >"$work/raw"
    check_equal "$1" "$(head -n 1 "$work/raw" | cut -d ' ' -f 2)" "$2"
    check_equal "$1: one answer" "$(answers <"$work/raw")" 1
}
unread "no length" 411 ''
unread "a length of more than 32 MiB" 413 'Content-Length: 33554433\r\n'
unread "a length that is no size" 413 'Content-Length: 99999999999999999999999\r\n'
unread "a length that is no number" 400 'Content-Length: 44x\r\n'
unread "a compressed body" 415 'Content-Encoding: gzip\r\nContent-Length: 44\r\n'
check "three requests at once: as many answers, or one and no more" \
    grep -qx '[13]' <<<"$(raw "$hidden$hidden${hidden/Host/Connection: close\\r\\nHost}" | answers)"
head -c 33000000 /dev/zero | tr '\0' ' ' >"$work/white"
request POST /v1/fits -H "$json" --data-binary "@$work/white"
refused "33 MB of white space are read" 400 '.code == "syntax"'
head -c 33600000 /dev/zero >"$work/large"
request POST /v1/fits -H "$json" --data-binary "@$work/large"
refused "a body of more than 32 MiB" 413
request POST /v1/fits -H "$json" -H 'Transfer-Encoding: chunked' --data-binary "@$work/large"
refused "... in chunks" 413
request POST "/v1/fits?models=lambert" -H 'Content-Type: text/csv' -H 'Transfer-Encoding: chunked' --data-binary "@$file"
answered "a body in chunks" 200
get "/$(printf 'x%.0s' {1..20000})"
refused "a path of 20,000 bytes" 414

# ---- headers ----
get /v1/models -H "X-Request-Id: $request_id"
check_equal "X-Request-Id is echoed" "$(header X-Request-Id)" "$request_id"
get /nothing -H "X-Request-Id: $request_id"
holds "... in a problem as well" '.request_id == $id and .instance == "/nothing"' --arg id "$request_id"
for id in 'a b' 'a/b' "$(printf 'x%.0s' {1..65})" 'ä' '<script>' ''; do
    get /health/live -H "X-Request-Id: $id"
    check "X-Request-Id \"$id\" is replaced" grep -qE '^[0-9a-f-]{36}$' <<<"$(header X-Request-Id)"
done
get /v1/models
check_equal "nosniff" "$(header X-Content-Type-Options)" nosniff
length=$(header Content-Length)
request HEAD /v1/models
answered "HEAD" 200
check_equal "HEAD: the length that GET has" "$(header Content-Length)" "$length"
check_equal "HEAD: no body" "$(raw 'HEAD /v1/models HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n' | sed '1,/^$/d' | wc -c)" 0
get /v1/models -H 'Range: bytes=0-5'
answered "Range" 200
check_equal "Range: passed over" "$(wc -c <"$work/body")" "$length"
request HEAD /v1/evaluate
answered "HEAD of what is only posted to" 405
check "the log tells requests by their ids" grep -q "GET /nothing 404 request $request_id" "$log"
get '/a%0d%0aSet-Cookie:%20x=1%ff'
refused "control characters in a path" 404
check "... do not reach the log" test "$(grep -c '^Set-Cookie' "$log")" = 0
check "... nor the headers" test -z "$(header Set-Cookie)"
check "nothing of the machine in a problem" test -z "$(grep -F "$repository" "$work/body")"

# ---- 20 at once ----
mkdir "$work/many"
pids=()
for i in {1..20}; do
    curl -sS -m 60 -o "$work/many/$i" -H 'Content-Type: text/csv' -H 'Cache-Control: no-cache' --data-binary "@$file" \
        "$url/v1/fits?models=lambert,phong,ward,lafortune" &
    pids+=($!)
done
get /health/live
answered "health while 20 requests are fitted" 200
wait "${pids[@]}"
for i in {1..20}; do normalised "$work/many/$i" >"$work/many/$i.plain" || break; done 2>/dev/null
check "20 requests at once all succeed" test "$(cat "$work"/many/*.plain | grep -c '"model": "ward"')" = 20
check_equal "... and agree" "$(sha256sum "$work"/many/*.plain | cut -d ' ' -f 1 | sort -u | wc -l)" 1
check_equal "... under ids of their own" "$(jq -r .id "$work"/many/? "$work"/many/?? | sort -u | wc -l)" 20
finish
