#!/usr/bin/env bash
# Starting with compiled kernels on disk, without, with damaged ones, and where nothing can be written.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
export XDG_CACHE_HOME=$work/cache TMPDIR=$work/tmp
unset POCL_CACHE_DIR
kept=$XDG_CACHE_HOME/brdfit
mkdir "$TMPDIR"
file=$samples/white_plastic.csv
# Of seven variants in two precisions, for samples and for the hemisphere, and one for searches; of a simpler form one
# for samples, one for searches, and two for the hemisphere.
programs=33
costs=16 # measured, of as many

# stop: ends the last server; sets status.
stop() {
    kill -TERM "$server"
    status=none
    wait_for_end "$server" 20
}
# fit_answer FILE [QUERY]: a fit of two models; the answer without what differs from run to run.
fit_answer() {
    post_csv "models=ward,lambert${2+&$2}" "$file"
    answered "$1: a fit" 200
    normalised "$work/body" >"$work/$1.json"
}
same_answer() { check "$1: the answer is that of the first start" cmp "$work/$1.json" "$work/empty.json"; }
# Names, sizes and inodes: an entry that is written anew is another file. Costs, which are small, may be measured again.
entries() { find . -name '*.bin' -size +1k -print0; }
listing() { (cd "$kept" && entries | xargs -0 stat -c '%n %s %i' | sort); }
checksums() { (cd "$kept" && entries | xargs -0 sha256sum | sort); }

# ---- an empty cache; PoCL's own is unusable ----
POCL_CACHE_DIR=/proc/nowhere start_server || { fail "a start with an empty cache" "$(cat "$log")"; finish; }
# While the other precision is built and tested: fits, and one that has to wait for that precision.
waiting=()
for i in {1..6}; do
    precision=double
    ((i > 1)) || precision=single
    curl -sS -m 120 -o "$work/early.$i" -w '%{http_code}\n' -H 'Content-Type: text/csv' -H "$patient" \
        --data-binary "@$file" "$url/v1/fits?models=ward,phong,he_torrance&precision=$precision" >>"$work/early" &
    waiting+=($!)
done
fit_answer empty
wait "${waiting[@]}"
get /health/ready
answered "ready" 200
[[ $(jq '.selftest.precisions | length' "$work/body") == 2 ]] || programs=18 costs=8
if ((programs == 33)); then
    check_equal "fits as soon as it listens, in either precision" "$(sort "$work/early" | uniq -c | xargs)" "6 200"
    check_equal "... in the precision asked for" "$(jq -r .device.precision "$work/early.1")" single
fi
are_measured() { get /v1/models/he_torrance && jq -e '.costs | length == 2' "$work/body"; }
check "costs are measured" until_true 60 are_measured
check_equal "a file a program and a cost" "$(find "$kept" -name '*.bin' | wc -l)" $((programs + costs))
check_equal "and nothing else" "$(find "$kept" -mindepth 1 -not -name '*.bin' | wc -l)" 0
check_equal "for this user alone" "$(stat -c %a "$kept" "$kept"/* | sort -u | xargs)" "600 700"
stop
check_equal "it stops" "$status" 0
check_equal "its temporary files are gone" "$(ls "$TMPDIR")" ""
listing >"$work/listing"
checksums >"$work/checksums"

# ---- a filled cache ----
require_server
fit_answer warm
same_answer warm
get /health/ready
answered "warm: ready" 200
check "nothing is built that is there" cmp <(listing) "$work/listing"
kill -KILL "$server"
wait "$server" 2>/dev/null
check "a server that is killed leaves its temporary files" test -n "$(ls "$TMPDIR")"

# ---- damaged entries ----
mapfile -t entries < <(find "$kept" -name '*.bin' | sort)
: >"${entries[0]}"
truncate -s 1000 "${entries[1]}"
head -c 100000 /dev/urandom >"${entries[2]}"
printf 'x' | dd of="${entries[3]}" bs=1 seek=5000 conv=notrunc status=none
cp "${entries[4]}" "${entries[5]}"
chmod 666 "${entries[6]}"
require_server
fit_answer damaged
same_answer damaged
get /health/ready
answered "damaged: ready" 200
check "damaged: all is there again" until_true 60 are_measured
check_equal "no line is logged about it" "$(grep -vc -e listens -e request "$log")" 0
stop
check_equal "what a killed server left is gone" "$(ls "$TMPDIR")" ""
check_equal "each is replaced" "$(find "$kept" -name '*.bin' -perm 600 -size +50k | wc -l)" $programs
listing >"$work/listing"

# ---- a cache that cannot be used, each with the command that builds the least ----
# fits NAME [option...]: brdfit fit finds what the server does.
fits() {
    local name=$1
    shift
    "$BRDFIT" fit "$file" models=ward,lambert --json "$@" >"$work/body" 2>"$work/error"
    check_equal "$name: status" $? 0
    check_equal "$name: says nothing" "$(cat "$work/error")" ""
    check_equal "$name: the answer" "$(jq -S '.channels[].fits | map(del(.links, .search.time_s, .cost))' "$work/body")" \
        "$(jq -S '.channels[].fits | map(del(.links, .search.time_s, .cost))' "$work/empty.json")"
}
: >"$work/file"
fits "a cache that is a file" --cache "$work/file"
fits "... and below one" --cache "$work/file/below"
(unset HOME XDG_CACHE_HOME && cd "$work" && exec "$BRDFIT" fit "$file" models=lambert >/dev/null 2>"$work/error")
check_equal "no HOME" $? 0
check_equal "no HOME: says nothing" "$(cat "$work/error")" ""
fits "--no-cache" --no-cache
fits "--cache" --cache "$work/here"
# Of two models: for samples, for the hemisphere in both precisions, and what those cost.
check_equal "--cache is where they are kept" "$(find "$work/here" -name '*.bin' | wc -l)" 10
check "the other cache is as it was" cmp <(listing) "$work/listing"
"$BRDFIT" fit "$file" --cache "$work/here" --no-cache >/dev/null 2>&1
check_equal "--cache and --no-cache" $? 108
chmod 500 "$work/here"
if [[ -w $work/here ]]; then echo "skipped: root may write to a read-only folder"
else fits "a read-only cache" models=ward,lambert --cache "$work/here"
fi
chmod 700 "$work/here"

# ---- nothing at all can be written: a limit for files stands for a full disk ----
(ulimit -f 50 && exec "$BRDFIT" fit "$file" models=lambert --no-cache >/dev/null 2>"$work/error")
check_equal "a full disk: the command fails, it does not crash" $? 1
check "a full disk: says so" grep -q 'the OpenCL compiler ended with status .*too large' "$work/error"
export BRDFIT_WITHOUT_ROOM=$BRDFIT
cat >"$work/without_room" <<'SCRIPT'
#!/bin/sh
ulimit -f 600 && exec "$BRDFIT_WITHOUT_ROOM" "$@"
SCRIPT
chmod +x "$work/without_room"
# Room enough for an empty store alone.
BRDFIT=$work/without_room
start_server || { fail "a server on a full disk starts" "$(cat "$log")"; finish; }
get /health/live
answered "a server on a full disk lives" 200
get /health/ready
answered "... and is not ready" 503
holds "... as there is no room" 'all(.selftest.precisions[]; (.passed | not) and (.reason | contains("cannot be computed")))'
check "... which it logs" grep -q 'no room for the OpenCL driver' "$log"
finish
