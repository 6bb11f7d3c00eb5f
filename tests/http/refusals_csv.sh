#!/usr/bin/env bash
# CSV requests that are refused: each with the line and the field of the mistake.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
require_server

# mistake NAME LINE FIELD CODE TEXT [QUERY]: the text ("\n" between its lines) is refused with that error.
mistake() {
    printf '%b' "$5" >"$work/bad.csv"
    post_csv "${6-models=lambert}" "$work/bad.csv"
    refused "$1" 422 ".pointer == \"\" and .line == $2 and .column == $3 and .code == \"$4\""
}
head='theta_i_deg,theta_r_deg,brdf_per_sr'
good="$head\n15,-30,0.1\n15,0,0.1\n15,30,0.2\n15,60,0.1\n"
printf '%b' "$good" >"$work/good.csv"
post_csv models=lambert "$work/good.csv"
answered "the file that the mistakes are made in" 200 || finish

# ---- header ----
mistake "nothing at all" 1 1 missing ''
mistake "comments only" 2 1 missing '# a\n# b\n'
mistake "a header only" 1 1 missing "$head\n"
mistake "an unknown column" 2 4 unknown_key "# a comment\n$head,temperature\n15,0,1,20\n"
holds "the valid columns are named" '.errors[0].detail | contains("phi_i_deg") and contains("wavelength_nm")'
mistake "a missing column" 1 1 missing 'theta_i_deg,theta_r_deg\n15,0\n'
mistake "a column twice" 1 4 duplicate_key "$head,brdf_per_sr\n15,0,1,1\n"
mistake "phi_i without phi_r" 1 1 missing "$head,phi_i_deg\n15,0,1,0\n"
mistake "no header" 1 1 unknown_key '15,0,1\n15,1,1\n'
mistake "semicolons" 1 1 unknown_key 'theta_i_deg;theta_r_deg;brdf_per_sr\n15;0;1\n'

# ---- rows ----
mistake "a field too few" 3 1 ragged "$head\n15,0,0.1\n15,1\n"
mistake "a field too many" 4 1 ragged "$head\n15,0,0.1\n\n15,1,0.1,7\n"
mistake "a quote that does not end" 2 4 syntax "$head,channel\n15,0,0.1,\"red\n"
for value in nan NaN inf -inf Infinity 1e999 '' x '0.1 0.2' 0x10; do
    mistake "a BRDF of \"$value\"" 3 3 not_a_number "$head\n15,0,0.1\n15,1,$value\n"
done
mistake "a quote in a field without" 2 4 syntax "$head,channel\n15,0,0.1,a\"b\"\n"
mistake "a channel's name that is not UTF-8" 2 4 not_utf8 "$head,channel\n15,0,0.1,gr\\xfcn\n"
mistake "a NUL byte in a number" 2 3 not_a_number "$head\n15,0,0.1\\0000\n"
mistake "a decimal comma, quoted" 2 3 not_a_number "$head\n15,0,\"0,1\"\n"
mistake "an angle that is no number" 2 1 not_a_number "$head\n15deg,0,0.1\n"
mistake "theta_i of 90" 2 1 out_of_range "$head\n90,0,0.1\n"
mistake "theta_i below 0" 2 1 out_of_range "$head\n-15,0,0.1\n"
mistake "theta_r of -90" 2 2 out_of_range "$head\n15,-90,0.1\n"
mistake "phi beyond a turn" 2 4 out_of_range "$head,phi_i_deg,phi_r_deg\n15,10,0.1,400,0\n"
mistake "sigma of 0" 2 4 out_of_range "$head,sigma\n15,10,0.1,0\n"
mistake "wavelength of 0" 2 4 out_of_range "$head,wavelength_nm\n15,10,0.1,0\n"
mistake "a sign that contradicts phi" 4 2 contradiction \
    "$head,phi_i_deg,phi_r_deg\n15,30,0.2,0,180\n15,-30,0.1,0,0\n15,-40,0.1,0,180\n"
mistake "a channel of two wavelengths" 3 4 contradiction "$head,wavelength_nm,channel\n15,0,0.1,550,a\n15,1,0.1,650,a\n"
mistake "several mistakes: the first" 2 3 not_a_number "$head\n15,0,x\n15,0,y\n95,0,1\n"
holds "several mistakes are told together" '[.errors[].line] == [2, 3, 4]'
{ echo "$head"; for i in {1..99}; do echo "15,$i,x"; done; } >"$work/bad.csv"
post_csv '' "$work/bad.csv"
refused "a hundred mistakes" 422
holds "at most 50 are told" '.errors | length == 50'

# ---- options in the query ----
# query NAME QUERY POINTER CODE
query() {
    post_csv "$2" "$work/good.csv"
    refused "$1" 422 ".pointer == \"$3\" and .code == \"$4\""
}
query "unknown query parameter" 'model=ward' /model unknown_key
holds "the valid ones are named" 'any(.errors[]; .detail | contains("models") and contains("time_limit_s"))'
query "unknown model" 'models=ward,wart' /models/1 unknown_model
query "no model" 'models=' /models/0 unknown_model
query "a model twice over" 'models=ward&models=phong' /models duplicate_key
query "a seed that is no number" 'seed=x' /options/seed wrong_type
query "a seed that is not finite" 'seed=inf' /options/seed wrong_type
query "a time limit that is nan" 'time_limit_s=nan' /options/time_limit_s wrong_type
query "unknown loss" 'loss=l3' /options/loss unknown_value
query "a name that is not UTF-8" 'name=gr%FCn' /name not_utf8
query "unknown unit" 'unit=sr' /unit unknown_value
query "chi2 without sigma" 'models=lambert&loss=chi2' /options/loss needs_sigma
query "fewer samples than parameters" 'models=he_torrance' /dataset/channels/0 too_few_samples
request POST '/v1/fits?seed=1' -H 'Content-Type: application/json' --data-binary '{}'
refused "query parameters beside a JSON body" 422 '.pointer == "/seed" and .code == "unknown_key"'
finish
