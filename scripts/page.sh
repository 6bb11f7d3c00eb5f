# What scripts that measure for a document share: they set $out, a folder, and $page, the document.
# shellcheck shell=bash disable=SC2034,SC2154

# put SECTION: standard input goes between the section's two comments.
put() {
    cat >"$out/page.part"
    awk -v part="$out/page.part" -v begin="<!-- $1: begin -->" -v end="<!-- $1: end -->" '
        $0 == end { inside = 0 }
        !inside
        $0 == begin { inside = 1; print ""; while ((getline line < part) > 0) print line; print "" }' \
        "$page" >"$out/page.md" && cp "$out/page.md" "$page"
}
# What else ran on the machine, before a part starts to measure.
load() { echo "The machine's load was $(cut -d' ' -f1 /proc/loadavg) before, on $(nproc) cores."; }
# as_table FILE FILTER: the rows that the filter makes of a JSON file, each an array of cells.
as_table() { jq -r "$shared $2"' | "| " + (map(tostring) | join(" | ")) + " |"' "$1"; }
readonly shared='
    def digits($n): . as $x | if $x == 0 then 0 else ($x | fabs | log10 | floor) as $e
        | pow(10; $n - 1 - $e) as $f | ($x * $f | round) / $f end;
    def ms: 1e3 * . | digits(3);
    def joined: map(tostring) | join(", ");'
