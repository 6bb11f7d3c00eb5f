#!/usr/bin/env bash
# Fits as jobs: taken, waited for, watched, cancelled, removed, found again.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server
file=$samples/white_plastic.csv
uuid='^[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}$'
unknown=01930c1e-7b5e-7c3a-9d2e-0a4c5f1b2d3e

# fit QUERY [curl option...]: posts the file; id is the answer's.
fit() {
    local query=$1
    shift
    post_csv "$query" "$file" "$@"
    id=$(jq -r '.id // empty' "$work/body" 2>/dev/null)
}
# post_slow SEED [curl option...]: a fit that takes long, asynchronously.
slow_query="models=he_torrance&effort=thorough&time_limit_s=300"
{ echo theta_i_deg,theta_r_deg,brdf_per_sr,channel
  awk 'BEGIN { for (c = 1; c <= 200; ++c) for (i = 10; i <= 70; i += 20) for (r = -80; r <= 80; r += 0.5)
      printf "%d,%g,%g,%d\n", i, r, 0.1 + exp(-((r - i) / (3 + c / 50))^2), c }'; } >"$work/slow.csv"
post_slow() {
    local seed=$1
    shift
    request POST "/v1/fits?$slow_query&seed=$seed" -H 'Content-Type: text/csv' --data-binary "@$work/slow.csv" \
        -H 'Prefer: respond-async' "$@"
    id=$(jq -r '.id // empty' "$work/body" 2>/dev/null)
}
# wait_for_state ID STATE...: at most 20 s.
wait_for_state() {
    local at=$1 end=$((SECONDS + 20)) state
    shift
    while ((SECONDS < end)); do
        state=$(curl -sS "$url/v1/fits/$at" | jq -r .state)
        [[ " $* " == *" $state "* ]] && return 0
        sleep 0.1
    done
    echo "is $state"
    return 1
}

# ---- at once, where that is quick ----
fit "models=lambert,ward&seed=7" -H 'Prefer: wait=30'
answered "a fit that is waited for" 200
check_equal "... says how long" "$(header Preference-Applied)" wait=30
check_equal "... is computed" "$(header Cache-Status)" "brdfit; fwd=miss; stored"
check_equal "... has a result of its own" "$(header Content-Location)" "/v1/fits/$id/result"
cp "$work/body" "$work/first"
first=$id
get "/v1/fits/$id/result"
answered "its result" 200
check "... has the same bytes" cmp -s "$work/first" "$work/body"
tag=$(header ETag)
check "... has a strong tag" grep -qE '^"[0-9a-f]{32}"$' <<<"$tag"
get "/v1/fits/$id/result" -H "If-None-Match: $tag"
answered "... is known by its tag" 304
check_equal "... then has no body" "$(wc -c <"$work/body")" 0
get "/v1/fits/$id/result" -H "If-None-Match: W/\"x\", W/$tag"
answered "... among others, weakly" 304
get "/v1/fits/$id/result" -H 'If-None-Match: "x"'
answered "... and not by another" 200
get "/v1/fits/$id/result" -H 'If-Match: "x"'
refused "... If-Match" 412
get "/v1/fits/$id/result" -H "If-Match: $tag"
answered "... If-Match, its own" 200
get "/v1/fits/$id/result" -H 'If-Unmodified-Since: Mon, 01 Jan 2001 00:00:00 GMT'
answered "... If-Unmodified-Since is for what changes" 200
get "/v1/fits/$id/result" -H 'Accept: text/csv'
answered "its result as CSV" 200
check_equal "... its type" "$(header Content-Type)" "text/csv; charset=utf-8; header=present"
check_equal "... its rows: one a parameter" "$(wc -l <"$work/body")" 5
check_equal "... its header" "$(head -n 1 "$work/body" | tr -d '\r')" \
    channel,wavelength_nm,rank,model,lobes,loss,relative_loss,rmse,log10_rmse,parameter,value,std_error,unit,at_bound
check_equal "... its first parameter" "$(sed -n 2p "$work/body" | cut -d , -f 11 | jq .)" \
    "$(jq '.channels[0].fits[0].parameters | to_entries[0].value.value' "$work/first")"
get "/v1/fits/$id/result" -H 'Accept: application/xml'
refused "its result as XML" 406
get "/v1/fits/$id"
answered "its state" 200
holds "... says that it is done" '.state == "succeeded" and .done and .attempt == 1 and .id == $id
    and (.created <= .started) and (.started <= .ended) and .links.result == "/v1/fits/\($id)/result"' --arg id "$id"
for kind in brdf residual summary; do
    get "/v1/fits/$id/plots/$kind.svg"
    answered "$kind.svg" 200
    check_equal "$kind.svg: its policy" "$(header Content-Security-Policy)" "default-src 'none'; style-src 'unsafe-inline'"
    check_equal "$kind.svg: nosniff" "$(header X-Content-Type-Options)" nosniff
    get "/v1/fits/$id/plots/$kind.svg" -H "If-None-Match: $(header ETag)"
    answered "$kind.svg is known by its tag" 304
done
get "/v1/fits/$id/plots/brdf.svg?models=phong"
refused "a plot of a model that was not fitted" 422 '.pointer == "/models"'
get "/v1/fits/$id/plots/brdf.svg?width=1"
refused "a plot too narrow" 422 '.pointer == "/width"'
get "/v1/fits/$id/plots/brdf.svg?theta_i=15,x"
refused "a plot of no angle" 422 '.pointer == "/theta_i"'

# ---- the same again ----
fit "models=lambert,ward&seed=7"
check_equal "the same request is answered from what is kept" "$(header Cache-Status)" "brdfit; hit"
check "... with the same bytes" cmp -s "$work/first" "$work/body"
fit "seed=7&models=lambert,ward"
check_equal "... also in another order" "$(header Cache-Status)" "brdfit; hit"
fit "models=lambert,ward&seed=8"
check_equal "... not for another seed" "$(header Cache-Status)" "brdfit; fwd=miss; stored"
fit "models=lambert,ward&seed=7" -H 'Cache-Control: no-cache'
check_equal "... not where that is not wanted" "$(header Cache-Status)" "brdfit; fwd=request; stored"
check "... which is another fit" test "$id" != "$first"
normalised "$work/first" >"$work/plain"
normalised "$work/body" >"$work/again"
check "... of the same numbers" cmp -s "$work/plain" "$work/again"

# ---- Idempotency-Key ----
fit "models=lambert" -H 'Idempotency-Key: a-1' -H 'Cache-Control: no-cache'
answered "a key" 200
check_equal "... is not a replay" "$(header Idempotency-Replayed)" ""
once=$id
fit "models=lambert" -H 'Idempotency-Key: a-1' -H 'Cache-Control: no-cache'
answered "the key again" 200
check_equal "... is a replay" "$(header Idempotency-Replayed)" true
check_equal "... of the same fit" "$id" "$once"
fit "models=phong" -H 'Idempotency-Key: a-1'
refused "the key with another request" 422
holds "... says so" '.type == "/problems/key-reused"'
for key in '' 'a b' "$(printf 'x%.0s' {1..256})" $'\xc3\xa4'; do
    fit "models=lambert" -H "Idempotency-Key;" -H "Idempotency-Key: $key"
    [[ -z $key ]] || refused "the key \"${key:0:10}\"" 400
done

# ---- later ----
fit "models=lambert&seed=99" -H 'Prefer: respond-async'
answered "a fit that is not waited for" 202
holds "... has a state" '.state | IN("queued", "running", "succeeded")'
check_equal "... has a place" "$(header Location)" "/v1/fits/$id"
check_equal "... is to be asked for later" "$(header Retry-After)" 1
check_equal "... as preferred" "$(header Preference-Applied)" respond-async
check "... under an id" grep -qE "$uuid" <<<"$id"
get "/v1/fits/$id" -H 'Prefer: wait=30'
holds "a long poll sees the end" '.state == "succeeded" and .done'
check_equal "... says how long" "$(header Preference-Applied)" wait=30
for prefer in wait=x wait= wait=-1 wait=1.5; do
    fit models=lambert -H "Prefer: $prefer"
    refused "Prefer: $prefer" 400
done
fit models=lambert -H 'Prefer: handling=strict, wait=5;x=y, wait=6'
check_equal "other preferences are passed over" "$(header Preference-Applied)" wait=5
fit models=lambert -H 'Prefer: wait=99999999999999'
check_equal "a long wait is cut" "$(header Preference-Applied)" wait=60

# ---- one that takes long ----
post_slow 1 -H 'Idempotency-Key: slow'
answered "a long fit" 202
slow=$id
check "... runs" wait_for_state "$slow" running
get "/v1/fits/$slow/result"
refused "... has no result yet" 409
check_equal "... says when to ask again" "$(header Retry-After)" 1
get "/v1/fits/$slow/plots/brdf.svg"
refused "... nor a plot" 409
post_slow 1 -H 'Idempotency-Key: slow'
refused "... its key is in flight" 409
holds "... says so" '.type == "/problems/in-flight"'
started=$EPOCHREALTIME
get "/v1/fits/$slow" -H 'Prefer: wait=1'
holds "a long poll ends" '.done | not'
check "... after its time" awk -v a="$started" -v b="$EPOCHREALTIME" 'BEGIN { exit !(b - a > 0.9 && b - a < 5) }'
request POST "/v1/fits?$slow_query&seed=1" -H 'Content-Type: text/csv' --data-binary "@$work/slow.csv" -H 'Prefer: wait=1'
answered "a fit that takes longer than one waits" 202
check_equal "... as preferred" "$(header Preference-Applied)" wait=1
second=$(jq -r .id "$work/body")
get "/v1/fits?state=running"
holds "the list has what runs" 'any(.items[]; .id == $id)' --arg id "$slow"
get "/v1/fits?state=cancelled"
holds "... and not where it is not" 'all(.items[]; .id != $id)' --arg id "$slow"
request POST "/v1/fits/$slow/cancel" -H 'If-Match: "x"'
refused "cancelled in another state" 412
curl -sSN -m 30 "$url/v1/fits/$slow/events" >"$work/events" &
listener=$!
sleep 0.3
request POST "/v1/fits/$slow/cancel"
check "cancelled" test "$status" = 202 -o "$status" = 200
check "... it stops" wait_for_state "$slow" cancelled
request POST "/v1/fits/$slow/cancel"
answered "... again" 200
holds "... is as it was" '.state == "cancelled"'
get "/v1/fits/$slow/result"
refused "... has no result" 409
holds "... says so" '.type == "/problems/no-result"'
wait_for_end $listener 10 || { fail "the events end"; kill $listener; }
check_equal "the last event" "$(grep '^event: ' "$work/events" | tail -n 1)" "event: done"
check "... tells the state" grep -q '"state":"cancelled"' <<<"$(grep '^data: ' "$work/events" | tail -n 1)"

# ---- removed ----
request DELETE "/v1/fits/$second"
answered "a fit is removed as it runs" 204
check_equal "... without a word" "$(wc -c <"$work/body")" 0
for path in "" /result /plots/brdf.svg /events; do
    get "/v1/fits/$second$path"
    refused "... its $path is gone" 410
done
request DELETE "/v1/fits/$second"
refused "... again" 410
request POST "/v1/fits/$second/cancel"
refused "... cancelled" 410
for path in "" /result /plots/brdf.svg /events; do
    get "/v1/fits/$unknown$path"
    refused "a fit that never was: $path" 404
done
request DELETE "/v1/fits/$unknown"
refused "... removed" 404
request DELETE "/v1/fits/$first" -H 'If-Match: "x"'
refused "removed in another state" 412
request DELETE "/v1/fits/$first" -H 'If-Unmodified-Since: Mon, 01 Jan 2001 00:00:00 GMT'
refused "removed if unmodified for long" 412
request DELETE "/v1/fits/$first" -H 'If-Match: *'
answered "removed in any state" 204
fit "models=lambert,ward&seed=7"
check "what was removed answers no more" test "$id" != "$first"

# ---- events ----
fit "models=lambert,phong&seed=5"
curl -sSN -m 20 -D "$work/headers" "$url/v1/fits/$id/events" >"$work/events"
check_equal "events: their type" "$(header Content-Type)" text/event-stream
check_equal "events: the last is done" "$(grep '^event: ' "$work/events" | tail -n 1)" "event: done"
check "events: their numbers rise" sort -nuc <<<"$(sed -n 's/^id: //p' "$work/events")"
check "events: their data are JSON" jq -es 'all(.at)' <<<"$(sed -n 's/^data: //p' "$work/events")"
last=$(sed -n 's/^id: //p' "$work/events" | tail -n 1)
before=$(sed -n 's/^id: //p' "$work/events" | tail -n 2 | head -n 1)
curl -sSN -m 20 -H "Last-Event-ID: $before" "$url/v1/fits/$id/events" >"$work/events"
check_equal "events: what was missed comes again" "$(sed -n 's/^id: //p' "$work/events")" "$last"
get "/v1/fits/$id/events" -H "Last-Event-ID: $last"
answered "events: none are left" 204
get "/v1/fits/$id/events" -H 'Last-Event-ID: x'
refused "events: after what is none" 400
get "/v1/fits/$id/events" -H 'Accept: application/json'
refused "events: as JSON" 406

# ---- pages ----
get "/v1/fits?limit=2"
holds "a page" '(.items | length) == 2 and (.next_cursor | type) == "string"'
link=$(header Link)
check "... has a link to the next" grep -qE '^</v1/fits\?.*>; rel="next"$' <<<"$link"
seen=$(jq -r '.items[].id' "$work/body")
pages=1
while [[ $link =~ ^\<(.*)\>\;\ rel=\"next\"$ ]] && ((pages < 30)); do
    get "${BASH_REMATCH[1]}"
    seen+=$'\n'$(jq -r '.items[].id' "$work/body")
    link=$(header Link)
    pages=$((pages + 1))
done
check_equal "the pages together are the list" "$(sort <<<"$seen")" "$(curl -sS "$url/v1/fits?limit=1000" | jq -r '.items[].id' | sort)"
check "... newest first" test "$(sort -r <<<"$seen")" = "$seen"
for query in limit=0 limit=1001 limit=1.5 limit=x state=done nonsense=1 'limit=1&limit=2'; do
    get "/v1/fits?$query"
    refused "a list with $query" 422
done
get '/v1/fits?cursor=%27%20or%201'
refused "a cursor that is none" 400
finish
